"""Sub-goals of Montezuma's Revenge from labels of one room: what nine of twelve ladders need.

``view``: a window around the agent, which a network finds that learned it from labelled states' positions and from
unlabelled ones' actions; in training batches most windows get other surroundings, all are moved and get other shades;
positives come equally often from each ladder. ``network`` and ``threshold``: for these windows. ``termination``: of an
option that hardly ever arrives. Commands: ``one_room.toml``. Results: ``docs/results/options.md``.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn
from torch.nn import functional

from hypogoal.core.arrays import Bools, Floats, Ints
from hypogoal.core.config import Config, setting
from hypogoal.core.drawing import DrawsFrom
from hypogoal.core.errors import UserError
from hypogoal.core.seeding import rng_for, seed_for, torch_generator
from hypogoal.domains.montezuma.emulator import SCREEN, SIDE, pixel
from hypogoal.hypotheses.networks import folded
from hypogoal.hypotheses.views import Origins, StateOrigins, View
from hypogoal.options.termination import TerminationRule

Pictures = NDArray[np.uint8]  # (N, H, W, C): frames, the latest last
Places = NDArray[np.float64]  # (N, 2): row and column of the agent's middle
HEIGHT, WIDTH = 24, 32  # of a window; the agent is 8 x 4 pixels
POSITIVES = 3 / 8  # of a labelled batch: 24 of 64, 8 from each of room 1's three ladders
HEAT_CELL, FEATURES = 4, 32  # pixels of a heat-map's cell, and what is known of it
AT_ONCE, BATCH, LEARNING_RATE, L2_WEIGHT = 64, 24, 2e-3, 1e-4  # of the network that finds the agent
STILL, MIRRORED, OTHER_SHADES, WITH_PATTERNS = 0.35, 0.5, 0.5, 0.7  # shares of its labelled states
FARTHEST_SHIFT, MOST_PATTERNS, MOST_BLOBS = 20, 3, 2
CLUTTER_NEAREST, CLUTTER_FARTHEST = (6, 4), (13, 11)  # rows and columns from the agent
CHANGED, WITH_PATTERN, BRIGHTEST = 0.7, 0.8, 200  # shares of members' windows
KEPT_LEAST, KEPT_MOST = (4, 7, 4, 4), (14, 14, 15, 15)  # pixels above, below, left and right of the agent
KNOTS, DARKEST, LIGHTEST = 8, (0.0, 0.2), (0.7, 1.0)  # segments of a map of shades; ranges of its black and white
ENOUGH, NEXT, LEAST = 0.05, 0.75, 0.5  # of thresholds that fall


def network(channels: int) -> tuple[list[nn.Module], tuple[int, ...]]:
    """A member network for windows, in which a rung of a ladder is 1 pixel high: the paper's first stride is 4."""
    first = [nn.Conv2d(channels, 16, kernel_size=5, stride=2, bias=False), nn.BatchNorm2d(16), nn.ReLU()]
    second = [nn.Conv2d(16, 32, kernel_size=5, stride=2, bias=False), nn.BatchNorm2d(32), nn.ReLU()]
    return first + second, (64,)


def median(labelled: NDArray[np.float32], labels: NDArray[np.bool_], unlabelled: NDArray[np.float32]) -> Any:
    """Thresholds (K,) for half of the labelled positives: policies exploit false positives, precision matters most."""
    return np.median(labelled[labels], axis=0)


class AgentViewSettings(Config):
    """What ``--set view.KEY=VALUE`` can change."""

    jitter: int = setting(3, "the most by which a window of a training batch is moved", unit="pixels", low=0, high=20)
    localiser_steps: int = setting(1500, "gradient steps of the network that finds the agent", low=1, high=1_000_000)


def observed_pixel(positions: NDArray[np.int64]) -> NDArray[np.float64]:
    """The agent's middle in an 84x84 observation, the resized picture: row, column (n, 2), for room, x, y (n, 3)."""
    scale = np.array([SIDE, SIDE]) / SCREEN
    rows_and_columns = pixel(positions)[:, ::-1]
    return (rows_and_columns + 0.5) * scale - 0.5


