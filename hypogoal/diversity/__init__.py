"""Spec C1: diversity objectives, one per file; the file's name is the name on the command line.

An objective is one of two functions:

- ``pair_loss(logits_a, logits_b)`` takes two members' logits (..., N, 2) on the same N unlabelled states. It returns a
  loss (...,), lower where the two members differ more. Eq. (1) sums it over all ordered pairs.
- ``ensemble_loss(context)`` takes all members at once, see :class:`Context`. It returns one number, a tensor ().

Both must stay finite and differentiable at extreme logits and for N = 0 (``hypogoal check --diversity`` tests it). Name
your own as ``module:function``, a function of two arguments or of one. Other packages add theirs under the entry point
group ``hypogoal.diversity``, as ``name = "module:function"`` or ``name = "module"`` with one of these functions.
"""

from __future__ import annotations

import inspect
import pkgutil
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import combinations
from typing import TYPE_CHECKING, Any, TypeAlias

from hypogoal.core.errors import UserError
from hypogoal.core.own_code import load

if TYPE_CHECKING:
    from torch import Tensor

PairLoss: TypeAlias = Callable[["Tensor", "Tensor"], "Tensor"]
EnsembleLoss: TypeAlias = Callable[["Context"], "Tensor"]

ENTRY_POINTS = "hypogoal.diversity"
OBJECTIVES: tuple[str, ...] = tuple(sorted(module.name.replace("_", "-") for module in pkgutil.iter_modules(__path__)))
"""Names of the objectives that come with hypogoal."""


@dataclass(frozen=True)
class Context:
    """One batch as K members in training see it: B labelled and N unlabelled states.

    Attributes:
        labels: int64 (B,), 1 where the sub-goal holds.
        labelled: float (K, B, 2), logits of labelled states.
        unlabelled: float (K, N, 2), logits of unlabelled states.
        frozen: float (F, N, 2), logits of members trained earlier (schedule=sequential), which get no gradient.
        positives: the share of positives among all labelled states, not only this batch's; strictly between 0 and 1.
    """

    labels: Tensor
    labelled: Tensor
    unlabelled: Tensor
    frozen: Tensor
    positives: float


class Objective:
    """A diversity objective by name, of either kind.

    Attributes:
        name: as in the setting ``diversity``.
        pair_loss: the loss that Eq. (1) sums over pairs, or None.
        ensemble_loss: the loss of all members at once; None if there is a ``pair_loss``.
    """

    def __init__(self, name: str, *, pair_loss: PairLoss | None = None, ensemble_loss: EnsembleLoss | None = None):
        self.name, self.pair_loss, self.ensemble_loss = name, pair_loss, ensemble_loss

    def acts(self, members: int) -> bool:
        """Whether it has an effect on an ensemble with this number of members: pairs need two."""
        return self.name != "none" and (members > 1 or self.ensemble_loss is not None)

    def terms(self, members: Sequence[int], frozen: int) -> list[str]:
        """Names for each of :meth:`losses`; ``members`` are in training, 0 to ``frozen`` - 1 are frozen."""
        if self.ensemble_loss is not None:
            return ["the diversity loss"]
        pairs = [*combinations(members, 2), *((old, member) for member in members for old in range(frozen))]
        return [f"the diversity loss of members {first} and {second}" for first, second in pairs]

    def losses(self, context: Context) -> Tensor:
        """The inner sums of Eq. (1), float (P,): a loss per pair, first in training, then with frozen members.

        The double sum counts each pair in training twice. Its i = m is left out: disagreement with itself would push
        every member to p = 1/2. An ``ensemble_loss`` is the only loss.
        """
        import torch

        if self.ensemble_loss is not None:
            return self._checked(self.ensemble_loss, context)[None]
        assert self.pair_loss is not None
        trained, frozen = context.unlabelled, context.frozen
        losses = [2.0 * self._checked(self.pair_loss, *pair) for pair in combinations(trained, 2)]
        losses += [self._checked(self.pair_loss, old, member) for member in trained for old in frozen]
        return torch.stack(losses) if losses else trained.new_zeros(0)

    def _checked(self, function: Callable[..., Tensor], *arguments: Any) -> Tensor:
        """The loss, after a check of its shape; that it is finite is checked every few steps, or a GPU would wait."""
        loss: Any = function(*arguments)
        if getattr(loss, "shape", None) != () or not loss.is_floating_point():
            received = f"{loss.dtype} {tuple(loss.shape)}" if hasattr(loss, "dtype") else type(loss).__name__
            do = "Give a float (): a mean over the states, axis -2."
            raise UserError(f"the diversity objective gave {received}", self.name, do)
        return loss


def load_objective(name: str) -> Objective:
    """The diversity objective ``name``: of :data:`OBJECTIVES`, an installed entry point, or ``module:function``.

    Raises ``UserError`` if it is unknown, cannot be loaded or is no objective, or if the user did not allow the code
    (see :mod:`hypogoal.core.own_code`).
    """
    built_in = {objective: f"{__name__}.{objective.replace('-', '_')}" for objective in OBJECTIVES}
    loaded = load(name, "diversity objective", ENTRY_POINTS, built_in)
    for kind in ("ensemble_loss", "pair_loss"):  # the first may use the second
        if hasattr(loaded, kind):
            function = getattr(loaded, kind)
            break
    else:
        function, kind = loaded, "ensemble_loss" if _arguments(loaded) == 1 else "pair_loss"
    if not callable(function):
        do = "Give a pair_loss(logits_a, logits_b) or an ensemble_loss(context)."
        raise UserError("this is not a diversity objective", name, do)
    return Objective(name, **{kind: function})


def _arguments(function: object) -> int:
    """The number of required positional arguments; 0 if unknown."""
    try:
        parameters = inspect.signature(function).parameters.values()  # type: ignore[arg-type]
    except (TypeError, ValueError):
        return 0
    positional = (inspect.Parameter.POSITIONAL_ONLY, inspect.Parameter.POSITIONAL_OR_KEYWORD)
    return sum(parameter.kind in positional and parameter.default is parameter.empty for parameter in parameters)
