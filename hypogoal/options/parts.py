"""Parts of an agent that a setting names: choosers, learners and termination rules."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import numpy as np

from hypogoal.core.arrays import Array
from hypogoal.core.artefacts import AGAIN
from hypogoal.core.checkpoints import Resumable
from hypogoal.core.errors import UserError

if TYPE_CHECKING:
    from torch import Tensor

    from hypogoal.domains.base import Engine
    from hypogoal.options.config import OptionConfig


class Part(Resumable):
    """A part of an agent. Its class knows with which settings and engines the part works."""

    @classmethod
    def refuse(cls, config: OptionConfig, engine: Engine) -> None:
        """Raise ``UserError`` if the part does not work with the settings in the engine.

        By default every part works.
        """


def answer_of(part: Part, method: str, values: Any, dtype: Any, count: int, most: int = 1) -> Array:
    """Return what a part's method gave for each of ``count`` environments, as an array (count,).

    Raises ``UserError`` if the answer has another shape or type, or is not within 0 to ``most``.
    """
    given = np.asarray(values)
    kinds = "b" if dtype is bool else "iu"
    if given.shape != (count,) or given.dtype.kind not in kinds:
        shown = f"{given.dtype} {given.shape}"
    elif count and (given.min() < 0 or given.max() > most):
        shown = f"{given.min()} to {given.max()}"
    else:
        return given
    raise UserError(
        f"{method} gave {shown}", type(part).__name__, f"Give {np.dtype(dtype)} ({count},), from 0 to {most}."
    )


def learned_by(part: Any) -> dict[str, float]:
    """Return the numbers of the updates that were due. Raises ``UserError`` if ``learn`` gives no dictionary."""
    numbers = part.learn()
    if not isinstance(numbers, dict):
        raise UserError(
            f"learn gave {numbers!r}",
            type(part).__name__,
            "Return a dict of numbers to log, empty where no update was due.",
        )
    return numbers


def saved_row(weights: Mapping[str, Tensor], name: str, options: int) -> Array:
    """Return the tensor ``name`` of an artefact's weights, which has one number for each option (O,).

    Raises ``UserError`` if the tensor is missing or has another shape.
    """
    row = weights.get(name)
    if row is None or row.shape != (options,):
        raise UserError(f"the weights do not fit the manifest (at {name})", f"{options} options", AGAIN)
    return row.numpy().copy()
