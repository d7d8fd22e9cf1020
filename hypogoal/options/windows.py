"""What policies see that do not see all of a picture: the neighbourhood of the agent, or half the side (both ours)."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from hypogoal.core.checkpoints import Resumable
from hypogoal.core.errors import UserError
from hypogoal.domains.base import Engine
from hypogoal.hypotheses.ensemble import Ensemble
from hypogoal.hypotheses.localisers import Localiser
from hypogoal.hypotheses.views import AgentView, cut_windows

SIDE = 42  # pixels, half of what is seen of Montezuma's Revenge


def localiser_of(ensemble: Ensemble) -> Localiser:
    """Who finds the agent; a ``UserError`` where nobody does, or by positions that no policy may see."""
    if not isinstance(ensemble.view, AgentView) or ensemble.needs_positions:
        what = "the agent's place in an observation is not known"
        raise UserError(what, "policy_view=agent-crop", "Train the ensemble with view=agent-crop, localiser=learned.")
    return ensemble.view.localiser


def around_agent(localiser: Localiser, observations: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Windows uint8 (N, SIDE, SIDE, C) of observations uint8 (N, H, W, C)."""
    return cut_windows(observations, localiser.locate(observations), SIDE, SIDE)


class AgentWindows(Resumable):
    """Pictures of an engine's states as such policies see them; each state's agent is looked for once."""

    CHANGING = ("_centres",)
    tiles = None

    def __init__(self, engine: Engine, localiser: Localiser):
        self.engine, self.localiser = engine, localiser
        self.observation_shape = (SIDE, SIDE, *engine.observation_shape[2:])
        self._centres = np.full((1024, 2), np.nan)

    def items(self) -> dict[str, Any]:
        return {"_centres": self._centres[:1]}

    def images(self, ids: NDArray[np.int64], out: NDArray[np.uint8] | None = None) -> NDArray[np.uint8]:
        """uint8 (n, SIDE, SIDE, C) of states (n,)."""
        if (more := int(ids.max(initial=-1)) + 1 - len(self._centres)) > 0:
            rows = np.full((max(more, len(self._centres)), 2), np.nan)
            self._centres = np.concatenate([self._centres, rows])
        whole = self.engine.images(ids)
        fresh, first = np.unique(ids, return_index=True)
        unknown = np.isnan(self._centres[fresh, 0])
        if unknown.any():
            self._centres[fresh[unknown]] = self.localiser.locate(whole[first[unknown]])
        seen = cut_windows(whole, self._centres[ids], SIDE, SIDE)
        if out is None:
            return seen
        out[:] = seen
        return out

    def codes(self, ids: NDArray[np.int64]) -> NDArray[np.integer]:
        """There are no tiles."""
        raise NotImplementedError


def halved(observations: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Means of 2 x 2 pixels, rounded: uint8 (N, H // 2, W // 2, C) of observations uint8 (N, H, W, C)."""
    _, height, width, channels = observations.shape
    whole = observations[:, : height // 2 * 2, : width // 2 * 2]
    pairs = np.add(whole[:, ::2], whole[:, 1::2], dtype=np.uint16)
    if channels == 4:  # four sums of 16 bits added as one number of 64: NumPy is slow where so few lie side by side
        pixels = np.ascontiguousarray(pairs).view(np.uint64)
        sums = (pixels[:, :, ::2] + pixels[:, :, 1::2]).view(np.uint16)
    else:
        sums = pairs[:, :, ::2] + pairs[:, :, 1::2]
    sums += 2
    sums >>= 2
    return sums.astype(np.uint8)


class HalfPictures(Resumable):
    """Pictures of an engine's states, or of ``windows`` of them, of half the side (policy_pixels=half)."""

    CHANGING = ("windows",)
    tiles = None

    def __init__(self, engine: Engine, windows: AgentWindows | None = None):
        self.windows, self._whole = windows, windows or engine
        height, width, channels = self._whole.observation_shape
        self.observation_shape = (height // 2, width // 2, channels)
        self._room = np.empty((0, height, width, channels), np.uint8)

    def images(self, ids: NDArray[np.int64], out: NDArray[np.uint8] | None = None) -> NDArray[np.uint8]:
        """uint8 (n, H // 2, W // 2, C) of states (n,)."""
        if len(ids) > len(self._room):
            self._room = np.empty((len(ids), *self._room.shape[1:]), np.uint8)
        small = halved(self._whole.images(ids, self._room[: len(ids)]))
        if out is None:
            return small
        out[:] = small
        return out

    def codes(self, ids: NDArray[np.int64]) -> NDArray[np.integer]:
        """There are no tiles."""
        raise NotImplementedError
