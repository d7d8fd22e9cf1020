"""Spec C1: diversity objectives. One objective a file; the file's name is the name on the command line.

An objective is a function ``pair_loss(logits_a, logits_b)`` of two members' logits (..., N, 2) on the same N
unlabelled states. It returns a loss (...,), lower where the two members differ more, and must stay finite and
differentiable at extreme logits and for N = 0. Other packages add theirs under the entry point group
``hypogoal.diversity``, as ``name = "module:function"`` or ``name = "module"`` with a ``pair_loss`` in it.
"""

from __future__ import annotations

import importlib
import pkgutil
from collections.abc import Callable
from importlib import metadata
from typing import TYPE_CHECKING, TypeAlias

from hypogoal.core.errors import UserError

if TYPE_CHECKING:
    from torch import Tensor

    PairLoss: TypeAlias = Callable[[Tensor, Tensor], Tensor]

ENTRY_POINTS = "hypogoal.diversity"
OBJECTIVES: tuple[str, ...] = tuple(sorted(module.name for module in pkgutil.iter_modules(__path__)))
"""Names of the objectives that come with hypogoal."""


def load_objective(name: str) -> PairLoss:
    """The diversity objective called ``name``: one of :data:`OBJECTIVES` or an installed entry point.

    Args:
        name: ``dbat``, ``divdis``, ``none`` or an entry point's name.

    Returns:
        ``pair_loss(logits_a, logits_b)``: float (..., N, 2) twice -> float (...,).

    Raises:
        UserError: no such objective, or the entry point cannot be loaded or is not an objective.
    """
    if name in OBJECTIVES:
        return importlib.import_module(f"{__name__}.{name}").pair_loss
    entries = {entry.name: entry for entry in metadata.entry_points(group=ENTRY_POINTS)}
    if name not in entries:
        known = ", ".join(sorted({*OBJECTIVES, *entries}))
        raise UserError("unknown diversity objective", name, f"Choose one of {known}.")
    try:
        found = entries[name].load()
    except (ImportError, AttributeError) as error:
        raise UserError(f"the diversity objective cannot be loaded ({error})", name, "Check its package.") from None
    found = getattr(found, "pair_loss", found)
    if not callable(found):
        raise UserError("the entry point is no diversity objective", name, "Give a pair_loss(logits_a, logits_b).")
    return found
