"""Finding the agent in an observation: from the game's memory (an oracle), or learned (beyond the paper)."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn
from torch.nn import functional

from hypogoal.core.seeding import rng_for, seed_for
from hypogoal.hypotheses.changes import grey_maps, pattern
from hypogoal.hypotheses.networks import folded

HEAT_CELL = 4  # pixels: the side of a heat-map's cell
FEATURES = 32  # of a cell
LOCATED_AT_ONCE = 64  # states, when no gradient is kept
STEPS, BATCH, LEARNING_RATE, L2_WEIGHT = 1500, 24, 2e-3, 1e-4
HELD_SHARE = 0.35  # of the labelled states are shown without motion
FARTHEST_SHIFT = 20  # pixels
# Rows and columns from the agent, 8 x 4 pixels, at which clutter begins.
NEAREST, FARTHEST = (6, 4), (13, 11)
PATTERNS, PATTERN_SHARE = 3, 0.7  # most patterns in a state, and the share of states with any
BLOBS = 2  # most in a state
GREY_SHARE = 0.5  # of the states get other shades


AgentPixels = Callable[[NDArray[np.int64]], NDArray[np.float64]]  # positions (N, 3) -> row and column (N, 2)


class RamLocaliser(nn.Module):
    """The agent's pixel from its position in the game's memory, by the domain's ``agent_pixels``.

    It ignores the observation: an oracle, which must be named so wherever its results are shown.
    """

    needs_positions = True

    def __init__(self, pixels: AgentPixels):
        super().__init__()
        self.pixels = pixels

    def locate(
        self, observations: NDArray[np.uint8], positions: NDArray[np.int64] | None = None
    ) -> NDArray[np.float64]:
        """Row and column (N, 2) of the agent's middle in observations; from positions (N, 3)."""
        assert positions is not None
        return self.pixels(positions)


class LearnedLocaliser(nn.Module):
    """The agent's pixel from the observation, (H, W, C) with the latest frame last: the peak of a heat-map.

    A fully convolutional network sees the last frame, for the agent's looks, and the differences between frames, for
    its motion: (N, C, H, W) -> (N, 1, rows, columns), logits of cells of 4 x 4 pixels. None: a network to be loaded.
    """

    needs_positions = False

    def __init__(self, observation_shape: tuple[int, ...], network: nn.Sequential | None = None):
        super().__init__()
        self.network = network or folded(_heat_network(observation_shape[2]).eval())

    def locate(
        self, observations: NDArray[np.uint8], positions: NDArray[np.int64] | None = None
    ) -> NDArray[np.float64]:
        """Row and column (N, 2) of the agent's middle in observations uint8 (N, H, W, C)."""
        places = np.empty((len(observations), 2))
        device = next(self.network.parameters()).device
        with torch.inference_mode():
            for start in range(0, len(observations), LOCATED_AT_ONCE):
                chunk = slice(start, start + LOCATED_AT_ONCE)
                images = torch.from_numpy(observations[chunk]).to(device, torch.float32)
                places[chunk] = _peaks(self.network(_as_heat_input(images))[:, 0]).cpu().numpy()
        return places


Localiser = RamLocaliser | LearnedLocaliser


