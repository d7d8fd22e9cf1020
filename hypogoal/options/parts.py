"""Parts of an agent that a setting names: choosers, learners, termination rules."""

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
    """A part of an agent. Its class knows which settings and engines it works with."""

    @classmethod
    def refuse(cls, config: OptionConfig, engine: Engine) -> None:
        """Raise a ``UserError`` where it does not work with these settings in this engine; by default it does."""


def answer_of(part: Part, method: str, values: Any, dtype: Any, count: int, most: int = 1) -> Array:
    """What a part's method gave for each of ``count`` environments, from 0 to ``most``, else a ``UserError``."""
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
    """The numbers of the updates that were due; anything but a dictionary is a ``UserError``."""
    numbers = part.learn()
    if not isinstance(numbers, dict):
        raise UserError(
            f"learn gave {numbers!r}",
            type(part).__name__,
            "Return a dict of numbers to log, empty where no update was due.",
        )
    return numbers


def saved_row(weights: Mapping[str, Tensor], name: str, options: int) -> Array:
    """A number for each option (O,), of an artefact's weights; a ``UserError`` where they are missing."""
    row = weights.get(name)
    if row is None or row.shape != (options,):
        raise UserError(f"the weights do not fit the manifest (at {name})", f"{options} options", AGAIN)
    return row.numpy().copy()
