"""A teacher: own code that says what members should predict in unlabelled states, beside the labels."""

from collections.abc import Callable
from typing import Any

import numpy as np
import torch
from torch import Tensor

from hypogoal.core.errors import UserError
from hypogoal.core.own_code import load


def load_teacher(name: str) -> Callable[..., Any]:
    """The function ``module:function``, or of an entry point; any other name is a ``UserError``."""
    teacher: Callable[..., Any] = load(name, "teacher", "hypogoal.teachers", {})
    return teacher


def taught_by(
    name: str,
    observations: Any,
    labels: Any,
    unlabelled: Any,
    members: int,
    seed: int,
) -> Tensor:
    """A teacher's scores of unlabelled states, float32 (K, M); others than finite ones are a ``UserError``.

    It gets labelled observations (N, *obs), labels bool (N,), unlabelled observations (M, *obs), K and a seed.
    """
    teacher = load_teacher(name)
    shape = (members, len(unlabelled))
    taught = teacher(observations, labels, unlabelled, members, seed)
    scores = np.array(taught, dtype=np.float32)
    if scores.shape != shape or not np.isfinite(scores).all():
        raise UserError(
            f"the teacher gave scores {scores.shape}",
            name,
            f"Give finite ones, {shape}.",
        )
    return torch.from_numpy(scores)
