"""Rooms: one is right, and only the world's setting says by which feature."""

from __future__ import annotations

import csv
import re
from pathlib import Path

import numpy as np
import pytest
from openings import agrees

from hypogoal.cli import main
from hypogoal.core.errors import UserError
from hypogoal.domains.base import load_domain
from hypogoal.domains.rooms.domain import DECKS, DOMAIN
from hypogoal.domains.rooms.states import INNER, OBJECT, TILE, tiles
from hypogoal.evaluation.choosing import FROZEN, UNIFORM


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


def test_an_agent_finds_the_member_that_the_reward_asks_for(tmp_path: Path) -> None:
    """From the command line: one ensemble, two worlds; chance among the same members does worse."""
    data, ensemble, numbers = tmp_path / "data", tmp_path / "ensemble", {}
    assert main(["collect", "rooms", "--out", str(data), "--quiet"]) == 0
    assert main(["train-ensemble", str(data), "--out", str(ensemble), "--seed", "100", "--quiet"]) == 0
    for truth in ("shape", "place"):
        out = tmp_path / truth
        settings = ["--set", f"world=truth={truth}", "--set", "steps=3000"]
        assert main(["train-meta", str(ensemble), "--out", str(out), "--layout-seed", "100", *settings, "--quiet"]) == 0
        assert main(["evaluate", str(out), "--out", str(tmp_path / f"of-{truth}"), "--quiet"]) == 0
        with (tmp_path / f"of-{truth}" / "numbers.csv").open(newline="") as file:
            rows = [row for row in csv.DictReader(file) if (row["scope"], row["quantity"]) == (FROZEN, "success")]
        numbers[truth] = {row["method"] == UNIFORM: float(row["value"]) for row in rows}
    assert all(solved[False] >= 0.8 and solved[False] - solved[True] >= 0.15 for solved in numbers.values()), numbers


def test_the_page_says_and_shows_what_competes(tmp_path: Path) -> None:
    """Spec I1: what the rooms are, which features compete, which one is rewarded; scenes of both; a verdict."""
    run, data = tmp_path / "run", tmp_path / "run" / "data.h5"
    assert main(["collect", "rooms", "--out", str(data), "--quiet"]) == 0
    for name, words in {"dbat": ["--members", "2"], "one": ["--members", "1", "--diversity", "none"]}.items():
        ensemble, agent = (str(run / kind / name) for kind in ("ensemble", "agent"))
        few = ["--set", "steps=20", "--set", "workers=1", "--quiet"]
        assert main(["train-ensemble", str(data), "--out", ensemble, *words, *few]) == 0
        assert (
            main(["train-meta", ensemble, "--out", agent, "--layout-seed", "3", "--set", "steps=500", "--quiet"]) == 0
        )
    assert main(["evaluate", str(run), "--quiet"]) == 0 and main(["report", str(run)]) == 0
    agrees(run, "Enter one of 5 rooms; only that where the object is a ball (shape) gives a reward of 1", "One run is")
    page = (run / "report" / "index.html").read_text(encoding="utf-8")
    task = page[: page.index("Choosing" if "Choosing" in page else "Whether")]
    assert "The labels fit place (the object is in the right half) as well" in task
    cards = re.findall(r'<div class="card">.*?alt="(.*?)">.*?<ul class="verdicts">(.*?)</ul>', page, re.S)[:4]
    told = {title: re.findall(r"(shape|place): (yes|no)", lines) for title, lines in cards}
    assert told["labelled: positive"] == [("shape", "yes"), ("place", "yes")]
    assert told["a room: right, reward 1"] == [("shape", "yes"), ("place", "no")]
    assert told["a room: wrong"] == [("shape", "no"), ("place", "yes")]


@pytest.mark.parametrize("truth", ["shape", "place"])
def test_scenes_are_what_they_are_called(truth: str) -> None:
    """Read off their pixels."""
    scenes = DOMAIN.scenes({"truth": truth})
    look = seen(np.stack([scene.picture for scene in scenes]))
    for index, scene in enumerate(scenes):
        assert {name: bool(values[index]) for name, values in look.items()} == scene.features
    assert [scene.features[truth] for scene in scenes] == [True, False, True, False]
