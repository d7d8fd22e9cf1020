"""Rooms: one is right, and only the world's setting says by which feature."""

import numpy as np
import pytest

from hypogoal.core.errors import UserError
from hypogoal.domains.base import load_domain
from hypogoal.domains.rooms.domain import DOMAIN
from hypogoal.domains.rooms.engine import DECKS
from hypogoal.domains.rooms.states import INNER, OBJECT, TILE, tiles


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
