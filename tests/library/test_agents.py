"""Options and classifiers in the hands of other people's agents: Gymnasium, stable-baselines3, sb3-contrib."""

import pickle
import shutil
import subprocess
import sys
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import pytest
import torch
from command_line import FIXED, run, settings, trusting
from corridor_env import CorridorEnv, Flipped, Grey
from gymnasium.utils.env_checker import check_env
from gymnasium.vector import SyncVectorEnv
from gymnasium.wrappers import TimeLimit
from numpy.typing import NDArray
from sb3_contrib import MaskablePPO
from stable_baselines3 import PPO
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.env_checker import check_env as check_sb3
from stable_baselines3.common.vec_env import DummyVecEnv
from toy_data import reseal

import hypogoal
from hypogoal.cli import main
from hypogoal.core.artefacts import open_artefact
from hypogoal.core.errors import UserError
from hypogoal.core.tensors import load_tensors
from hypogoal.hypotheses.ensemble import Ensemble
from hypogoal.meta.episodes import agent_of
from hypogoal.options.env import Options
from hypogoal.options.termination import TerminationRule

MEMBERS = 2


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The corridor's ensembles and options, learned until they are good."""
    made = tmp_path_factory.mktemp("runs") / "corridor"
    with trusting():
        layouts = settings("steps=200", "heldout_seeds=4,5")
        run("collect", "corridor_env:DOMAIN", "--out", made / "data.h5", "-q", *layouts)
        few = settings("steps=100", f"members={MEMBERS}", "workers=1", "learning_rate=1e-3", *FIXED)
        run("train-ensemble", made / "data.h5", "--out", made / "ensemble", "-q", *few)
        play = settings("steps=3000", "environments=4", "warm_up=100", "update_interval=4", "layout_seed=0")
        quick = settings("option_batch=32", "epsilon_steps=500", "max_episode_steps=30")
        run("train-options", made / "ensemble", "--out", made / "options", "-q", *play, *quick)
    return made


FORKED = """
import multiprocessing, sys, numpy, torch
from hypogoal.hypotheses.ensemble import Ensemble
torch.set_num_threads(2)
ensemble = Ensemble("doorkey", (48, 48, 3), 2, torch.Generator()).eval()
states = numpy.random.default_rng(0).integers(256, size=(200, 48, 48, 3), dtype=numpy.uint8)
ensemble.predict(states)
child = multiprocessing.get_context("fork").Process(target=ensemble.predict, args=[states])
child.start()
child.join(30)
alive = child.is_alive()
child.kill()
sys.exit(alive or child.exitcode)
"""


@pytest.mark.skipif(sys.platform != "linux", reason="elsewhere processes are spawned")
def test_a_forked_process_predicts() -> None:
    """Spec I6: as those of an AsyncVectorEnv do; torch's threads are not copied."""
    subprocess.run([sys.executable, "-W", "ignore", "-c", FORKED], check=True)


@pytest.fixture(scope="module")
def ensemble(made: Path) -> Ensemble:
    return hypogoal.load_ensemble(made / "ensemble", "right-end")


@pytest.fixture(scope="module")
def options(made: Path) -> Options:
    return hypogoal.load_options(made / "options")


def corridor() -> gymnasium.Env[Any, Any]:
    return TimeLimit(CorridorEnv(), 30)


class SameLayout(gymnasium.Wrapper):  # type: ignore[type-arg]
    """Every episode is on layout 0, where the options were learned."""

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        return self.env.reset(seed=0, options=options)


def test_options_do_what_their_members_say(options: Options) -> None:
    """Spec D1, E1: the learned options of both ends get there, the shortest way, and are masked where they are."""
    for option in range(options.count):
        env = hypogoal.OptionEnv(corridor(), options)
        env.reset(seed=0)
        assert env.action_masks().all()
        _, reward, terminated, truncated, info = env.step(option)
        right = option >= MEMBERS
        assert info["reached"] and not truncated
        assert (info["duration"], reward, terminated) == ((3, 1.0, True) if right else (2, 0.0, False))
        assert info["option"] == f"{'right' if right else 'left'}-end/{option % MEMBERS}"
        expected = [True, True, False, False] if right else [False, False, True, True]
        assert env.action_masks().tolist() == expected
    env = hypogoal.OptionEnv(corridor(), options, gamma=0.5)
    env.reset(seed=0)
    assert env.step(MEMBERS)[1] == 0.25, "a reward at the third step is discounted twice"


