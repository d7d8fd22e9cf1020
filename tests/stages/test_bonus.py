"""A flat agent with the same knowledge: members' first yeses as a bonus (Spec E7)."""

import csv
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from corridor import Corridor
from own_domain import DOMAIN, CorridorConfig

from hypogoal.cli import main
from hypogoal.core.artefacts import open_artefact
from hypogoal.core.checkpoints import Checkpoints, State
from hypogoal.core.errors import UserError
from hypogoal.hypotheses.config import TrainEnsembleConfig
from hypogoal.learners.baselines.agents import agent_snapshot, train
from hypogoal.learners.baselines.engine_env import Bonus, EngineEnv
from hypogoal.learners.baselines.settings import DQNSettings, PPOSettings
from hypogoal.options.termination import Terminations
from hypogoal.stages.collect import collect
from hypogoal.stages.train_ensemble import train_ensemble

PPO = PPOSettings(environments=4, rollout=32, batch=16, epochs=2, network="cells")
DQN = DQNSettings(environments=4, warm_up=40, replay=200, network="cells")
NAME = "own_domain:DOMAIN"


def ends(ids: np.ndarray) -> np.ndarray:
    """Two members: one says yes at the start and the cells beside it (1 to 3), one at both ends."""
    return np.stack([(ids > 0) & (ids < 4), (ids == 0) | (ids == 5)], axis=1)


def test_a_member_is_paid_for_once_an_episode_by_hand() -> None:
    """Cells 0..5, start at 2; the first yes of each, not the start's own, again in the next episode."""
    env = EngineEnv(Corridor(2, max_steps=6), Bonus(ends, 2, 2, 0.25))
    env.reset()
    #       to    3/1      4/0        5: over/0    3/1       4/0      5: over, 0: cut
    wanted = [[0.25, 0.25], [0, 0.25], [1.25, 0], [0.25, 0], [0, 0], [1.25, 0], [0.25, 0.25]]
    for paid in wanted:
        _, rewards, done, _ = env.step(np.array([1, 0]))
        assert rewards.tolist() == paid
        assert done[0] == (paid[0] > 1)
    assert env.episodes == [(6, 3, 1.0, 1, 1), (12, 3, 1.0, 1, 1), (12, 6, 0.0, 0, 0)]
    env.reset()
    assert env.step(np.array([1, 0]))[1].tolist() == [0.25, 0.25]
    assert env.step(np.array([1, 0]))[1].tolist() == [0, 0.25]
    assert env.step(np.array([0, 1]))[1].tolist() == [0, 0], "both are back among cells that were paid for"


class Broken(Exception):
    """The end of a process."""


class Breaking(Checkpoints):
    """Saves at the third offer and breaks off at the fourth."""

    offers = 0

    def offer(self, state: Callable[[], State]) -> None:
        self.offers += 1
        if self.offers == 3:
            self.save(state())
        if self.offers == 4:
            raise Broken


@pytest.mark.parametrize("chosen", [PPO, DQN])
def test_breaks_leave_no_trace(chosen: PPOSettings | DQNSettings, tmp_path: Path) -> None:
    """Spec G1: what has fired in the running episodes is state, and so are verdicts."""

    def run(checkpoints: Checkpoints) -> bytes:
        calls = iter(range(1, 1_000))

        def fickle(ids: np.ndarray) -> np.ndarray:
            return ends(ids) ^ (next(calls) % 2 == 0)  # whoever asks again hears something else

        judge = Terminations(fickle, 2)
        env = EngineEnv(Corridor(4, max_steps=13), Bonus(judge.of, 2, 4, 0.25, judge))
        agent = train(env, chosen, 320, seed=3, checkpoints=checkpoints)
        last = Checkpoints(tmp_path / "last.safetensors")
        last.save(agent_snapshot(agent, env))
        return (tmp_path / "last.safetensors").read_bytes()

    unbroken = run(Checkpoints(None))
    path = tmp_path / "checkpoint.safetensors"
    with pytest.raises(Broken):
        run(Breaking(path))
    saved = Checkpoints(path).load()
    assert saved is not None and saved["agent"]["env"]["bonus"]["_fired"].any()
    assert run(Checkpoints(path)) == unbroken


@pytest.fixture(scope="module")
def corridor(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run with an ensemble of the corridor, of two members a sub-goal."""
    folder = tmp_path_factory.mktemp("corridor")
    collect(DOMAIN, CorridorConfig(), folder / "data.h5", name=NAME, quiet=True)
    config = TrainEnsembleConfig(steps=30, members=2, workers=1)
    train_ensemble(folder / "data.h5", config, folder / "ensemble", quiet=True)
    return folder


def test_the_artefact_names_its_ensemble_and_episodes_are_the_tasks_own(
    corridor: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Spec A8, E7: whatever the bonus; an episode of the corridor earns 1 at the right end, else 0."""
    monkeypatch.setenv("HYPOGOAL_TRUST", "own_domain")
    command = ["train-baseline", NAME, "--ensemble", str(corridor / "ensemble"), "--set", "steps=1024", "--quiet"]
    assert main([*command, "--set", "bonus=7", "--out", str(corridor / "paid")]) == 0
    artefact = open_artefact(corridor / "paid", "baseline").whole()
    assert artefact.config["bonus"] == 7
    assert artefact.input("ensemble").samefile(corridor / "ensemble")
    rows = list(csv.DictReader((corridor / "paid" / "episodes.csv").read_text().splitlines()))
    assert rows and all(float(row["reward"]) == int(row["succeeded"]) for row in rows)


def test_a_bonus_and_an_ensemble_belong_together(corridor: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """One line that says what to give; an ensemble of another domain is refused, too."""
    out, ensemble = str(corridor / "refused"), ["--ensemble", str(corridor / "ensemble")]
    cases = (
        ([NAME, "--set", "bonus=.1"], "a bonus is paid where an ensemble's members are positive: bonus=0.1."),
        ([NAME, *ensemble], "an ensemble without a bonus changes nothing"),
        (["doorkey", *ensemble, "--set", "bonus=.1"], "this ensemble is for 'own_domain:DOMAIN', not for 'doorkey'"),
    )
    for words, told in cases:
        assert main(["train-baseline", *words, "--out", out]) == 2
        line = capsys.readouterr().err
        assert told in line and line.count("\n") == 1
    assert not Path(out).exists()


def test_bonuses_are_not_below_zero() -> None:
    with pytest.raises(UserError, match="bonus"):
        main(["train-baseline", "doorkey", "--set", "bonus=-1", "--out", "x", "--debug"])
