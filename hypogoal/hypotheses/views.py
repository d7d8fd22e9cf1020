"""What members see of an observation: all of it, or the neighbourhood of the agent (beyond the paper)."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray
from torch import nn

from hypogoal.core.errors import UserError
from hypogoal.hypotheses.config import EnsembleConfig
from hypogoal.hypotheses.localisers import (
    LearnedLocaliser,
    Localiser,
    Pixels,
    RamLocaliser,
    fit_localiser,
)

Origins = Mapping[str, NDArray[np.int64]]
POSITION, ACTIONS = ("room", "x", "y"), ("action", "previous_action")  # names of origins
CHUNK = 1024  # states at once: so many crops are gathered from whole images at a time


class FullView(nn.Module):
    """All of an observation, as it is: the paper's view."""

    needs_positions = False

    def __init__(self, observation_shape: tuple[int, ...]):
        super().__init__()
        self.shape = observation_shape

    def see(
        self, observations: NDArray[np.uint8], positions: NDArray[np.int64] | None = None, *, margin: int = 0
    ) -> NDArray[np.uint8]:
        """The observations."""
        assert not margin, "all of it has nothing around it"
        return observations


class AgentView(nn.Module):
    """A window around the agent; what is outside the image is 0.

    The same window for every frame of a stack, around where the agent is in the last.

    Args:
        observation_shape: (H, W, C).
        height, width: of the window, in pixels.
        localiser: where the agent is.

    Attributes:
        shape: (height, width, C).
        needs_positions: whether the localiser reads positions, which no policy may see: an oracle.
    """

    def __init__(self, observation_shape: tuple[int, ...], height: int, width: int, localiser: Localiser):
        super().__init__()
        self.shape = (height, width, *observation_shape[2:])
        self.localiser = localiser
        self.needs_positions = localiser.needs_positions

    def see(
        self, observations: NDArray[np.uint8], positions: NDArray[np.int64] | None = None, *, margin: int = 0
    ) -> NDArray[np.uint8]:
        """Windows uint8 (N, height, width, C).

        Args:
            observations: uint8 (N, H, W, C).
            positions: int64 (N, 3) of room, x, y, where the localiser reads them.
            margin: so many pixels more on every side.
        """
        height, width, channels = self.shape
        size = height + 2 * margin, width + 2 * margin
        seen = np.empty((len(observations), *size, channels), dtype=np.uint8)
        for start in range(0, len(observations), CHUNK):
            chunk = slice(start, start + CHUNK)
            centres = self.localiser.locate(observations[chunk], None if positions is None else positions[chunk])
            seen[chunk] = windows(observations[chunk], centres, *size)
        return seen


def windows(
    observations: NDArray[np.uint8], centres: NDArray[np.floating], height: int, width: int
) -> NDArray[np.uint8]:
    """Windows uint8 (N, height, width, C) of images uint8 (N, H, W, C); 0 outside them.

    Args:
        observations: the images.
        centres: (N, 2), row and column of the pixel in the middle; of an even number of pixels it is the one after.
        height, width: in pixels.
    """
    corner = np.floor(centres + 0.5).astype(np.int64) - (height // 2, width // 2)
    rows, rows_inside = _indices(corner[:, 0], height, observations.shape[1])
    columns, columns_inside = _indices(corner[:, 1], width, observations.shape[2])
    found = observations[np.arange(len(observations))[:, None, None], rows[:, :, None], columns[:, None, :]]
    found[~(rows_inside[:, :, None] & columns_inside[:, None, :])] = 0
    return found


def _indices(first: NDArray[np.int64], count: int, size: int) -> tuple[NDArray[np.int64], NDArray[np.bool_]]:
    """``count`` indices from each first on (N, count), clipped to 0..size-1, and which were inside."""
    indices = first[:, None] + np.arange(count)
    return indices.clip(0, size - 1), (indices >= 0) & (indices < size)


def positions_of(origins: Mapping[str, NDArray[np.int64]] | None) -> NDArray[np.int64] | None:
    """Positions int64 (N, 3) of room, x, y from origins; None where these do not say them."""
    if origins is None or not all(name in origins for name in POSITION):
        return None
    return np.stack([origins[name] for name in POSITION], axis=1).astype(np.int64)


def needed(origins: Mapping[str, NDArray[np.int64]] | None, names: tuple[str, ...], why: str) -> None:
    """Check that states say where they come from.

    Raises:
        UserError: an origin is missing.
    """
    missing = [name for name in names if name not in (origins or {})]
    if missing:
        raise UserError(
            f"the data do not say {', '.join(missing)} of each state", why, "Collect data that do, or set it otherwise."
        )


def view_of(
    observations: NDArray[np.uint8],
    unlabelled: NDArray[np.uint8],
    config: EnsembleConfig,
    seed: int,
    origins: Origins | None,
    unlabelled_origins: Origins | None,
    agent_pixels: Pixels | None,
    *,
    fitted: bool,
) -> FullView | AgentView:
    """What the members are to see; a localiser that learns is trained here, or where not ``fitted`` to be loaded."""
    if config.view == "full":
        if config.jitter:
            raise UserError("only windows can be moved", f"jitter={config.jitter}", "Set view=agent-crop or jitter=0.")
        return FullView(observations.shape[1:])
    if agent_pixels is None:
        raise UserError("nobody says where in these observations the agent is", "view=agent-crop", "Set view=full.")
    needed(origins, POSITION, "view=agent-crop")
    if len(unlabelled):
        needed(unlabelled_origins, POSITION if config.localiser == "ram" else ACTIONS, f"localiser={config.localiser}")
    if config.localiser == "ram":
        localiser: Localiser = RamLocaliser(agent_pixels)
    elif not fitted:
        localiser = LearnedLocaliser(observations.shape[1:])
    else:
        localiser = _learned(observations, unlabelled, seed, origins or {}, unlabelled_origins or {}, agent_pixels)
    return AgentView(observations.shape[1:], config.crop_height, config.crop_width, localiser)


def _learned(
    observations: NDArray[np.uint8],
    unlabelled: NDArray[np.uint8],
    seed: int,
    origins: Origins,
    unlabelled_origins: Origins,
    agent_pixels: Pixels,
) -> LearnedLocaliser:
    """A localiser from the labelled states in which the agent lives (dying it is elsewhere) and from unlabelled ones.

    Of unlabelled states it sees the agent's actions, which the agent knows, and not its positions.
    """
    positions = positions_of(origins)
    assert positions is not None
    alive = np.flatnonzero(origins.get("dying", np.zeros(len(positions))) == 0)
    none = np.zeros(0, dtype=np.int64)
    actions = np.stack([unlabelled_origins.get(name, none) for name in ACTIONS], axis=1)
    known = np.flatnonzero((actions >= 0).all(axis=1))
    return fit_localiser(observations[alive], agent_pixels(positions[alive]), unlabelled[known], actions[known], seed)