def test_a_masked_option_is_never_silent(options: Options) -> None:
    """Spec D6, E1: it runs with a warning, and info says so; where warnings are errors nothing is played."""
    env = hypogoal.OptionEnv(corridor(), options)
    env.reset(seed=0)
    assert env.step(0)[4]["masked"] is False
    assert env.action_masks().tolist() == [False, False, True, True]
    with pytest.warns(UserWarning, match="a masked option runs"):
        _, _, _, _, info = env.step(1)
    assert (info["masked"], info["duration"], info["reached"]) == (True, 1, True)
    with pytest.raises(UserWarning, match="a masked option runs"):
        env.step(1)
    _, _, terminated, _, info = env.step(2)
    assert terminated and info["duration"] == 5 and not info["masked"], "nothing was played in between"


@pytest.mark.filterwarnings("ignore:a masked option runs")
@pytest.mark.filterwarnings("ignore:.*is different from the unwrapped version")
def test_agents_without_masks_play_masked_options(options: Options, ensemble: Ensemble) -> None:
    """Spec E1: stable-baselines3's PPO, its checker and Gymnasium's, which draw from all actions."""
    env = hypogoal.OptionEnv(SameLayout(corridor()), options)
    for each in (
        hypogoal.OptionEnv(corridor(), options),
        hypogoal.SubgoalReward(ensemble).wrap(corridor(), ends=False),
    ):
        check_env(each, skip_render_check=True)
    check_sb3(env, skip_render_check=True)
    met: list[bool] = []

    class Met(BaseCallback):
        def _on_step(self) -> bool:
            met.extend(info["masked"] for info in self.locals["infos"])
            return True

    PPO("MlpPolicy", env, n_steps=64, batch_size=32, n_epochs=1, seed=0).learn(64, callback=Met())
    assert {*met} == {True, False}
    maskable = MaskablePPO("MlpPolicy", env, n_steps=64, batch_size=32, n_epochs=1, seed=0)
    met.clear()
    maskable.learn(64, callback=Met())
    assert met and not any(met)


class Falling(TerminationRule):
    """After twenty executions in all the thresholds of all options fall."""

    CHANGING = (*TerminationRule.CHANGING, "ended")

    def __init__(self, *arguments: Any, **more: Any):
        super().__init__(*arguments, **more)
        self.ended = 0

    def finished(self, environments: NDArray[np.int64], options: NDArray[np.int64], reached: NDArray[np.bool_]) -> None:
        self.ended += len(options)
        if self.ended >= 20:
            self.ended = 0
            self.thresholds = self.thresholds - np.float32(0.01)


def test_options_end_by_the_rule_they_were_trained_with(made: Path) -> None:
    """Spec H4: lowered thresholds go with the artefact, into train-meta, to agents and to other people's code."""
    play = settings("environments=4", "warm_up=100", "layout_seed=0", "max_episode_steps=30")
    ends = settings(f"termination={__name__}:Falling", "option_timeout=2", "option_batch=32")
    out, meta = made / "patient", made / "patient-meta"
    with trusting():
        sure = settings("steps=40", f"members={MEMBERS}", "workers=1", "threshold=0.9", *FIXED)
        ensemble = str(made / "sure")
        run("train-ensemble", made / "data.h5", "--out", ensemble, "-q", *sure)
        few = settings("steps=400")
        run("train-options", ensemble, "--out", out, "-q", *play, *ends, *few)
        lowered = load_tensors(out / "options.safetensors")["thresholds"].numpy()
        before = [hypogoal.load_ensemble(ensemble, goal).thresholds_as_log_odds() for goal in ("left-end", "right-end")]
        assert (lowered <= np.concatenate(before)).all() and (lowered < np.concatenate(before)).any()
        agent = ["train-meta", ensemble, "--options", str(out), "--out", str(meta), "-q", *play]
        agent += settings("chooser=ppo", "decisions=16")
        assert main([*agent, *ends, *settings("steps=40", f"termination={__name__}:Falling:1000")]) == 2  # another rule
        run(*agent, *ends, *settings("steps=40"))
        later = load_tensors(meta / "options.safetensors")["thresholds"].numpy()
        assert (later <= lowered).all()
        np.testing.assert_array_equal(agent_of(open_artefact(meta), 0).terminations.rule.thresholds, later)
        np.testing.assert_array_equal(hypogoal.load_options(out).rule.thresholds, lowered)
    with pytest.raises(UserError, match="names code of its own as its termination rule"):
        hypogoal.load_options(out)


