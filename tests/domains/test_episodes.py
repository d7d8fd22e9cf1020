"""What is kept of episodes, and what a success is in tables and checkpoints (Spec E7, F5, G1)."""

from pathlib import Path

import numpy as np
import pytest
from corridor import Corridor

from hypogoal.domains.base import Step
from hypogoal.domains.episodes import EpisodeRecorder
from hypogoal.options import tables
from hypogoal.options.tables import Episodes

YES, NO = np.ones(3, np.bool_), np.zeros(3, np.bool_)
REWARDS = np.array([1, 0, -1], np.float32)


def played(succeeded: np.ndarray | None) -> EpisodeRecorder:
    """Three environments end their episodes; then they are cut, all with a reward."""
    episodes = EpisodeRecorder(3)
    episodes.see(Step(np.arange(3), REWARDS, NO, NO, None if succeeded is None else NO))
    episodes.see(Step(np.arange(3), REWARDS, YES, NO, succeeded))
    episodes.see(Step(np.arange(3), np.abs(REWARDS) + 1, NO, YES, None if succeeded is None else ~succeeded))
    return episodes


def test_success_is_by_reward_or_as_the_domain_says() -> None:
    """Spec F5: a cut episode is none but where the domain says so."""
    assert [episode.succeeded for episode in played(None).rows] == [1, 0, 0, 0, 0, 0]
    own = played(np.array([False, True, True]))
    assert [episode.succeeded for episode in own.rows] == [0, 1, 1, 1, 0, 0]
    assert own.recent()["success"] == 0.5 and played(None).recent()["success"] == 1 / 6
    assert own.rows[:2] == [(6, 2, 2.0, 1, 0), (6, 2, 0.0, 1, 1)]


def test_steps_of_before_are_steps() -> None:
    """Spec B6: an engine of one's own may give a Step of the four arrays that each had."""

    class Old(Corridor):
        def step(self, actions: np.ndarray) -> Step:
            return Step(*super().step(actions)[:4])

    engine, episodes = Old(1), EpisodeRecorder(1)
    for _ in range(3):
        episodes.see(engine.step(np.array([1])))
    assert episodes.rows == [(3, 3, 1.0, 1, 1)]


def test_tables_and_checkpoints_keep_it(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Spec G1: as the domain says, or by reward."""
    for episodes in (played(np.array([False, True, True])), played(None)):
        Episodes.of_rows(episodes.rows).write(tmp_path)
        found = Episodes.read(tmp_path / "episodes.csv")
        assert found.succeeded.tolist() == [bool(row.succeeded) for row in episodes.rows]
        monkeypatch.setattr(tables, "LAST", 2)
        assert found.last().succeeded.tolist() == found.succeeded[-2:].tolist()
        assert found.rows() == episodes.rows
        again = EpisodeRecorder(3)
        again.restore(episodes.snapshot())
        assert again.rows == episodes.rows and again.steps == 9
