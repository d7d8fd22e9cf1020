"""Domains made from Gymnasium environments: collection, the engine, and what users get wrong (Spec B6, B7)."""

from itertools import count
from types import SimpleNamespace
from typing import Any

import corridor_env
import gymnasium
import numpy as np
import pytest
from corridor_env import DOMAIN, LENGTH, SHAPE, SUB_GOALS, CorridorEnv
from gymnasium import spaces

from hypogoal.core.errors import UserError
from hypogoal.core.progress import Progress
from hypogoal.data import Collected
from hypogoal.domains.gymnasium import play
from hypogoal.domains.gymnasium.domain import GymnasiumConfig, GymnasiumDomain
from hypogoal.domains.gymnasium.engine import GymnasiumEngine
from hypogoal.domains.gymnasium.reader import reader_of
from hypogoal.meta.config import TrainMetaConfig
from hypogoal.meta.setup import require_memory

SMALL = GymnasiumConfig(heldout_seeds=(4, 5), steps=80)


def collected(domain: GymnasiumDomain = DOMAIN, config: GymnasiumConfig = SMALL, seed: int = 0) -> Collected:
    return domain.collect(config, seed, Progress("collect", 1, quiet=True))


def engine_of(number: int = 3, **arguments: int) -> GymnasiumEngine:
    return DOMAIN.make_engine(0, number, 30, **arguments)


def test_collection_has_each_picture_once_with_its_labels() -> None:
    """Spec A1, B7: random play on each layout; held-out states are none of those for learning."""
    found = collected(config=SMALL.model_copy(update={"heldout_seeds": (3, 4)}))
    assert found.labelled.observations.shape == (LENGTH, 48, 48, 3)
    cells = found.labelled.observations[:, 0, ::8, 0].argmax(1)
    assert sorted(cells.tolist()) == list(range(LENGTH))
    np.testing.assert_array_equal(found.labelled.labels, np.stack([cells == 0, cells == LENGTH - 1], 1))
    assert set(found.heldout.origins["layout_seed"].tolist()) == {4}, "layout 3 looks like one of those for learning"
    known = {image.tobytes() for states in (found.labelled, found.unlabelled) for image in states.observations}
    assert not known & {image.tobytes() for image in found.heldout.observations}


def test_policies_share_the_steps() -> None:
    """Spec B7: one policy a sub-goal, as many steps each; None is random play."""
    few = GymnasiumConfig(unlabelled_seeds=(1,), heldout_seeds=(4,), steps=60, explore=0.0)
    counts = [0, 0]

    def going(action: int) -> Any:
        def act(env: gymnasium.Env, observation: np.ndarray, rng: np.random.Generator) -> int:
            counts[action] += 1
            return action

        return act

    both = GymnasiumDomain(CorridorEnv, SUB_GOALS, policy={"left-end": going(0), "right-end": going(1)})
    assert collected(both, few).labelled.labels.sum(0).tolist() == [1, 1]
    assert counts == [3 * 30, 3 * 30]
    counts[0] = 0
    collected(GymnasiumDomain(CorridorEnv, SUB_GOALS, policy={"left-end": going(0), "right-end": None}), few)
    assert counts == [3 * 30, 3 * 30]


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("WORDY", "observations must be images, uint8 .* or numbers"),
        ("MIXED", "observations mix pictures with other values: 0. Give a Dict with each picture under a key"),
        ("STEERED", "actions must be Discrete"),
        ("NEVER", "on-the-moon has no positives"),
        ("ALWAYS", "somewhere has no negatives"),
    ],
)
def test_what_cannot_be_collected_is_one_line(name: str, message: str) -> None:
    """Spec G2."""
    with pytest.raises(UserError, match=message):
        collected(getattr(corridor_env, name))


class Deaf(CorridorEnv):
    """Its first reset alone heeds the seed."""

    def reset(self, **arguments: Any) -> Any:
        return super().reset(seed=None if self._np_random else arguments["seed"])


def test_an_environment_that_loses_its_seed_is_not_collected() -> None:
    """Spec B7: its states would be of other layouts than the file says."""
    with pytest.raises(UserError, match="reset shows something else in a later episode: seed=0"):
        collected(GymnasiumDomain(Deaf, SUB_GOALS))


def test_a_label_that_keeps_something_is_not_collected() -> None:
    """Spec B7: what it says of a state would depend on how often it was asked."""
    asked = count()
    goals = {**SUB_GOALS, "third": lambda env: next(asked) % 3 == 0}
    with pytest.raises(UserError, match="a label differs when it is asked for again: third"):
        collected(GymnasiumDomain(CorridorEnv, goals))