class AgentView(View):
    """A window around the agent in the last frame, the same in all frames; pixels outside the picture are 0."""

    Settings = AgentViewSettings
    changes = True

    def __init__(self, observation_shape: tuple[int, ...], settings: AgentViewSettings):
        super().__init__()
        self.shape = (HEIGHT, WIDTH, observation_shape[2])
        self.settings = settings
        with DrawsFrom(torch.Generator()):
            self.localiser = folded(heat_network(self.shape[2]).eval()).requires_grad_(False)

    def fit(self, labelled: Pictures, unlabelled: Pictures, origins: StateOrigins, seed: int) -> None:
        """Learn to find the agent: in labelled states, all else of which changes; in others by what its actions do."""
        positions = origins_of(origins.labelled, "room", "x", "y", "dying")
        actions = origins_of(origins.unlabelled, "action", "previous_action")
        alive = positions[:, 3] == 0  # a dying agent is drawn elsewhere
        acted = (actions >= 0).all(axis=1)  # not so in an episode's first states
        labelled, places = labelled[alive], observed_pixel(positions[alive, :3])
        unlabelled, actions = unlabelled[acted], actions[acted]
        seed = seed_for(seed, "localiser")
        with DrawsFrom(torch_generator(seed, "weights")):
            localiser = heat_network(labelled.shape[3])
            action_layer = nn.Conv2d(FEATURES, 2 * int(actions.max() + 1), kernel_size=1)
        weights = [*localiser.parameters(), *action_layer.parameters()]
        optimiser = torch.optim.Adam(weights, LEARNING_RATE, weight_decay=L2_WEIGHT)
        schedule = torch.optim.lr_scheduler.OneCycleLR(optimiser, LEARNING_RATE, self.settings.localiser_steps)
        rng = rng_for(seed, "states")
        for _ in range(self.settings.localiser_steps):
            drawn = rng.integers(len(labelled), size=BATCH)
            images, new_places = cluttered(labelled[drawn], places[drawn], rng)
            others = rng.integers(len(unlabelled), size=BATCH)
            images = np.concatenate([images, moved(unlabelled[others], rng)])
            features = localiser[:-1](frames_of(torch.from_numpy(images)))
            heat = localiser[-1](features)[:, 0]
            cells = np.floor((new_places + 0.5) / HEAT_CELL).astype(np.int64)
            seen = ((cells >= 0) & (cells < heat.shape[1:])).all(axis=1)
            wanted = torch.from_numpy(cells[seen, 0] * heat.shape[2] + cells[seen, 1])
            loss = functional.cross_entropy(heat[:BATCH].flatten(start_dim=1)[torch.from_numpy(seen)], wanted)
            loss = loss + action_loss(heat[BATCH:], action_layer(features[BATCH:]), torch.from_numpy(actions[others]))
            optimiser.zero_grad()
            loss.backward()
            optimiser.step()
            schedule.step()
        self.localiser = folded(localiser.eval()).requires_grad_(False)

    def see(self, observations: Pictures, margin: int = 0) -> Pictures:
        """Windows (N, HEIGHT, WIDTH, C), with ``margin`` more pixels on every side."""
        height, width = HEIGHT + 2 * margin, WIDTH + 2 * margin
        seen = np.empty((len(observations), height, width, self.shape[2]), dtype=np.uint8)
        for start in range(0, len(observations), AT_ONCE):
            some = slice(start, start + AT_ONCE)
            seen[some] = cut(observations[some], self.locate(observations[some]), height, width)
        return seen

    def locate(self, pictures: Pictures) -> Places:
        """The agent's places: the peaks of heat-maps, refined by the cells around."""
        device = next(self.localiser.parameters()).device
        with torch.inference_mode():
            heat = self.localiser(frames_of(torch.from_numpy(pictures).to(device, torch.float32)))[:, 0]
            peaks = heat.flatten(start_dim=1).argmax(dim=1)
            cells = torch.stack(torch.unravel_index(peaks, heat.shape[1:]), dim=1)
            around = functional.pad(heat, (1, 1, 1, 1), value=-torch.inf).unfold(1, 3, 1).unfold(2, 3, 1)
            nearby = around[torch.arange(len(cells)), cells[:, 0], cells[:, 1]].flatten(start_dim=1)
            shares = nearby.softmax(dim=1).view(-1, 3, 3)
            offsets = torch.tensor([-1.0, 0.0, 1.0], device=device)
            refined = cells + torch.stack([shares.sum(dim=2) @ offsets, shares.sum(dim=1) @ offsets], dim=1)
            return ((refined + 0.5) * HEAT_CELL - 0.5).double().cpu().numpy()

    def to_change(self, observations: Pictures) -> Pictures:
        """Windows with a margin, within which they can be moved."""
        return self.see(observations, self.settings.jitter)

    def change(self, batch: Pictures, rng: np.random.Generator | None) -> NDArray[Any]:
        """The middles of windows with a margin; with ``rng`` other parts, surroundings and shades, these in 0..1."""
        jitter = self.settings.jitter
        moves = np.full((len(batch), 2), jitter)
        if rng is not None:
            batch = other_surroundings(batch, rng)
            moves = rng.integers(2 * jitter + 1, size=moves.shape)
        windows = cut(batch, moves + np.array((HEIGHT // 2, WIDTH // 2)), HEIGHT, WIDTH)
        if rng is None:
            return windows
        states = np.arange(len(batch))[:, None, None, None]
        return shade_maps(len(batch), rng)[states, windows]

    def pools(self, labels: NDArray[np.bool_], origins: Origins) -> tuple[list[NDArray[np.int64]], float]:
        """The positives of each ladder, which take turns."""
        positives = np.flatnonzero(labels)
        ladders = origins_of(origins, "ladder")[positives, 0]
        return [positives[ladders == ladder] for ladder in np.unique(ladders)], POSITIVES


def origins_of(origins: Origins, *names: str) -> NDArray[np.int64]:
    """Where states come from, (N, names); a ``UserError`` if the data do not say it."""
    if missing := [name for name in names if name not in origins]:
        do = "Give states of 'hypogoal collect montezuma'."
        raise UserError(f"the data do not say {', '.join(missing)} of each state", "view=one_room:AgentView", do)
    return np.stack([origins[name] for name in names], axis=1).astype(np.int64)


def cut(pictures: Pictures, middles: NDArray[Any], height: int, width: int) -> Pictures:
    """Windows (N, height, width, C) around middles, the second of two middle pixels; 0 outside the pictures."""
    padded = np.pad(pictures, ((0, 0), (height, height), (width, width), (0, 0)))
    first = np.floor(middles + 0.5).astype(np.int64) + np.array((height - height // 2, width - width // 2))
    first = first.clip(0, np.array(padded.shape[1:3]) - (height, width))
    rows = first[:, :1] + np.arange(height)
    columns = first[:, 1:] + np.arange(width)
    return padded[np.arange(len(pictures))[:, None, None], rows[:, :, None], columns[:, None, :]]


def heat_network(channels: int) -> nn.Sequential:
    """Float (N, C, H, W), see :func:`frames_of` -> logits (N, 1, rows, columns) that the agent is in a cell."""
    return nn.Sequential(
        *(nn.Conv2d(channels, 16, kernel_size=5, stride=2, padding=2), nn.BatchNorm2d(16), nn.ReLU()),
        *(nn.Conv2d(16, 32, kernel_size=3, stride=2, padding=1), nn.BatchNorm2d(32), nn.ReLU()),
        *(nn.Conv2d(32, FEATURES, kernel_size=3, padding=1), nn.BatchNorm2d(FEATURES), nn.ReLU()),
        nn.Conv2d(FEATURES, 1, kernel_size=1),
    )


def frames_of(pictures: Tensor) -> Tensor:
    """Float (N, H, W, C) in 0..255 -> (N, C, H, W): the last frame, and the differences between frames."""
    frames = pictures.permute(0, 3, 1, 2) / 255.0
    return torch.cat([frames[:, -1:], frames[:, 1:] - frames[:, :-1]], dim=1)


def action_loss(heat: Tensor, logits: Tensor, actions: Tensor) -> Tensor:
    """-log of the probability of both actions (B, 2), by the cells' logits (B, 2 * actions, rows, columns).

    The heat-map weights the cells (inverse dynamics with attention): enemies tell nothing about actions.
    """
    shares = heat.flatten(start_dim=1).log_softmax(dim=1)
    by_cell = logits.view(len(heat), 2, -1, shares.shape[1]).log_softmax(dim=2)
    both = by_cell[torch.arange(len(heat))[:, None], torch.arange(2), actions].sum(dim=1)
    return -torch.logsumexp(shares + both, dim=1).mean()


def cluttered(pictures: Pictures, places: Places, rng: np.random.Generator) -> tuple[NDArray[np.float32], Places]:
    """States in 0..255 with all but the agent changed, and the agent's new places; in some it stands still."""
    images, places = pictures.astype(np.float32), places.copy()
    height, width = images.shape[1:3]
    still = rng.random(len(images)) < STILL
    images[still] = images[still][..., -1:]
    for image, place in zip(images, places, strict=True):
        if rng.random() < MIRRORED:
            image[:] = image[:, ::-1].copy()
            place[1] = width - 1 - place[1]
        place += shift(image, rng)
        free = np.ones((height, width), dtype=np.bool_)
        before, after = rng.integers(CLUTTER_NEAREST, CLUTTER_FARTHEST, size=(2, 2), endpoint=True)
        free[box(place - before, place + after)] = False
        if rng.random() < WITH_PATTERNS:
            for _ in range(rng.integers(1, MOST_PATTERNS, endpoint=True)):
                corner = rng.integers(-height // 4, height, size=2)
                at = box(corner, corner + rng.integers(8, height, size=2))
                image[at][free[at]] = pattern(height, width, rng)[at][free[at]]
        for _ in range(rng.integers(MOST_BLOBS, endpoint=True)):
            add_blob(image, free, rng)
        if rng.random() < OTHER_SHADES:
            image[:] = 255.0 * shade_maps(1, rng)[0][image.astype(np.uint8)]
    return images, places


def moved(pictures: Pictures, rng: np.random.Generator) -> NDArray[np.float32]:
    """States in 0..255, shifted, some with other shades."""
    images = pictures.astype(np.float32)
    for image in images:
        shift(image, rng)
        if rng.random() < OTHER_SHADES:
            image[:] = 255.0 * shade_maps(1, rng)[0][image.astype(np.uint8)]
    return images


def shift(image: NDArray[np.float32], rng: np.random.Generator) -> NDArray[np.int64]:
    """Shift an image (H, W, C) over black; returns the shift down and to the right (2,)."""
    move = rng.integers(-FARTHEST_SHIFT, FARTHEST_SHIFT, size=2, endpoint=True)
    top, left = FARTHEST_SHIFT - move
    padded = np.pad(image, ((FARTHEST_SHIFT, FARTHEST_SHIFT), (FARTHEST_SHIFT, FARTHEST_SHIFT), (0, 0)))
    image[:] = padded[top : top + image.shape[0], left : left + image.shape[1]]
    return move


def box(first: NDArray[Any], last: NDArray[Any]) -> tuple[slice, slice]:
    """From the first row and column up to the last, exclusive; negative ones are 0."""
    top, left, bottom, right = np.concatenate([first, last]).clip(0).astype(np.int64).tolist()
    return slice(top, bottom), slice(left, right)


def add_blob(image: NDArray[np.float32], free: NDArray[np.bool_], rng: np.random.Generator) -> None:
    """Draw a spotted or striped thing that moves through the frames of an image (H, W, C), where it is free."""
    height, width, frames = image.shape
    striped = rng.random() < 0.3
    size = rng.integers((8, 3), (20, 12)) if striped else rng.integers(3, 12, size=2)
    spots = rng.random((size[0], 1)) < 0.5 if striped else rng.random(size) < 0.7
    shown = (spots * np.ones(size)) * rng.uniform(60, 255)
    start = rng.uniform(0, (height, width))
    speed = rng.normal(0.0, 1.5, size=2)
    for frame in range(frames):
        if striped:
            shown = np.roll(shown, 1, axis=0)
        elif rng.random() < 0.2:
            shown = shown[:, ::-1]
        corner = np.floor(start + speed * frame).astype(np.int64)
        at = box(corner, corner + size)
        under = image[at][:, :, frame]
        top, left = np.maximum(-corner, 0)
        over = shown[top:, left:][: under.shape[0], : under.shape[1]]
        drawn = free[at] & (over > 0)
        under[drawn] = over[drawn]


def other_surroundings(windows: Pictures, rng: np.random.Generator) -> Pictures:
    """Windows, most with a pattern or one shade outside a box around the agent and its floor, or in half of that."""
    windows = windows.copy()
    height, width = windows.shape[1:3]
    row, column = height // 2, width // 2
    for index in np.flatnonzero(rng.random(len(windows)) < CHANGED):
        up, down, left, right = rng.integers(KEPT_LEAST, KEPT_MOST, endpoint=True)
        outside = np.ones((height, width), dtype=np.bool_)
        outside[max(row - up, 0) : row + down, max(column - left, 0) : column + right] = False
        kept = (np.s_[:0], np.s_[:, :column], np.s_[:, column:], np.s_[:row])[rng.integers(4)]
        outside[kept] = False
        shades = pattern(height, width, rng) if rng.random() < WITH_PATTERN else rng.integers(BRIGHTEST)
        windows[index][outside] = np.broadcast_to(shades, (height, width, 1))[outside].astype(np.uint8)
    return windows


def pattern(height: int, width: int, rng: np.random.Generator) -> NDArray[np.float64]:
    """A pattern (height, width, 1) in 0..255 of two or more shades: repeated bricks, or blocks."""
    dark, bright = np.sort(rng.uniform(0, 255, size=2))
    bricks = rng.random() < 0.6
    cell = np.array((1, 1)) if bricks else rng.integers(1, (5, 8))
    shape = rng.integers(2, 8, size=2) if bricks else -(-np.array((height, width)) // cell)
    shades = rng.random(shape)
    if rng.random() < 0.6:
        shades = (shades < (0.5 if bricks else rng.uniform(0.1, 0.9))).astype(np.float64)
    blocks = shades.repeat(cell[0], axis=0).repeat(cell[1], axis=1)
    repeated = np.tile(blocks, -(-np.array((height, width)) // blocks.shape))[:height, :width]
    return (dark + (bright - dark) * repeated)[:, :, None]


def shade_maps(count: int, rng: np.random.Generator) -> NDArray[np.float32]:
    """Random increasing maps of the shades 0..255 to 0..1, float32 (count, 256)."""
    rises = rng.random((count, KNOTS)) ** 2 + 0.02  # squared: steep in places, nearly level in others
    risen = np.concatenate([np.zeros((count, 1)), rises.cumsum(1)], axis=1) / rises.sum(1, keepdims=True)
    darkest, lightest = rng.uniform(*DARKEST, (count, 1)), rng.uniform(*LIGHTEST, (count, 1))
    at = np.linspace(0, KNOTS, 256)
    knot = np.minimum(at.astype(np.int64), KNOTS - 1)
    between = at - knot
    shades = risen[:, knot] * (1 - between) + risen[:, knot + 1] * between
    return (darkest + (lightest - darkest) * shades).astype(np.float32)


class Patience(TerminationRule):
    """After ``steps`` steps of an option that hardly ever arrives its threshold falls.

    It falls to ``NEXT`` of the highest log-odds among these steps, never below ``LEAST`` of the first threshold.
    """

    steps = 10_000
    CHANGING = (*TerminationRule.CHANGING, "_first", "_best", "_steps", "_executions", "_reaches", "_highest")

    def __init__(self, *arguments: Any, **more: Any):
        super().__init__(*arguments, **more)
        self._first = self.thresholds.copy()
        self._best = np.full(self.environments, -np.inf, dtype=np.float32)  # of each running execution
        self._steps, self._executions, self._reaches = np.zeros((3, self.options), dtype=np.int64)
        self._highest = np.full(self.options, -np.inf, dtype=np.float32)

    def reached(self, log_odds: Floats, options: Ints, age: Ints) -> Bools:
        self._best = np.where(age == 0, log_odds, np.maximum(self._best, log_odds))
        np.add.at(self._steps, options, 1)
        return self.positive(log_odds, options)

    def finished(self, environments: Ints, options: Ints, reached: Bools) -> None:
        np.add.at(self._executions, options, 1)
        np.add.at(self._reaches, options, reached)
        np.maximum.at(self._highest, options, self._best[environments])
        due = self._steps >= self.steps
        rarely = self._reaches < ENOUGH * self._executions
        lower = np.maximum(LEAST * self._first, NEXT * self._highest)
        self.thresholds = np.where(due & rarely, np.minimum(self.thresholds, lower), self.thresholds)
        self._steps[due] = self._executions[due] = self._reaches[due] = 0
        self._highest[due] = -np.inf
