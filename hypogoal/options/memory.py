"""States that an engine has forgotten: what learns from old ones must know (see ``hypogoal.domains.base.Engine``)."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from hypogoal.core.errors import UserError
from hypogoal.domains.base import Engine

STACK = 4  # steps that an observation looks back at most: a state is forgotten with its oldest frame


def remembered(engine: Engine, ids: NDArray[np.integer]) -> NDArray[np.bool_]:
    """Whether the engine can still draw these states (...,): start states always, others from ``engine.oldest`` on."""
    return (ids >= getattr(engine, "oldest", 0)) | (ids < len(getattr(engine, "starts", ())))


def require_memory(engine: Engine, reach: int, replay: int) -> None:
    """Spec D3: what a replay reaches back to must lie within what the engine remembers.

    Args:
        engine: forgets all but the last ``engine.memory`` states, where it has that.
        reach: states.
        replay: the setting, for the message.

    Raises:
        UserError: it does not.
    """
    memory = getattr(engine, "memory", None)
    if memory is not None and reach > memory:
        raise UserError(
            f"the replay reaches back {reach} states, the engine remembers {memory}",
            f"replay={replay}",
            f"Give --set replay={max(100, replay - (reach - memory))} or less.",
        )
