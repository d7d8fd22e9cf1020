"""Diversity objectives, one per file; the file's name is the name on the command line.

An objective is one of two functions:

- ``pair_loss(logits_a, logits_b)`` takes two members' logits (..., N, 2) on the same N unlabelled states. It returns a
  loss (...,), lower where the two members differ more. Eq. (1) sums it over all ordered pairs.
- ``ensemble_loss(context)`` takes all members at once, see :class:`Context`. It returns one number, a tensor ().

Both must stay finite and differentiable at extreme logits and for N = 0 (``hypogoal check --diversity`` tests it). Name
your own as ``module:function``, a function of two arguments or of one. Other packages add theirs under the entry point
group ``hypogoal.diversity``, as ``name = "module:function"`` or ``name = "module"`` with one of these functions.

:func:`hypogoal.hypotheses.fit.disagreement_of` puts them into Eq. (1).
"""

from __future__ import annotations

import inspect
import pkgutil
from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING

from hypogoal.core.errors import UserError
from hypogoal.core.own_code import load

if TYPE_CHECKING:
    from torch import Tensor

ENTRY_POINTS = "hypogoal.diversity"
OBJECTIVES = tuple(sorted(module.name.replace("_", "-") for module in pkgutil.iter_modules(__path__)))
"""Names of the objectives that come with hypogoal."""


@dataclass(frozen=True)
class Context:
    """One batch as K members in training see it: B labelled and N unlabelled states.

    Attributes:
        labels: int64 (B,), 1 where the sub-goal holds.
        labelled: float (K, B, 2), logits of labelled states.
        unlabelled: float (K, N, 2), logits of unlabelled states.
        frozen: float (F, N, 2), logits of members trained earlier (schedule=sequential), which get no gradient.
        positives: the share of positives to expect among unlabelled states, strictly between 0 and 1: the setting
            ``share``, which may be that of all labelled states, not only this batch's.
    """

    labels: Tensor
    labelled: Tensor
    unlabelled: Tensor
    frozen: Tensor
    positives: float


@dataclass(frozen=True)
class Objective:
    """A diversity objective by name, of either kind: one of the two losses is given."""

    name: str
    pair_loss: Callable[[Tensor, Tensor], Tensor] | None = None
    ensemble_loss: Callable[[Context], Tensor] | None = None

    def acts(self, members: int) -> bool:
        """Whether it has an effect on an ensemble with this number of members: pairs need two."""
        return self.name != "none" and (members > 1 or self.ensemble_loss is not None)


def load_objective(name: str) -> Objective:
    """The diversity objective ``name``: of :data:`OBJECTIVES`, an installed entry point, or ``module:function``.

    Raises ``UserError`` if it is unknown, cannot be loaded or is no objective, or if the user did not allow the code
    (see :mod:`hypogoal.core.own_code`).
    """
    built_in = {objective: f"{__name__}.{objective.replace('-', '_')}" for objective in OBJECTIVES}
    loaded = load(name, "diversity objective", ENTRY_POINTS, built_in)
    for kind in ("ensemble_loss", "pair_loss"):  # the first may use the second
        if hasattr(loaded, kind):
            return Objective(name, **{kind: getattr(loaded, kind)})
    if not callable(loaded):
        raise UserError(
            "this is not a diversity objective",
            name,
            "Give a pair_loss(logits_a, logits_b) or an ensemble_loss(context).",
        )
    parameters = inspect.signature(loaded).parameters.values()
    required = [parameter for parameter in parameters if parameter.default is parameter.empty]
    if len(required) == 1:
        return Objective(name, ensemble_loss=loaded)
    return Objective(name, pair_loss=loaded)
