"""Diversity objectives, one in each file. A file's name is the objective's name on the command line.

An objective is one of two functions:

- ``pair_loss(logits_a, logits_b)`` takes two members' logits (..., N, 2) on N unlabelled states. It returns a loss
  (...,), which is lower where the two members differ more. Eq. (1) sums the loss over all ordered pairs.
- ``ensemble_loss(context)`` takes all members at once, see :class:`Context`. It returns one number, a tensor ().

Both functions must stay finite and differentiable at extreme logits and for N = 0. ``hypogoal check --diversity`` tests
that. Name your own objective as ``module:function``, a function of two arguments or of one argument. Other packages add
objectives under the entry point group ``hypogoal.diversity``, as ``name = "module:function"``, or as ``name =
"module"`` if the module has one of the two functions.

:func:`hypogoal.hypotheses.fit.disagreement_of` puts objectives into Eq. (1).
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
    """One batch as K members in training see it, with B labelled and N unlabelled states.

    Attributes:
        labels: int64 (B,), 1 where the sub-goal holds.
        labelled: float (K, B, 2), the members' logits of the labelled states.
        unlabelled: float (K, N, 2), the members' logits of the unlabelled states.
        frozen: float (F, N, 2), the logits of members that were trained earlier (schedule=sequential). Frozen members
            get no gradient.
        positives: the share of positives to expect among unlabelled states, strictly between 0 and 1. This is the
            setting ``share``. It may be the share among all labelled states, not only among the states of the batch.
    """

    labels: Tensor
    labelled: Tensor
    unlabelled: Tensor
    frozen: Tensor
    positives: float


@dataclass(frozen=True)
class Objective:
    """A diversity objective by name, which has either a ``pair_loss`` or an ``ensemble_loss``."""

    name: str
    pair_loss: Callable[[Tensor, Tensor], Tensor] | None = None
    ensemble_loss: Callable[[Context], Tensor] | None = None

    def acts(self, members: int) -> bool:
        """Return whether the objective has an effect on an ensemble of ``members`` members.

        A ``pair_loss`` needs two members. An ``ensemble_loss`` is called with one member, too.
        """
        return self.name != "none" and (members > 1 or self.ensemble_loss is not None)


def load_objective(name: str) -> Objective:
    """Return the diversity objective ``name``: of :data:`OBJECTIVES`, an installed entry point, or ``module:function``.

    Raises ``UserError`` if the objective is unknown or cannot be loaded, if ``name`` is no objective, or if the user
    did not allow the code (see :mod:`hypogoal.core.own_code`).
    """
    built_in = {objective: f"{__name__}.{objective.replace('-', '_')}" for objective in OBJECTIVES}
    loaded = load(name, "diversity objective", ENTRY_POINTS, built_in)
    for kind in ("ensemble_loss", "pair_loss"):  # in this order, because an ensemble_loss may use a pair_loss
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
