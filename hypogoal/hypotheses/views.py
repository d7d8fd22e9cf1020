"""What members see of an observation: all of it, or the agent's surroundings (beyond the paper)."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from math import prod
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from hypogoal.core.errors import UserError
from hypogoal.dataset import (
    NUMBERS,
    PICTURE,
    Observations,
    Standard,
    fields_of,
    numbers_of,
    standard_of,
    standardised,
)
from hypogoal.hypotheses.config import EnsembleConfig
from hypogoal.hypotheses.localisers import AgentPixels, LearnedLocaliser, Localiser, RamLocaliser, fit_localiser

Origins = Mapping[str, NDArray[np.int64]]
POSITION, ACTIONS = ("room", "x", "y"), ("action", "previous_action")  # names of origins
CUT_AT_ONCE = 1024  # windows cut from whole images at a time


@dataclass(frozen=True)
class StateOrigins:
    """Where training states come from, as far as it is known.

    Attributes:
        labelled: int64 (N,) by name, of labelled states: ``ladder`` for batch_kind=per-ladder; ``room``, ``x``, ``y``
            (and ``dying``) for view=agent-crop.
        unlabelled: int64 (M,) by name: ``room``, ``x``, ``y`` for localiser=ram, ``action``, ``previous_action`` for
            localiser=learned.
        agent_pixels: the domain's function, for view=agent-crop.
    """

    labelled: Origins | None = None
    unlabelled: Origins | None = None
    agent_pixels: AgentPixels | None = None


NO_ORIGINS = StateOrigins()


class FullView(nn.Module):
    """All of an observation: a picture as it is, the paper's view; numbers standardised by ``standard``.

    Of a mixed observation, of type ``dtype``, ``standard`` is that of all its numbers, (D,).
    """

    needs_positions = False
    mean: Tensor
    deviation: Tensor

    def __init__(
        self, observation_shape: tuple[int, ...], standard: Standard | None = None, dtype: np.dtype[Any] | None = None
    ):
        super().__init__()
        self.shape, self.dtype = observation_shape, (NUMBERS if standard else PICTURE) if dtype is None else dtype
        for name, values in zip(("mean", "deviation"), standard or (), strict=False):
            self.register_buffer(name, torch.from_numpy(values.copy()))

    @property
    def standard(self) -> Standard | None:
        """Mean and deviation (*shape) of numbers; None for pictures."""
        return (self.mean.cpu().numpy(), self.deviation.cpu().numpy()) if "mean" in self._buffers else None

    def see(
        self, observations: Observations, positions: NDArray[np.int64] | None = None, *, margin: int = 0
    ) -> Observations:
        """The observations (N, *shape)."""
        assert not margin, "a full view has no margin"
        if self.standard is None or not self.dtype.names:
            return standardised(observations, *self.standard) if self.standard else observations
        seen, numbers, place = observations.copy(), standardised(numbers_of(observations), *self.standard), 0
        for key, (dtype, shape) in fields_of((), self.dtype).items():
            if dtype == NUMBERS:
                seen[key] = numbers[:, place : place + prod(shape)].reshape(-1, *shape)
                place += prod(shape)
        return seen


def full_view(like: Observations, *observations: Observations) -> FullView:
    """All of observations ``like`` these, their numbers standardised by mean and deviation of ``observations``."""
    shape, dtype = like.shape[1:], like.dtype
    size = standard_shape(shape, dtype)
    rows = (numbers_of(some).reshape(len(some), *size) for some in observations)
    return FullView(shape, standard_of(size, *rows) if prod(size) else None, dtype)


def standard_shape(shape: tuple[int, ...], dtype: np.dtype[Any]) -> tuple[int, ...]:
    """The shape of an observation's standard: that of numbers, else (D,), how many numbers it has."""
    sizes = [prod(size) for kind, size in fields_of(shape, dtype).values() if kind == NUMBERS]
    return shape if dtype == NUMBERS else (sum(sizes),)