def test_options_are_masked_as_they_were_trained(made: Path, options: Options) -> None:
    """Spec D6: with mask_reached=false options are offered where their sub-goals hold, to other agents too."""
    shutil.copytree(made / "options", made / "unmasked")
    config = open_artefact(made / "unmasked").config

    def unmasked(value: Any) -> Options:
        reseal(made / "unmasked", config={**config, "mask_reached": value})
        return hypogoal.load_options(made / "unmasked")

    for known, masks in ((options, [False, False, True, True]), (unmasked(False), [True] * 4)):
        env = hypogoal.OptionEnv(corridor(), known)
        env.reset(seed=0)
        env.step(0)  # to the left end, where the sub-goal of the first two holds
        assert env.action_masks().tolist() == masks


def test_options_go_to_another_process(made: Path, options: Options) -> None:
    """Spec E1: with their ensembles; what arrives says and does the same."""
    sent = pickle.loads(pickle.dumps(options))  # noqa: S301 - our own
    env = corridor()
    observation, _ = env.reset(seed=0)
    for action in (0, 0, 1, 1, 1, 1, 1):
        assert sent.offered(observation).tolist() == options.offered(observation).tolist()
        for option in range(4):
            assert sent.policies(option)(observation) == options.policies(option)(observation)
        observation, *_ = env.step(action)


def test_pictures_that_are_flipped_views(options: Options, ensemble: Ensemble) -> None:
    """Spec E1: as BGR to RGB gives them; networks see the same as of a copy."""
    env = hypogoal.OptionEnv(TimeLimit(Flipped(), 30), options)
    env.reset(seed=0)
    assert 1 <= env.step(0)[4]["duration"] <= options.timeout
    rewarded = hypogoal.SubgoalReward(ensemble).wrap(TimeLimit(Flipped(), 30))
    observation, _ = rewarded.reset(seed=0)
    rewarded.step(1)
    flipped, copied = observation[None], observation[None].copy()
    np.testing.assert_array_equal(ensemble.predict(flipped), ensemble.predict(copied))
    assert options.policies(0)(flipped[0]) == options.policies(0)(copied[0])


def test_pictures_without_an_axis_of_colours(tmp_path: Path) -> None:
    """Spec B6, E1: of an environment with observations (H, W) the networks are (H, W, 1), its wrappers take (H, W)."""
    with trusting():
        few = settings("steps=60", "heldout_seeds=4,5", "unlabelled_seeds=1")
        run("collect", "corridor_env:GREY", "--out", tmp_path / "data.h5", "-q", *few)
        few = settings("steps=2", f"members={MEMBERS}", "workers=1", *FIXED)
        run("train-ensemble", tmp_path / "data.h5", "--out", tmp_path / "e", "-q", *few)
        play = settings("steps=100", "environments=2", "layout_seed=0", "warm_up=50")
        run("train-options", tmp_path / "e", "--out", tmp_path / "o", "-q", *play)
    known = hypogoal.load_ensemble(tmp_path / "e", "left-end")
    assert known.observation_shape == (48, 48, 1)
    for env in (
        hypogoal.OptionEnv(TimeLimit(Grey(), 30), hypogoal.load_options(tmp_path / "o")),
        hypogoal.SubgoalReward(known).wrap(TimeLimit(Grey(), 30)),
    ):
        assert env.reset(seed=0)[0].shape == (48, 48)
        assert env.step(0)[0].shape == (48, 48)