def test_the_engine_is_the_environment() -> None:
    """Spec B6: images, rewards, ends and labels are those of the environment stepped alone."""
    engine, env, rng = engine_of(1), CorridorEnv(), np.random.default_rng(1)
    observation, _ = env.reset(seed=0)
    for _ in range(200):
        np.testing.assert_array_equal(engine.images(engine.ids)[0], observation)
        assert engine.labels(engine.ids)[0].tolist() == [env.cell == 0, env.cell == LENGTH - 1]
        action = int(rng.integers(2))
        step = engine.step(np.array([action]))
        observation, reward, terminated, _, _ = env.step(action)
        assert (step.rewards[0], step.terminated[0]) == (reward, terminated)
        np.testing.assert_array_equal(engine.images(step.next_ids)[0], observation)
        if terminated or step.truncated[0]:
            observation, _ = env.reset(seed=0)
    assert engine.n_states == LENGTH  # each picture once


def test_a_domain_says_what_is_a_success() -> None:
    """Spec B6: asked of the environment at the end of each episode, however it ends, and of no other step."""
    engine, left, right = corridor_env.SWIFT.make_engine(0, 2, 8), 0, 1
    ways = {
        (right, right, right): True,
        (left, right, right, right, right): True,
        (left, left, right, right, right, right, right): False,  # too late
        (left,) * 8: True,  # cut where that is none
        (right, left) * 4: False,
    }
    for way, success in ways.items():
        for number, action in enumerate(way, 1):
            engine.restore(engine.snapshot())  # what was earned before is known again
            step = engine.step(np.array([action, left]))
            assert step.succeeded is not None and step.succeeded.dtype == np.bool_
            assert step.succeeded[0] == (success and number == len(way)), way
        assert engine.elapsed[0] == 0
    assert DOMAIN.make_engine(0, 1, 8).step(np.array([0])).succeeded is None


def test_an_environment_that_does_not_repeat_itself_is_not_gone_on_with() -> None:
    """Spec G1: what cannot be resumed says so."""
    engine, other = (corridor_env.RESTLESS.make_engine(0, 4, 30) for _ in range(2))
    for _ in range(7):
        engine.step(np.zeros(4, np.int64))
    with pytest.raises(UserError, match="does not repeat itself"):
        other.restore(engine.snapshot())


def test_an_engine_that_forgets_too_soon_is_refused() -> None:
    """Before training: 40 decisions of 60 steps look further back than 300 states."""
    config = TrainMetaConfig.of(chooser="ppo", option_timeout=60, decisions=40, replay=100, environments=1)
    with pytest.raises(UserError, match=r"looks back over \d+ states, the engine remembers 300: option_timeout=60"):
        require_memory(engine_of(1, memory=300), config, 2)
    require_memory(engine_of(1, memory=10_000), config, 2)


def test_the_engine_forgets_but_not_what_a_replay_holds() -> None:
    """Spec D2: what was met within the last ``memory`` steps has its picture, whatever id it has."""
    engine, rng = engine_of(1, memory=3), np.random.default_rng(0)
    met: list[tuple[int, bytes]] = []
    for _ in range(300):
        step = engine.step(rng.integers(2, size=1))
        met.append((int(step.next_ids[0]), engine.images(step.next_ids).tobytes()))
        for identity, picture in met[-3:]:
            assert engine.images(np.array([identity])).tobytes() == picture
    assert engine.oldest > 0
    with pytest.raises(ValueError, match="forgotten"):
        engine.images(np.array([0]))
    restored = engine_of(1, memory=3)
    restored.restore(engine.snapshot())
    kept = np.arange(engine.oldest, engine.n_states)
    np.testing.assert_array_equal(restored.images(kept), engine.images(kept))
    for _ in range(50):
        action = rng.integers(2, size=1)
        assert restored.step(action).next_ids == engine.step(action).next_ids


def test_an_environment_may_reuse_its_array() -> None:
    """What was read stays."""
    shown = np.zeros(SHAPE, np.uint8)
    kept = DOMAIN.reader.read(shown)
    shown[:] = 1
    assert not kept.any()


def test_no_state_of_a_layout_is_favoured(monkeypatch: pytest.MonkeyPatch) -> None:
    """Ten of a hundred states, a hundred times: of each tenth of the way 100 are expected, with a deviation of 9."""
    way = [(np.array([step], np.float32), (0, 0, step)) for step in range(100)]
    monkeypatch.setattr(play, "play_layout", lambda *_: iter(way))
    nothing = {"policies": (None,), "label_functions": {}, "sub_goals": (), "origins": {}}
    domain: Any = SimpleNamespace(reader=reader_of(spaces.Box(0, 99, (1,), np.float32)), **nothing)
    counts = np.zeros(10)
    for seed in range(100):
        rng = np.random.default_rng(seed)
        for state in play.sample_layout(domain, None, 0, GymnasiumConfig(states=10), set(), rng, by_features=False):
            counts[state.origin[-1] // 10] += 1
    assert counts.sum() == 1000 and (np.abs(counts - 100) < 4 * 9).all(), counts
