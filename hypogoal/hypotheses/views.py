"""What members see of an observation: all of it, or the neighbourhood of the agent (beyond the paper)."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from hypogoal.core.errors import UserError
from hypogoal.dataset import NUMBERS, PICTURE, Observations, Standard, standard_of, standardised
from hypogoal.hypotheses.config import EnsembleConfig
from hypogoal.hypotheses.localisers import LearnedLocaliser, Localiser, Pixels, RamLocaliser, fit_localiser

Origins = Mapping[str, NDArray[np.int64]]
POSITION, ACTIONS = ("room", "x", "y"), ("action", "previous_action")  # names of origins
CHUNK = 1024  # states at once: so many crops are gathered from whole images at a time


class FullView(nn.Module):
    """All of an observation: a picture as it is, the paper's view; of no picture each number by its ``standard``."""

    needs_positions = False
    mean: Tensor
    deviation: Tensor

    def __init__(self, observation_shape: tuple[int, ...], standard: Standard | None = None):
        super().__init__()
        self.shape, self.dtype = observation_shape, NUMBERS if standard else PICTURE
        for name, values in zip(("mean", "deviation"), standard or (), strict=False):
            self.register_buffer(name, torch.from_numpy(values.copy()))

    @property
    def standard(self) -> Standard | None:
        """Mean and deviation, (*shape), of numbers."""
        return (self.mean.cpu().numpy(), self.deviation.cpu().numpy()) if self.dtype == NUMBERS else None

    def see(
        self, observations: Observations, positions: NDArray[np.int64] | None = None, *, margin: int = 0
    ) -> Observations:
        """The observations (N, *shape)."""
        assert not margin, "all of it has nothing around it"
        return standardised(observations, *self.standard) if self.standard else observations


class AgentView(nn.Module):
    """A window around the agent, whom the localiser finds; what is outside the image is 0.

    The same window for every frame of a stack, around where the agent is in the last. Its ``shape`` is (height, width,
    C), in pixels, of pictures (H, W, C). ``needs_positions`` says whether the localiser reads positions, which no
    policy may see: an oracle.
    """

    dtype, standard = PICTURE, None

    def __init__(self, observation_shape: tuple[int, ...], height: int, width: int, localiser: Localiser):
        super().__init__()
        self.shape = (height, width, *observation_shape[2:])
        self.localiser = localiser
        self.needs_positions = localiser.needs_positions

    def see(
        self, observations: Any, positions: NDArray[np.int64] | None = None, *, margin: int = 0
    ) -> NDArray[np.uint8]:
        """Windows uint8 (N, height, width, C) of uint8 (N, H, W, C), with ``margin`` pixels more on every side.

        Positions are int64 (N, 3) of room, x, y, where the localiser reads them.
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

    ``centres`` (N, 2) are row and column of the pixel in the middle; of an even number of pixels it is the one after.
    """
    corner = np.floor(centres + 0.5).astype(np.int64) - (height // 2, width // 2)
    rows, rows_inside = _indices(corner[:, 0], height, observations.shape[1])
    columns, columns_inside = _indices(corner[:, 1], width, observations.shape[2])
    cut = observations[np.arange(len(observations))[:, None, None], rows[:, :, None], columns[:, None, :]]
    cut[~(rows_inside[:, :, None] & columns_inside[:, None, :])] = 0
    return cut


def _indices(first: NDArray[np.int64], count: int, size: int) -> tuple[NDArray[np.int64], NDArray[np.bool_]]:
    """``count`` indices from each first on (N, count), clipped to 0..size-1, and which were inside."""
    indices = first[:, None] + np.arange(count)
    return indices.clip(0, size - 1), (indices >= 0) & (indices < size)


def positions_of(origins: Origins | None) -> NDArray[np.int64] | None:
    """Positions int64 (N, 3) of room, x, y from origins; None where these do not say them."""
    if origins is None or not all(name in origins for name in POSITION):
        return None
    return np.stack([origins[name] for name in POSITION], axis=1).astype(np.int64)


def needed(origins: Origins | None, names: tuple[str, ...], why: str) -> Origins:
    """The origins of states, which must say these; a ``UserError`` where one is missing."""
    origins = origins or {}
    if missing := ", ".join(name for name in names if name not in origins):
        do = "Collect data that do, or change the setting."
        raise UserError(f"the data do not say {missing} of each state", why, do)
    return origins


def view_of(
    observations: Any,
    unlabelled: Any,
    config: EnsembleConfig,
    seed: int,
    origins: Origins | None,
    unlabelled_origins: Origins | None,
    agent_pixels: Pixels | None,
    *,
    fitted: bool,
) -> FullView | AgentView:
    """What the members are to see; what learns of it is trained here, or where not ``fitted`` to be loaded."""
    shape = observations.shape[1:]
    if observations.dtype == NUMBERS:
        for name, value in (("view", "full"), ("augment", "none"), ("jitter", 0)):
            if (given := getattr(config, name)) != value:
                raise UserError("these observations are not pictures", f"{name}={given}", f"Set {name}={value}.")
        return FullView(shape, standard_of(shape, *([observations, unlabelled] if fitted else [])))
    if config.view == "full":
        if config.jitter:
            raise UserError("only windows can be moved", f"jitter={config.jitter}", "Set view=agent-crop or jitter=0.")
        if config.augment == "grey-context":
            do = "Set view=agent-crop or augment=grey."
            raise UserError("the surroundings of the agent are not known", f"augment={config.augment}", do)
        return FullView(shape)
    if agent_pixels is None:
        raise UserError("the agent's place in these observations is not known", "view=agent-crop", "Set view=full.")
    origins = needed(origins, POSITION, "view=agent-crop")
    others = (POSITION if config.localiser == "ram" else ACTIONS) if len(unlabelled) else ()
    unlabelled_origins = needed(unlabelled_origins, others, f"localiser={config.localiser}")
    localiser: Localiser = RamLocaliser(agent_pixels) if config.localiser == "ram" else LearnedLocaliser(shape)
    if config.localiser == "learned" and fitted:
        # From labelled states in which the agent lives (dying it is elsewhere). Of unlabelled ones the localiser is
        # told the agent's actions, which the agent knows, and not its positions.
        positions = np.stack([origins[name] for name in POSITION], axis=1).astype(np.int64)
        alive = np.flatnonzero(origins.get("dying", np.zeros(len(positions))) == 0)
        none = np.zeros(0, dtype=np.int64)
        actions = np.stack([unlabelled_origins.get(name, none) for name in ACTIONS], axis=1)
        told = np.flatnonzero((actions >= 0).all(axis=1))
        pixels = agent_pixels(positions[alive])
        localiser = fit_localiser(observations[alive], pixels, unlabelled[told], actions[told], seed)
    return AgentView(shape, config.crop_height, config.crop_width, localiser)
