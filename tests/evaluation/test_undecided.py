"""Where rewards have not told which member to take: rooms with counts of which the answer is known."""

from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest
import torch
from command_line import run, settings

from hypogoal.core.artefacts import Artefact
from hypogoal.core.progress import Progress
from hypogoal.core.tensors import save_tensors
from hypogoal.data import open_dataset
from hypogoal.evaluation import page, undecided
from hypogoal.evaluation.judging import Work
from hypogoal.evaluation.run import find
from hypogoal.options.choosers import FILE
from hypogoal.options.tables import Episodes

FEW = settings("steps=30", "diversity_weight=.01", "members=3")
PLAY = settings("chooser=symbols", "steps=60", "environments=1", "world=truth=shape")


@pytest.fixture(scope="module")
def rooms(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Three members, and an agent that plays some sixty episodes."""
    folder = tmp_path_factory.mktemp("rooms")
    run("collect", "rooms", "--out", folder / "data.h5", "-q")
    run("train-ensemble", folder / "data.h5", "--out", folder / "ensemble", *FEW, "-q")
    run("train-meta", folder / "ensemble", "--out", folder / "meta", *PLAY, "-q")
    return folder


def told(
    rooms: Path,
    succeeded: list[int],
    failed: list[int],
    episodes: int = 60,
    solved: float = 0.5,
    frozen: float | None = None,
) -> list[dict[str, Any]]:
    """What is said of counts (3,) of the three members' options, and of so many episodes."""
    count = len(succeeded) * 2
    option = np.repeat(np.arange(3), 2)
    rewarded = np.tile([1, 0], 3)
    outcomes = np.stack([np.zeros(count, np.int64), option, np.full(count, -1), rewarded], axis=1)
    executions = np.stack([succeeded, failed], axis=1).ravel().astype(float)
    sums = np.stack([executions, executions * rewarded, executions], axis=1)
    state = {"symbols": np.ones((1, 3), np.int64), "outcomes": outcomes, "sums": sums}
    save_tensors(rooms / "meta" / FILE, {name: torch.from_numpy(values) for name, values in state.items()})
    numbers = np.arange(episodes)
    successes = numbers % 10 < 10 * solved
    Episodes.cast(numbers + 1, np.ones(episodes), successes, np.ones(episodes), successes).write(rooms / "meta")
    work = Work(find(rooms), None, Progress("", 0, quiet=True))
    numbers = pd.DataFrame(columns=["scope", "quantity", "method", "artefact", "value"])
    if frozen is not None:
        numbers.loc[0] = ["frozen", "success", "option agent", "meta", frozen]
    return undecided.facts(work, numbers)["undecided"]


def test_two_members_whose_rewards_are_alike_are_undecided(rooms: Path) -> None:
    """Seven of 12 and six of 12; the third has none of 30, so it is out. The states are unlabelled ones of the data."""
    [found] = told(rooms, [7, 0, 6], [5, 30, 6])
    assert found["members"] == [0, 2]
    assert found["low"] < 0 < found["difference"] < found["high"]
    count = len(open_dataset(rooms / "data.h5").unlabelled())
    assert len(set(found["states"])) == undecided.NAMED and max(found["states"]) < count


@pytest.mark.parametrize(
    ("succeeded", "failed", "episodes", "solved"),
    [
        ([30, 0, 6], [2, 30, 24], 60, 0.9),  # decided
        ([400, 0, 400], [400, 30, 400], 900, 0.5),  # as good as each other, which labels would not change
        ([7, 0, 6], [5, 30, 6], 40, 0.5),  # too early
        ([7, 0, 6], [5, 30, 6], 60, 1.0),  # the task is solved
        ([12, 0, 0], [12, 0, 0], 60, 0.5),  # one was tried
    ],
)
def test_nothing_is_said_where_it_is_decided(
    rooms: Path, succeeded: list[int], failed: list[int], episodes: int, solved: float
) -> None:
    assert told(rooms, succeeded, failed, episodes, solved) == []


def test_what_it_plays_after_training_counts_before_its_training(rooms: Path) -> None:
    """While options learn they also explore, so training fails at times where the agent would not."""
    counts = [7, 0, 6], [5, 30, 6]
    assert told(rooms, *counts, solved=0.5, frozen=1.0) == []
    assert len(told(rooms, *counts, solved=1.0, frozen=0.5)) == 1


def test_an_ensemble_elsewhere_has_no_states_to_name(rooms: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Agents may be evaluated without the ensemble that they were made of."""
    counts = [7, 0, 6], [5, 30, 6]
    [known] = told(rooms, *counts)
    elsewhere = rooms.with_name("elsewhere")
    (rooms / "ensemble").rename(elsewhere)
    try:
        monkeypatch.setattr(Artefact, "input", lambda *_: elsewhere)
        [found] = told(rooms, *counts)
    finally:
        elsewhere.rename(rooms / "ensemble")
    assert known["states"] and found["states"] == []


def test_it_is_a_sentence_below_the_verdict() -> None:
    found = {"agent": "agent", "sub_goal": "lamp", "members": [0, 2], "episodes": 60, "data": "data.h5"}
    found |= {"difference": 0.051, "low": -0.2, "high": 0.3, "states": [7, 3]}
    nothing = {"findings": [], "agents": {}, "ladders": False, "solved": {}}
    *_, line = page.lines_of("verdict.txt", **nothing, undecided=[found])
    assert line == (
        "After 60 episodes agent cannot tell whether member 0 or 2 is better for lamp, because their values differ by "
        "0.05 with a 95 % interval from -0.20 to 0.30. So label the unlabelled states 7, 3 of data.h5: these labels "
        "would tell."
    )
