"""Scenes with planted factors: drawn as MiniGrid draws them, aligned, mixed and crossed as they say."""

from __future__ import annotations

import numpy as np
import pytest
from minigrid.core.grid import Grid
from minigrid.core.world_object import Ball, Key, Wall
from scipy.stats import binomtest

from hypogoal.which_feature.states import (
    AGENT,
    CELLS,
    FLOOR,
    GOAL,
    INNER,
    OBJECT,
    TILE,
    _image,
    crossed_states,
    labelled_states,
    names_of,
    tiles,
    unlabelled_states,
)

BOTH = pytest.mark.parametrize("moved", [False, True])


def kinds(observations: np.ndarray) -> np.ndarray:
    """The kinds of tiles in the last frame of scenes, (N, 4, 4): read off the pixels."""
    images = observations[..., -3:]
    cells = images.reshape(len(images), INNER + 2, TILE, INNER + 2, TILE, 3).swapaxes(2, 3)[:, 1:-1, 1:-1]
    same = (cells[:, :, :, None] == tiles()).all(axis=(-3, -2, -1))
    assert (same.any(-1)).all()
    return np.asarray(same.argmax(-1))


def test_a_scene_is_drawn_as_minigrid_draws_it() -> None:
    """Pixel by pixel, the walls and the agent too."""
    grid = Grid(INNER + 2, INNER + 2)
    grid.wall_rect(0, 0, INNER + 2, INNER + 2)
    grid.set(1, 1, Key("blue"))
    grid.set(4, 3, Ball("red"))
    ids = np.full((1, CELLS), FLOOR)
    ids[0, 0], ids[0, 2 * INNER + 3], ids[0, INNER + 1] = OBJECT + 1, OBJECT + 2, AGENT + 3
    assert (_image(ids)[0] == grid.render(TILE, (2, 2), 3)).all()
    assert (tiles()[1] == Grid.render_tile(Wall(), tile_size=TILE).astype(np.uint8)).all()


@BOTH
def test_the_truth_is_what_is_seen(moved: bool) -> None:
    """Each factor, counted again from the pixels; all else is there whatever the factors are."""
    states = crossed_states(10, 3, moved)
    seen = kinds(states.observations)
    things = (seen >= OBJECT) & (seen < OBJECT + 4)
    assert (things.sum((1, 2)) == 1).all()
    column = things.any(1).argmax(1)
    kind = seen[things] - OBJECT
    boxes = ((seen >= OBJECT + 4) & (seen < GOAL)).sum((1, 2))
    truth = [kind % 2 == 1, kind >= 2, column >= INNER // 2, boxes > 2]
    if moved:
        before = kinds(states.observations[..., :3])
        truth.append((things & (before != seen)).any((1, 2)))
    assert (np.stack(truth, axis=1) == states.factors).all()
    assert set(boxes.tolist()) == {1, 2, 3, 4}
    assert (((seen >= AGENT) & (seen < OBJECT)).sum((1, 2)) == 1).all()


@BOTH
def test_labelled_states_are_aligned(moved: bool) -> None:
    """Whichever factor is the sub-goal, the labels are the same; half are positives."""
    factors = labelled_states(256, 0, moved).factors
    assert factors.shape == (256, len(names_of(moved)))
    assert (factors == factors[:, :1]).all()
    assert factors[:, 0].sum() == 128


@pytest.mark.parametrize("mix", [0.0, 0.1, 0.25, 0.5, 1.0])
def test_mix_is_the_share_of_states_drawn_factor_by_factor(mix: float) -> None:
    """Of those drawn factor by factor 14 of 16 are not aligned, so a state is not with a probability of 7/8 mix."""
    factors = unlabelled_states(4000, mix, 5).factors
    crossing = int((factors != factors[:, :1]).any(axis=1).sum())
    assert binomtest(crossing, 4000, mix * 7 / 8).pvalue > 1e-3 if mix else crossing == 0
    for holds in factors.T:
        assert binomtest(int(holds.sum()), 4000, 0.5).pvalue > 1e-4


@BOTH
def test_test_states_are_fully_crossed(moved: bool) -> None:
    """Every combination equally often."""
    factors = crossed_states(7, 0, moved).factors
    combinations, counts = np.unique(factors, axis=0, return_counts=True)
    assert len(combinations) == 2 ** len(names_of(moved))
    assert (counts == 7).all()


@BOTH
def test_a_seed_gives_the_same_bytes_and_another_others(moved: bool) -> None:
    """And so do the sets of one seed: what is not a factor is drawn anew in each."""
    makers = (
        lambda seed: labelled_states(64, seed, moved),
        lambda seed: unlabelled_states(64, 0.5, seed, moved),
        lambda seed: crossed_states(4, seed, moved),
        lambda seed: crossed_states(4, seed, moved, split="oracle"),
    )
    sets = {make: make(1).observations for make in makers}
    for make, images in sets.items():
        assert images.tobytes() == make(1).observations.tobytes()
        assert images.tobytes() != make(2).observations.tobytes()
    bodies = [{image.tobytes() for image in images} for images in sets.values()]
    assert len(set.union(*bodies)) == sum(len(some) for some in bodies)
    assert all(images.dtype == np.uint8 and images.shape[1:] == (48, 48, 6 if moved else 3) for images in sets.values())
