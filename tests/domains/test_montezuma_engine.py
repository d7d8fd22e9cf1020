"""The ladder environment, its start states, and the engine that is exact to it (Spec B4, D4, G1)."""

from __future__ import annotations

import gymnasium
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env
from numpy.typing import NDArray

from hypogoal.core.errors import UserError
from hypogoal.domains.montezuma import env as montezuma_env
from hypogoal.domains.montezuma.domain import DOMAIN
from hypogoal.domains.montezuma.emulator import (
    DOWN,
    N_ACTIONS,
    NOOP,
    OBSERVATION_SHAPE,
    RIGHT,
    UP,
    Emulator,
    stack_frames,
)
from hypogoal.domains.montezuma.engine import MontezumaEngine
from hypogoal.domains.montezuma.env import BEGINNINGS, MontezumaLadder, arrives, make_starts
from hypogoal.domains.montezuma.sub_goals import CLIMB_DOWN

pytestmark = pytest.mark.atari

STARTS = 4


@pytest.fixture(scope="module")
def emulator() -> Emulator:
    return Emulator()


@pytest.fixture(scope="module")
def engine() -> MontezumaEngine:
    """Two environments; tests that share it begin with ``reset``."""
    return MontezumaEngine("1L", 2, start_states=STARTS, max_steps=60, memory=500)


@pytest.fixture(scope="module")
def env() -> MontezumaLadder:
    return MontezumaLadder("1L", start_states=STARTS, max_steps=60)


def busy(rng: np.random.Generator, shape: tuple[int, ...]) -> NDArray[np.int64]:
    """Random actions with a bias to climb down and to walk off: bases are reached and deaths died."""
    often = rng.choice([DOWN, DOWN, DOWN, RIGHT], size=shape)
    return np.where(rng.random(shape) < 0.6, often, rng.integers(N_ACTIONS, size=shape))


# Start states


def test_start_states_are_at_the_top_and_live(emulator: Emulator) -> None:
    """Spec D4: distinct pictures of the top, alive, from each of which the scripted descent gets to the base."""
    ladder = BEGINNINGS["2-6"]
    starts = make_starts(emulator, "2-6", 6, seed=0)
    assert len({stack_frames(start.seen).tobytes() for start in starts}) == 6
    for start in starts:
        emulator.restore(start)
        assert emulator.position() == ladder.at
        assert emulator.alive()
        assert arrives(emulator, ladder)
        assert CLIMB_DOWN.at(emulator.facts()[None]) >= 0


def test_start_states_that_cannot_be(emulator: Emulator, monkeypatch: pytest.MonkeyPatch) -> None:
    """Spec G2: too few phases to live from, or no state at all, is one clear line."""
    with pytest.raises(UserError, match="only 0 of 0 start states"):
        make_starts(emulator, "1L", 0, seed=0)
    monkeypatch.setattr(montezuma_env, "PHASES", range(2, 5))
    with pytest.raises(UserError, match=r"only 3 of 4 start states survive the script: 1L\. Ask for fewer"):
        make_starts(emulator, "1L", 4, seed=0)


def test_a_memory_shorter_than_the_games_is_refused() -> None:
    """Spec G2: else the first step would forget the states that other games are in."""
    with pytest.raises(UserError, match="3 games need a memory of as many states: memory=2"):
        MontezumaEngine("1L", 3, start_states=1, memory=2)


# The environment


def test_gymnasium_accepts_it() -> None:
    """Spec B4: Gymnasium's own checker has nothing to say (warnings are errors here); spaces; the id."""
    env = gymnasium.make(DOMAIN.env_id, start_states=1, max_steps=60).unwrapped
    assert isinstance(env, MontezumaLadder)
    assert env.observation_space == gymnasium.spaces.Box(0, 255, OBSERVATION_SHAPE, np.uint8)
    assert env.action_space == gymnasium.spaces.Discrete(18)
    check_env(env)


def test_start_states_are_drawn_or_asked_for(env: MontezumaLadder) -> None:
    """Spec D4: reset with a seed repeats, without draws all of them, and one can be asked for by number."""
    looks = {stack_frames(start.seen).tobytes(): number for number, start in enumerate(env.starts)}
    drawn = [looks[env.reset(seed=seed)[0].tobytes()] for seed in (5, 5)]
    assert drawn[0] == drawn[1]
    assert {looks[env.reset()[0].tobytes()] for _ in range(40)} == set(range(STARTS))
    for number in range(STARTS):
        assert looks[env.reset(options={"start_state": number})[0].tobytes()] == number


# The engine


def test_engine_is_exact_to_the_environment(engine: MontezumaEngine, env: MontezumaLadder) -> None:
    """Spec B4: observations, labels, rewards, positions and ends, episode after episode, from the same start states."""
    rng = np.random.default_rng(4)
    engine.reset()
    seen = {"positives": 0, "terminated": 0, "truncated": 0}
    image, info = env.reset(options={"start_state": int(engine.ids[0])})
    scripts = [[DOWN] * 10 + [NOOP] * 50, [NOOP] * 60, []]
    script = list(scripts[0])
    for _ in range(400):
        assert np.array_equal(engine.images(engine.ids[:1])[0], image)
        action = script.pop(0) if script else int(busy(rng, ()))
        step = engine.step(np.array([action, rng.integers(N_ACTIONS)]))
        image, reward, terminated, truncated, info = env.step(action)
        assert (step.rewards[0], step.terminated[0], step.truncated[0]) == (reward, terminated, truncated)
        now = step.next_ids[:1]
        assert np.array_equal(engine.images(now)[0], image)
        assert engine.labels(now)[0].tolist() == list(info["labels"].values())
        assert tuple(engine.positions(now)[0]) == info["position"]
        assert step.terminated[0] != info["alive"]
        seen["positives"] += info["labels"][CLIMB_DOWN.name]
        seen["terminated"] += terminated
        seen["truncated"] += truncated
        if terminated or truncated:
            assert engine.elapsed[0] == 0
            assert engine.ids[0] < STARTS
            image, _ = env.reset(options={"start_state": int(engine.ids[0])})
            script = list(scripts[(seen["terminated"] + seen["truncated"]) % 3])
        else:
            assert engine.ids[0] == now[0]
            assert engine.elapsed[0] == env.elapsed
    assert min(seen.values()) >= 2, seen