@pytest.mark.parametrize("by", ["any", "vote", "all", 0, np.int64(1)])
def test_a_classifier_rewards_and_terminates(ensemble: Ensemble, by: str | int) -> None:
    """Spec D1: reward 1 where the classifier fires, else 0; with ``add`` the environment's own too."""
    reward = hypogoal.SubgoalReward(ensemble, by=by)
    env = reward.wrap(corridor())
    env.reset(seed=0)
    told = [env.step(action) for action in (0, 1, 1, 1, 1)]
    assert [paid for _, paid, _, _, _ in told] == [0, 0, 0, 0, 1]
    assert [info["subgoal"]["predicted"] for *_, info in told] == [False] * 4 + [True]
    assert [info["subgoal"]["paid"] for *_, info in told] == [0, 0, 0, 0, 1]
    rewards = reward(np.stack([observation for observation, *_ in told]))
    assert rewards.dtype == np.float32 and rewards.tolist() == [0, 0, 0, 0, 1]
    both = reward.wrap(corridor(), scale=0.5, add=True)
    both.reset(seed=0)
    assert [both.step(1)[1] for _ in range(3)] == [0, 0, 1.5]


def test_the_rule_of_a_reward_is_told_where_episodes_begin(ensemble: Ensemble, monkeypatch: pytest.MonkeyPatch) -> None:
    """As in training, because a rule may count per episode; each member is asked as an environment of its own."""
    told: list[list[int]] = []
    monkeypatch.setattr(TerminationRule, "begin_episodes", lambda _, members: told.append(members.tolist()))
    env = hypogoal.SubgoalReward(ensemble).wrap(corridor())
    for _ in range(2):
        env.reset(seed=0)
        env.step(1)
    assert told == [[*range(len(ensemble))]] * 2


def test_a_classifier_ends_an_episode(made: Path) -> None:
    """Spec D1: the left end is no end of the task, and of the episode only with the wrapper."""
    reward = hypogoal.SubgoalReward(made / "ensemble", "left-end")
    for ends in (True, False):
        env = reward.wrap(corridor(), ends=ends)
        env.reset(seed=0)
        assert [env.step(0)[2] for _ in range(2)] == [False, ends]


@pytest.mark.parametrize("vectorised", [SyncVectorEnv, DummyVecEnv])
def test_a_reward_is_shared_by_environments_side_by_side(ensemble: Ensemble, vectorised: Any) -> None:
    """Each is wrapped in its own function; each has its own reward, end and ``info``."""
    reward = hypogoal.SubgoalReward(ensemble)
    envs = vectorised([lambda: reward.wrap(corridor())] * 2)
    if vectorised is SyncVectorEnv:
        envs.reset(seed=0)
    else:
        envs.seed(0)
        envs.reset()
    told = [envs.step(np.array([first, 1])) for first in (0, 1, 1)]  # of two, only the second goes straight to the goal
    assert [step[1].tolist() for step in told] == [[0, 0], [0, 0], [0, 1]]
    ended, info = told[-1][2], told[-1][-1]
    assert ended.tolist() == [False, True]
    of_dict = isinstance(info, dict)
    held = info["subgoal"]["predicted"] if of_dict else [each["subgoal"]["predicted"] for each in info]
    assert np.array(held).tolist() == [False, True]
    envs.close()


class FromLeftEnd(gymnasium.Wrapper):  # type: ignore[type-arg]
    """Episodes begin at the left end, where one of the sub-goals holds."""

    def reset(self, **kwargs: Any) -> tuple[Any, dict[str, Any]]:
        _, info = self.env.reset(**kwargs)
        self.env.step(0)
        return self.env.step(0)[0], info


@pytest.mark.parametrize(
    ("start", "away", "paid"),
    [("unpaid", 1, [0, 0, 1, 0, 0, 0, 1]), ("unpaid", 2, [0, 0, 0, 0, 0, 0, 1]), ("paid", 1, [1, 0, 1, 0, 0, 0, 1])],
)
def test_an_episode_that_begins_inside(made: Path, start: str, away: int, paid: list[int]) -> None:
    """Doing nothing there is not paid, unless one wants it to be; the first such start is a warning."""
    reward = hypogoal.SubgoalReward(made / "ensemble", "left-end")
    env = reward.wrap(FromLeftEnd(corridor()), ends=False, start=start, away=away)
    with pytest.warns(UserWarning, match="an episode begins where the sub-goal's prediction is positive"):
        assert env.reset(seed=0)[1]["subgoal"] == {"predicted": True, "paid": 0.0}
    for _ in range(2):
        told = [env.step(action) for action in (0, 1, 0, 1, 1, 0, 0)]
        assert [info["subgoal"]["predicted"] for *_, info in told] == [True, False, True, False, False, False, True]
        assert [got for _, got, *_ in told] == paid
        env.reset(seed=0)  # without a warning, which would be an error here


