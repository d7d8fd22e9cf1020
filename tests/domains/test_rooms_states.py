"""Rooms: scenes with planted factors; one is right, and only the world's setting says by which feature."""

import numpy as np
import pytest
from minigrid.core.grid import Grid
from minigrid.core.world_object import Ball, Key
from scipy.stats import binomtest

from hypogoal.core.errors import UserError
from hypogoal.domains.find import load_domain
from hypogoal.domains.rooms.domain import DOMAIN
from hypogoal.domains.rooms.engine import DECKS
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
from tests.domains.draw_rooms import drawn

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
    assert np.array_equal(tiles(), drawn())


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


def seen(images: np.ndarray) -> dict[str, np.ndarray]:
    """Shape and place of the object, bool (N,), read off the pixels."""
    cells = images.reshape(len(images), INNER + 2, TILE, INNER + 2, TILE, 3).swapaxes(2, 3)[:, 1:-1, 1:-1]
    objects = tiles()[OBJECT : OBJECT + 4]  # red key, blue key, red ball, blue ball
    there = (cells[:, :, :, None] == objects).all(axis=(-3, -2, -1))  # (N, y, x, 4)
    return {"shape": there[..., 2:].any((1, 2, 3)), "place": there[:, :, INNER // 2 :].any((1, 2, 3))}


@pytest.mark.parametrize("truth", ["shape", "place"])
def test_one_room_of_each_set_is_right_and_it_has_the_true_feature(truth: str) -> None:
    """The other feature is as often there as not, in right rooms and in wrong ones."""
    engine = DOMAIN.make_engine(3, 4, truth=truth)
    plan = engine.plan()
    rooms = plan.following[:DECKS]
    assert rooms.shape == (DECKS, 5)
    assert (plan.solved[rooms].sum(axis=1) == 1).all()
    look = seen(engine.images(rooms.ravel()))
    right = plan.solved[rooms].ravel()
    assert (look[truth] == right).all()
    (other,) = {"shape", "place"} - {truth}
    for of in (right, ~right):
        assert 0.3 < look[other][of].mean() < 0.7
    before = seen(engine.images(np.arange(DECKS)))
    assert not (before["shape"] | before["place"]).any()


def test_going_into_a_room_ends_the_episode_and_the_right_one_is_rewarded() -> None:
    """As the plan says; then the next set of rooms."""
    engine = DOMAIN.make_engine(5, 3)
    plan = engine.plan()
    for begin in (0, 3, 6):
        assert engine.ids.tolist() == [begin, begin + 1, begin + 2]
        step = engine.step(np.array([0, 4, 2]))
        assert step.next_ids.tolist() == [plan.following[begin + e, action] for e, action in enumerate((0, 4, 2))]
        assert (step.rewards == plan.solved[step.next_ids]).all()
        assert step.terminated.all()
    assert (engine.labels(plan.ids)[:, 0] == plan.solved).all()


def test_layouts_differ_and_the_reward_alone_tells_truths_apart() -> None:
    """Two layouts have other rooms."""
    first, again, other = (DOMAIN.make_engine(seed, 1).images(np.arange(200)) for seed in (1, 1, 2))
    assert (first == again).all()
    assert (first != other).any()


@pytest.mark.parametrize("factors", [("shape", "shape"), ("place",)])
def test_a_truth_that_is_not_planted_is_refused(factors: tuple[str, ...]) -> None:
    """Where states are collected and where agents play."""
    with pytest.raises(UserError, match="each feature is planted once"):
        DOMAIN.make_engine(0, 1, factors=factors)


def test_files_of_0_23_name_them_otherwise() -> None:
    """In data and artefacts."""
    assert load_domain("which-feature") is DOMAIN
