"""Scenes with planted factors: drawn as MiniGrid draws them, aligned, mixed and crossed as they say."""

import numpy as np
import pytest
from minigrid.core.grid import Grid
from minigrid.core.world_object import Ball, Key, Wall
from scipy.stats import binomtest

from hypogoal.domains.rooms.states import (
    AGENT,
    CELLS,
    FACTORS,
    FLOOR,
    GOAL,
    INNER,
    OBJECT,
    TILE,
    crossed_states,
    draw_pictures,
    labelled_states,
    tiles,
    unlabelled_states,
)

SETS = pytest.mark.parametrize("names", [FACTORS, ("shape", "place"), ("count", "colour")])


def kinds(observations: np.ndarray) -> np.ndarray:
    """The kinds of tiles in scenes, (N, 4, 4): read off the pixels."""
    cells = observations.reshape(len(observations), INNER + 2, TILE, INNER + 2, TILE, 3).swapaxes(2, 3)[:, 1:-1, 1:-1]
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
    assert (draw_pictures(ids)[0] == grid.render(TILE, (2, 2), 3)).all()
    assert (tiles()[1] == Grid.render_tile(Wall(), tile_size=TILE).astype(np.uint8)).all()


@SETS
def test_the_truth_is_what_is_seen(names: tuple[str, ...]) -> None:
    """Each factor, counted again from the pixels; all else is there whatever the factors are."""
    states = crossed_states(10, 3, names)
    seen = kinds(states.observations)
    things = (seen >= OBJECT) & (seen < OBJECT + 4)
    assert (things.sum((1, 2)) == 1).all()
    column = things.any(1).argmax(1)
    kind = seen[things] - OBJECT
    boxes = ((seen >= OBJECT + 4) & (seen < GOAL)).sum((1, 2))
    truth = {"colour": kind % 2 == 1, "shape": kind >= 2, "place": column >= INNER // 2, "count": boxes > 2}
    assert (np.stack([truth[name] for name in names], axis=1) == states.factors).all()
    for name in set(FACTORS) - set(names):  # they vary freely
        assert binomtest(int(truth[name].sum()), len(kind), 0.5).pvalue > 1e-4
        assert abs(np.corrcoef(truth[name], states.factors[:, 0])[0, 1]) < 0.5
    assert set(boxes.tolist()) == {1, 2, 3, 4}
    assert (((seen >= AGENT) & (seen < OBJECT)).sum((1, 2)) == 1).all()


@SETS
def test_labelled_states_are_aligned(names: tuple[str, ...]) -> None:
    """Whichever factor is the sub-goal, the labels are the same; half are positives."""
    factors = labelled_states(256, 0, names).factors
    assert factors.shape == (256, len(names))
    assert (factors == factors[:, :1]).all()
    assert factors[:, 0].sum() == 128


@pytest.mark.parametrize("mix", [0.0, 0.1, 0.25, 0.5, 1.0])
def test_mix_is_the_share_of_states_drawn_factor_by_factor(mix: float) -> None:
    """Of those drawn factor by factor 14 of 16 are not aligned, so a state is not with a probability of 7/8 mix."""
    factors = unlabelled_states(4000, mix, 5, FACTORS).factors
    crossing = int((factors != factors[:, :1]).any(axis=1).sum())
    assert binomtest(crossing, 4000, mix * 7 / 8).pvalue > 1e-3 if mix else crossing == 0
    for holds in factors.T:
        assert binomtest(int(holds.sum()), 4000, 0.5).pvalue > 1e-4


@SETS
def test_test_states_are_fully_crossed(names: tuple[str, ...]) -> None:
    """Every combination equally often."""
    factors = crossed_states(7, 0, names).factors
    combinations, counts = np.unique(factors, axis=0, return_counts=True)
    assert len(combinations) == 2 ** len(names)
    assert (counts == 7).all()