def test_an_episode_that_begins_inside_can_be_refused(made: Path) -> None:
    reward = hypogoal.SubgoalReward(made / "ensemble", "left-end")
    env = reward.wrap(FromLeftEnd(corridor()), start="refuse")
    with pytest.raises(UserError, match="begins where the sub-goal's prediction is positive"):
        env.reset(seed=0)
    with pytest.raises(UserError, match="Choose one of unpaid, paid, refuse"):
        reward.wrap(corridor(), start="free")
    with pytest.raises(UserError, match="Give 1 or more"):
        reward.wrap(corridor(), away=0)


def test_mistakes_are_one_line(made: Path, options: Options, ensemble: Ensemble) -> None:
    """Spec G2."""
    other = gymnasium.wrappers.ResizeObservation(CorridorEnv(), (24, 24))
    for make in (lambda: hypogoal.OptionEnv(other, options), lambda: hypogoal.SubgoalReward(ensemble).wrap(other)):
        with pytest.raises(UserError, match=r"members were trained on other observations: uint8 \(24, 24, 3\)"):
            make()
    for by in ("most", "mean", 2, -1, None):
        with pytest.raises(UserError, match="Choose one of any, vote, all, or a member, 0 to 1"):
            hypogoal.SubgoalReward(ensemble, by=by)
    with pytest.raises(UserError, match="unknown sub-goal"):
        hypogoal.SubgoalReward(made / "ensemble")
    env = hypogoal.OptionEnv(corridor(), options)
    with pytest.raises(UserError, match="was not reset"):
        env.step(0)
    env.reset(seed=0)
    for action in (-1, options.count, 0.5, np.array([0, 1])):
        with pytest.raises(UserError, match=r"no such option: .*They are 0 to 3"):
            env.step(action)
    assert env.step(np.int64(0))[4]["duration"] == 2


def test_observations_may_be_listed(ensemble: Ensemble) -> None:
    """The contract of the Python interface: as arrays or as a list of them; of different shapes they are refused."""
    observation, _ = corridor().reset(seed=0)
    both = np.stack([observation, observation[::-1]])
    np.testing.assert_array_equal(ensemble.predict(list(both)), ensemble.predict(both))
    np.testing.assert_array_equal(ensemble.predictions(list(both)), ensemble.predictions(both))
    for odd in ([observation, observation[:9]], [], [1.0], "no"):
        with pytest.raises(UserError, match="observations do not fit the ensemble"):
            ensemble.predict(odd)
    assert hypogoal.UserError is UserError


def members_of(count: int) -> Ensemble:
    """Members that learned nothing."""
    return Ensemble("doorkey", (48, 48, 3), count, torch.Generator())


@pytest.mark.parametrize(("count", "least"), [(1, 1), (2, 2), (3, 2), (4, 3), (5, 3)])
def test_a_vote_takes_more_than_half_of_the_members(count: int, least: int) -> None:
    """Half of an even number is none; one and all of them by their rules."""
    says = np.tri(count + 1, count, -1) > 0  # none, one, ..., all
    for by, enough in (("any", 1), ("vote", least), ("all", count)):
        held = hypogoal.SubgoalReward(members_of(count), by=by).decide(says)
        assert held.tolist() == [number >= enough for number in range(count + 1)]


def test_steps_away_are_those_of_the_episode(monkeypatch: pytest.MonkeyPatch) -> None:
    """One in the first and one in the second are no two in a row: what begins inside is not yet paid."""
    monkeypatch.setattr(Ensemble, "log_odds", lambda _, seen: seen[:, 0, :1, 0] - 127.0)  # positive at the left end
    env = hypogoal.SubgoalReward(members_of(1)).wrap(FromLeftEnd(corridor()), away=2)
    with pytest.warns(UserWarning, match="an episode begins where"):
        env.reset(seed=0)
    env.step(1)
    env.reset(seed=0)
    told = [env.step(action) for action in (1, 0)]
    assert [info["subgoal"] for *_, info in told] == [{"predicted": at, "paid": 0.0} for at in (False, True)]