def fit_localiser(
    observations: NDArray[np.uint8],
    pixels: NDArray[np.float64],
    unlabelled: NDArray[np.uint8],
    actions: NDArray[np.int64],
    seed: int,
    *,
    steps: int = STEPS,
) -> LearnedLocaliser:
    """A localiser, trained on states (N, H, W, C) with known agent positions and on others with known actions.

    It must find the agent in rooms that it never saw. So each labelled state is mirrored, shifted, filled with random
    patterns and moving things around the agent, and its shades are changed. What stays is the agent and its motion;
    its row and column in the last frame are ``pixels`` (N, 2).
    In unlabelled states (M, H, W, C), if any, the agent reveals the ``actions`` (M, 2), 0 or more, that led to the last
    frame and to the one before: each cell of the heat-map predicts them, and the heat-map, a distribution over cells,
    weights the predictions (inverse dynamics with attention). So it learns that enemies are not the agent. On one CPU
    the same arguments give the same bytes.
    """
    n_actions = int(actions.max(initial=0)) + 1
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed_for(seed, "weights"))
        network = _heat_network(observations.shape[3])
        action_layer = nn.Conv2d(FEATURES, 2 * n_actions, kernel_size=1)
    weights = [*network.parameters(), *action_layer.parameters()]
    optimiser = torch.optim.Adam(weights, LEARNING_RATE, weight_decay=L2_WEIGHT)
    schedule = torch.optim.lr_scheduler.OneCycleLR(optimiser, LEARNING_RATE, steps)
    rng = rng_for(seed, "states")
    for _ in range(steps):
        drawn = rng.integers(len(observations), size=BATCH)
        images, places = _changed(_held(observations[drawn], rng), pixels[drawn], rng)
        extra = rng.integers(max(len(unlabelled), 1), size=BATCH if len(unlabelled) else 0)
        images = np.concatenate([images, _moved(unlabelled[extra], rng)])
        features = network[:-1](_as_heat_input(torch.from_numpy(images)))
        heat = network[-1](features)[:, 0]
        loss = _heat_loss(heat[:BATCH], places)
        if len(extra):
            loss = loss + _action_loss(heat[BATCH:], action_layer(features[BATCH:]), torch.from_numpy(actions[extra]))
        optimiser.zero_grad()
        loss.backward()
        optimiser.step()
        schedule.step()
    return LearnedLocaliser(observations.shape[1:], folded(network.eval()).requires_grad_(False))


def _held(observations: NDArray[np.uint8], rng: np.random.Generator) -> NDArray[np.uint8]:
    """Replace all frames of some states uint8 (B, H, W, C) by their last: an agent that stands still."""
    held = rng.random(len(observations)) < HELD_SHARE
    observations[held] = observations[held][..., -1:]
    return observations


def _heat_loss(heat: Tensor, places: NDArray[np.float64]) -> Tensor:
    """Cross entropy of heat-maps (B, rows, columns) as distributions over cells; ignores agents out of sight."""
    cells = np.floor((places + 0.5) / HEAT_CELL).astype(np.int64)
    seen = ((cells >= 0) & (cells < heat.shape[1:])).all(1)
    cell = torch.from_numpy((cells[:, 0] * heat.shape[2] + cells[:, 1])[seen])
    return functional.cross_entropy(heat.flatten(start_dim=1)[torch.from_numpy(seen)], cell)


def _action_loss(heat: Tensor, logits: Tensor, actions: Tensor) -> Tensor:
    """-log of the probability of both actions (B, 2), by the cells' logits (B, 2 * n_actions, rows, columns)."""
    count = len(heat)
    shares = heat.flatten(start_dim=1).log_softmax(dim=1)
    by_cell = logits.view(count, 2, -1, shares.shape[1]).log_softmax(dim=2)
    both = by_cell[torch.arange(count)[:, None], torch.arange(2), actions].sum(dim=1)
    return -torch.logsumexp(shares + both, dim=1).mean()


def _heat_network(channels: int) -> nn.Sequential:
    return nn.Sequential(
        nn.Conv2d(channels, 16, kernel_size=5, stride=2, padding=2),
        nn.BatchNorm2d(16),
        nn.ReLU(),
        nn.Conv2d(16, 32, kernel_size=3, stride=2, padding=1),
        nn.BatchNorm2d(32),
        nn.ReLU(),
        nn.Conv2d(32, FEATURES, kernel_size=3, padding=1),
        nn.BatchNorm2d(FEATURES),
        nn.ReLU(),
        nn.Conv2d(FEATURES, 1, kernel_size=1),
    )


def _as_heat_input(images: Tensor) -> Tensor:
    """Float (N, H, W, C) in 0..255 -> (N, C, H, W): the last frame in 0..1, and the differences between frames."""
    frames = images.permute(0, 3, 1, 2) / 255.0
    return torch.cat([frames[:, -1:], frames[:, 1:] - frames[:, :-1]], dim=1)