def test_old_states_are_forgotten() -> None:
    """Images of the newest ``memory`` states and of the start states are kept; positions and labels of all."""
    engine = MontezumaEngine("1L", 2, start_states=2, memory=20)
    shown, positions = [engine.images(np.arange(2))], [engine.positions(np.arange(2))]
    known = [engine.read_facts(np.arange(2))]
    for number in range(40):
        step = engine.step(np.array([DOWN, UP] if number < 9 else [NOOP, DOWN]))
        shown.append(engine.images(step.next_ids))
        positions.append(engine.positions(step.next_ids))
        known.append(engine.read_facts(step.next_ids))
        assert engine.oldest == max(2, engine.n_states - 20)
    images = np.concatenate(shown)
    for keep in (np.arange(2), np.arange(engine.oldest, engine.n_states)):
        assert np.array_equal(engine.images(keep), images[keep])
    assert len(engine.images(engine.ids)) == 2
    with pytest.raises(ValueError, match=f"{engine.oldest - 1} is unknown, or forgotten"):
        engine.images(np.array([0, engine.oldest - 1]))
    everything = np.arange(engine.n_states)
    assert np.array_equal(engine.positions(everything), np.concatenate(positions))
    assert np.array_equal(engine.labels(everything)[:, 0], CLIMB_DOWN.at(np.concatenate(known)) >= 0)
    assert engine.labels(everything)[:, 0].sum() >= 1


def test_what_is_not_known_is_refused(engine: MontezumaEngine) -> None:
    """Unknown states never give an image; an unknown start is one line."""
    engine.reset()
    for ids in ([engine.n_states], [-1], [0, engine.n_states + 5]):
        with pytest.raises(ValueError, match="forgotten"):
            engine.images(np.array(ids))
    with pytest.raises(UserError, match="unknown start: 9X"):
        MontezumaEngine("9X", 1)


def test_restart(engine: MontezumaEngine) -> None:
    """Spec D4: an episode can be begun again at any time, where asked and nowhere else."""
    engine.reset()
    for _ in range(4):
        engine.step(np.array([DOWN, DOWN]))
    other, image = int(engine.ids[1]), engine.images(engine.ids[1:])
    known = engine.n_states
    engine.restart(np.array([True, False]))
    assert engine.ids[0] < STARTS
    assert engine.ids[1] == other
    assert engine.elapsed.tolist() == [0, 4]
    assert engine.n_states == known
    assert np.array_equal(engine.images(engine.ids[1:]), image)
    step = engine.step(np.array([DOWN, DOWN]))
    heights = engine.positions(step.next_ids)[:, 2]
    assert heights[0] > heights[1] + 10
    drawn = set()
    for _ in range(40):
        engine.restart(np.array([True, False]))
        drawn.add(int(engine.ids[0]))
    assert drawn == set(range(STARTS))


def played(engine: MontezumaEngine, actions: NDArray[np.int64]) -> list[NDArray[np.generic]]:
    """All that an engine says while it plays the actions (T, E)."""
    said: list[NDArray[np.generic]] = []
    for row in actions:
        step = engine.step(row)
        said += [*step, engine.ids, engine.elapsed, engine.images(step.next_ids), engine.images(engine.ids)]
        said += [engine.positions(step.next_ids), engine.labels(step.next_ids)]
    return said


def test_snapshots_are_exact() -> None:
    """Spec G1: an engine resumed from plain arrays goes on bit for bit, its memory overrun or not."""
    actions = busy(np.random.default_rng(2), (140, 2))
    make = {"start_states": 5, "max_steps": 25, "memory": 90}
    unbroken, resumed = (MontezumaEngine("1L", 2, **make) for _ in range(2))  # type: ignore[arg-type]
    for begin, end in ((5, 40), (80, 140)):
        played(unbroken, actions[(unbroken.n_states - 5) // 2 : begin])
        snapshot = unbroken.snapshot()
        kept = np.arange(unbroken.oldest, unbroken.n_states)
        assert (len(kept) == 90) == (begin == 80)
        images = unbroken.images(kept)
        assert len(snapshot["frames"]) <= len(kept) + 2 * 3 + 5 * 4  # each once; few of forgotten states and starts
        expected = played(unbroken, actions[begin:end])
        played(resumed, actions[7:9])  # what it did before is gone
        resumed.restore(snapshot)
        assert (resumed.n_states, resumed.oldest) == (kept[-1] + 1, kept[0])
        assert np.array_equal(resumed.images(kept), images)
        for name in ("facts", "frames", "stacks"):
            snapshot[name].fill(0)  # the engine has its own copies
        assert all(np.array_equal(a, b) for a, b in zip(played(resumed, actions[begin:end]), expected, strict=True))
        everything = np.arange(unbroken.n_states)
        assert np.array_equal(resumed.positions(everything), unbroken.positions(everything))
