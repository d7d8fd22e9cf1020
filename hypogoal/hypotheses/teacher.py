"""Teachers: the user's own code that says what members should predict in unlabelled states, beside the labels."""

from collections.abc import Callable
from typing import Any

import numpy as np
import torch
from torch import Tensor

from hypogoal.core.errors import UserError
from hypogoal.core.own_code import load
from hypogoal.observations import digest


def load_teacher(name: str) -> Callable[..., Any]:
    """Return the function that ``name`` names: ``module:function``, or an installed entry point.

    Raises ``UserError`` if ``name`` is anything else.
    """
    teacher = load(name, "teacher", "hypogoal.teachers", {})
    if not callable(teacher):
        raise UserError("this is no teacher", name, "Give a function, see docs/extending.md.")
    return teacher


def taught_by(
    name: str,
    observations: Any,
    labels: Any,
    unlabelled: Any,
    members: int,
    seed: int,
) -> Tensor:
    """Return a teacher's scores of unlabelled states, float32 (K, M), clipped to -1..1.

    The teacher is called with the labelled observations (N, *obs), their labels bool (N,), the unlabelled observations
    (M, *obs), K and a seed. Raises ``UserError`` if the teacher gives anything but finite scores (K, M), or if it
    changes what it gets.
    """
    teacher = load_teacher(name)
    shape = (members, len(unlabelled))
    states = observations, labels, unlabelled
    before = [*map(digest, states)]
    taught = teacher(*states, members, seed)
    if before != [*map(digest, states)]:
        raise UserError("the teacher changes what it gets", name, "Have it change a copy.")
    do = f"Give finite ones, {shape}: above 0 for positive, below for negative."
    try:
        given = np.asarray(taught)
        scores = given.astype(float)
    except (TypeError, ValueError, RuntimeError) as error:
        raise UserError(f"the teacher gave no scores ({error})", name, do) from None
    if scores.shape != shape or given.dtype == bool or not np.isfinite(scores).all():
        raise UserError(f"the teacher gave scores {given.dtype} {scores.shape}", name, do)
    return torch.from_numpy(scores.clip(-1, 1).astype(np.float32))