def _peaks(heat: Tensor) -> Tensor:
    """Row and column (N, 2), in pixels, of the peaks of heat-maps (N, rows, columns), refined by the cells around."""
    count, _, columns = heat.shape
    peak = heat.flatten(start_dim=1).argmax(dim=1)
    around = functional.pad(heat, (1, 1, 1, 1), value=-torch.inf).unfold(1, 3, 1).unfold(2, 3, 1)
    cell = torch.stack([peak // columns, peak % columns], dim=1)
    shares = around[torch.arange(count), cell[:, 0], cell[:, 1]].flatten(start_dim=1).softmax(dim=1).view(count, 3, 3)
    offsets = torch.tensor([-1.0, 0.0, 1.0], device=heat.device)
    refined = cell + torch.stack([shares.sum(dim=2) @ offsets, shares.sum(dim=1) @ offsets], dim=1)
    return (refined + 0.5) * HEAT_CELL - 0.5


def _changed(
    observations: NDArray[np.uint8], pixels: NDArray[np.float64], rng: np.random.Generator
) -> tuple[NDArray[np.float32], NDArray[np.float64]]:
    """States float32 (B, H, W, C) in 0..255 with all but the agent changed, and the agent's new places (B, 2)."""
    images, places = observations.astype(np.float32), pixels.copy()
    height, width = images.shape[1:3]
    for image, place in zip(images, places, strict=True):
        if rng.random() < 0.5:
            image[:] = image[:, ::-1].copy()
            place[1] = width - 1 - place[1]
        place += _shift(image, rng)
        free = np.ones((height, width, 1), dtype=np.bool_)
        before, after = rng.integers(NEAREST, FARTHEST, size=(2, 2), endpoint=True)
        free[_box(place - before, place + after)] = False
        if rng.random() < PATTERN_SHARE:
            for _ in range(rng.integers(1, PATTERNS, endpoint=True)):
                corner = rng.integers(-height // 4, height, size=2)
                box = _box(corner, corner + rng.integers(8, height, size=2))
                image[box] = np.where(free[box], pattern(height, width, rng)[box], image[box])
        for _ in range(rng.integers(BLOBS, endpoint=True)):
            _add_blob(image, free, rng)
        _change_shades(image, rng)
    return images, places


def _moved(observations: NDArray[np.uint8], rng: np.random.Generator) -> NDArray[np.float32]:
    """States float32 (B, H, W, C) in 0..255, shifted, some with other shades."""
    images = observations.astype(np.float32)
    for image in images:
        _shift(image, rng)
        _change_shades(image, rng)
    return images


def _change_shades(image: NDArray[np.float32], rng: np.random.Generator) -> None:
    if rng.random() < GREY_SHARE:
        image[:] = 255.0 * grey_maps(1, rng)[0][image.astype(np.uint8)]


def _shift(image: NDArray[np.float32], rng: np.random.Generator) -> NDArray[np.int64]:
    """Shift an image (H, W, C) over black; returns the shift down and to the right (2,)."""
    shift = rng.integers(-FARTHEST_SHIFT, FARTHEST_SHIFT, size=2, endpoint=True)
    down, right = shift.tolist()
    height, width = image.shape[:2]
    moved = image[max(-down, 0) : height - down, max(-right, 0) : width - right].copy()
    image[:] = 0.0
    image[max(down, 0) : height + down, max(right, 0) : width + right] = moved
    return shift


def _box(first: NDArray[np.floating | np.integer], last: NDArray[np.floating | np.integer]) -> tuple[slice, slice]:
    """The box from the first row and column up to the last, exclusive, without negative ones."""
    top, left = np.maximum(first, 0).astype(np.int64).tolist()
    bottom, right = np.maximum(last, 0).astype(np.int64).tolist()
    return slice(top, bottom), slice(left, right)


def _add_blob(image: NDArray[np.float32], free: NDArray[np.bool_], rng: np.random.Generator) -> None:
    """Draw a spotted or striped thing that moves through the frames of an image (H, W, C), where it is free."""
    height, width, frames = image.shape
    striped = rng.random() < 0.3
    size = rng.integers((8, 3), (20, 12)) if striped else rng.integers(3, 12, size=2)
    spots = rng.random((size[0], 1)) < 0.5 if striped else rng.random(size) < 0.7
    shown = (spots * np.ones(size)) * rng.uniform(60, 255)
    at, speed = rng.uniform(0, (height, width)), rng.normal(0.0, 1.5, size=2)
    for frame in range(frames):
        if striped:
            shown = np.roll(shown, 1, axis=0)
        elif rng.random() < 0.2:
            shown = shown[:, ::-1]
        corner = np.floor(at + speed * frame).astype(np.int64)
        box = _box(corner, corner + size)
        under = image[box][:, :, frame]
        top, left = np.maximum(-corner, 0)
        over = shown[top:, left:][: under.shape[0], : under.shape[1]]
        image[box][:, :, frame] = np.where(free[box][:, :, 0] & (over > 0), over, under)