class AgentView(nn.Module):
    """A window around the agent, found by the localiser; pixels outside the image are 0.

    All frames of a stack share the window around the agent in the last frame. ``shape`` is (height, width, C), in
    pixels, for pictures (H, W, C). ``needs_positions`` tells whether the localiser is an oracle that reads positions,
    which no policy may see.
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
        """Windows uint8 (N, height, width, C) of uint8 (N, H, W, C), with ``margin`` more pixels on every side.

        Positions, if the localiser reads them, are int64 (N, 3) of room, x, y.
        """
        height, width, channels = self.shape
        size = height + 2 * margin, width + 2 * margin
        seen = np.empty((len(observations), *size, channels), dtype=np.uint8)
        for start in range(0, len(observations), CUT_AT_ONCE):
            chunk = slice(start, start + CUT_AT_ONCE)
            centres = self.localiser.locate(observations[chunk], None if positions is None else positions[chunk])
            seen[chunk] = cut_windows(observations[chunk], centres, *size)
        return seen


def cut_windows(
    observations: NDArray[np.uint8], centres: NDArray[np.floating], height: int, width: int
) -> NDArray[np.uint8]:
    """Windows uint8 (N, height, width, C) of images uint8 (N, H, W, C); 0 outside the images.

    ``centres`` (N, 2) are the row and column of the middle pixel, or of the second of two middle pixels.
    """
    corner = np.floor(centres + 0.5).astype(np.int64) - (height // 2, width // 2)
    rows, rows_inside = _indices(corner[:, 0], height, observations.shape[1])
    columns, columns_inside = _indices(corner[:, 1], width, observations.shape[2])
    cut = observations[np.arange(len(observations))[:, None, None], rows[:, :, None], columns[:, None, :]]
    cut[~(rows_inside[:, :, None] & columns_inside[:, None, :])] = 0
    return cut


def _indices(first: NDArray[np.int64], count: int, size: int) -> tuple[NDArray[np.int64], NDArray[np.bool_]]:
    """``count`` indices from each ``first`` (N, count), clipped to 0..size-1, and which were inside."""
    indices = first[:, None] + np.arange(count)
    return indices.clip(0, size - 1), (indices >= 0) & (indices < size)


def positions_of(origins: Origins | None) -> NDArray[np.int64] | None:
    """Positions int64 (N, 3) of room, x, y from origins; None if these lack them."""
    if origins is None or not all(name in origins for name in POSITION):
        return None
    return np.stack([origins[name] for name in POSITION], axis=1).astype(np.int64)


def require_origins(origins: Origins | None, names: tuple[str, ...], setting: str) -> Origins:
    """The origins of states, with all these names; a ``UserError`` if one is missing."""
    origins = origins or {}
    if missing := ", ".join(name for name in names if name not in origins):
        do = "Collect data that do, or change the setting."
        raise UserError(f"the data do not say {missing} of each state", setting, do)
    return origins


def view_of(
    observations: Any,
    unlabelled: Any,
    config: EnsembleConfig,
    seed: int,
    origins: StateOrigins,
    *,
    fitted: bool,
) -> FullView | AgentView:
    """The members' view; ``fitted`` trains its localiser and computes its standard, else these are to be loaded."""
    shape = observations.shape[1:]
    if observations.dtype != PICTURE:
        for name, value in (("view", "full"), ("augment", "none"), ("jitter", 0), ("proposals", "none")):
            if (chosen := getattr(config, name)) != value:
                raise UserError("these observations are not pictures", f"{name}={chosen}", f"Set {name}={value}.")
        return full_view(observations, *([observations, unlabelled] if fitted else []))
    if config.view == "full":
        if config.jitter:
            raise UserError("only windows can be moved", f"jitter={config.jitter}", "Set view=agent-crop or jitter=0.")
        if config.augment == "grey-context":
            do = "Set view=agent-crop or augment=grey."
            raise UserError("the surroundings of the agent are not known", f"augment={config.augment}", do)
        return FullView(shape)
    if origins.agent_pixels is None:
        raise UserError("the agent's place in these observations is not known", "view=agent-crop", "Set view=full.")
    labelled = require_origins(origins.labelled, POSITION, "view=agent-crop")
    names = (POSITION if config.localiser == "ram" else ACTIONS) if len(unlabelled) else ()
    others = require_origins(origins.unlabelled, names, f"localiser={config.localiser}")
    if config.localiser == "ram":
        localiser: Localiser = RamLocaliser(origins.agent_pixels)
    elif not fitted:
        localiser = LearnedLocaliser(shape)
    else:
        # From labelled states with a living agent (a dying one is drawn elsewhere). Of unlabelled states the localiser
        # gets the agent's actions, which the agent knows, but not its positions.
        positions = np.stack([labelled[name] for name in POSITION], axis=1).astype(np.int64)
        alive = np.flatnonzero(labelled.get("dying", np.zeros(len(positions))) == 0)
        actions = np.stack([others.get(name, np.zeros(0, dtype=np.int64)) for name in ACTIONS], axis=1)
        usable = np.flatnonzero((actions >= 0).all(axis=1))
        pixels = origins.agent_pixels(positions[alive])
        localiser = fit_localiser(observations[alive], pixels, unlabelled[usable], actions[usable], seed)
    return AgentView(shape, config.crop_height, config.crop_width, localiser)
