"""The ladder environment, its start states, and the engine that is exact to it (Spec B4, D4, G1)."""

from __future__ import annotations

import sys

import gymnasium
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env
from numpy.typing import NDArray

from hypogoal.core.errors import UserError
from hypogoal.domains.base import Engine
from hypogoal.domains.montezuma import env as montezuma_env
from hypogoal.domains.montezuma.domain import DOMAIN
from hypogoal.domains.montezuma.emulator import (
    DOWN,
    FIRE,
    LEFT,
    N_ACTIONS,
    NOOP,
    OBSERVATION_SHAPE,
    RIGHT,
    UP,
    Emulator,
)
from hypogoal.domains.montezuma.engine import MontezumaEngine
from hypogoal.domains.montezuma.env import BEGINNINGS, MontezumaLadder, arrives, make_starts
from hypogoal.domains.montezuma.ladders import at_base, distance_to_base
from hypogoal.domains.montezuma.sub_goals import CLIMB_DOWN

pytestmark = pytest.mark.atari

STARTS = 4


@pytest.fixture(scope="module")
def emulator() -> Emulator:
    return Emulator(seed=3)


@pytest.fixture(scope="module")
def engine() -> MontezumaEngine:
    """Two environments; tests that share it begin with ``reset``."""
    return MontezumaEngine("1L", 2, start_states=STARTS, max_steps=60, memory=500)


@pytest.fixture(scope="module")
def env() -> MontezumaLadder:
    return MontezumaLadder("1L", start_states=STARTS, max_steps=60, render_mode="rgb_array")


def busy(rng: np.random.Generator, shape: tuple[int, ...]) -> NDArray[np.int64]:
    """Random actions with a bias to climb down and to walk off: bases are reached and deaths died."""
    often = rng.choice([DOWN, DOWN, DOWN, RIGHT], size=shape)
    return np.where(rng.random(shape) < 0.6, often, rng.integers(N_ACTIONS, size=shape))


# Start states


@pytest.mark.parametrize("name", ["1L", "2-6"])
def test_start_states_are_at_the_top_and_live(emulator: Emulator, name: str) -> None:
    """Spec D4: distinct pictures of the top, alive, from each of which the scripted descent gets to the base."""
    ladder = BEGINNINGS[name]
    starts = make_starts(emulator, ladder, 6, seed=0)
    assert len({start.snapshot.stack.tobytes() for start in starts}) == 6
    for start in starts:
        assert start.facts[:3] == ladder.at
        emulator.restore(start.snapshot)
        assert emulator.position() == ladder.at
        assert emulator.alive()
        assert arrives(emulator, ladder)
        assert at_base(np.array([emulator.position()]))[0]


def test_start_states_follow_from_the_seed(emulator: Emulator) -> None:
    """Spec G1: the same in another emulator that played something else; another seed gives others."""
    ladder = BEGINNINGS["1L"]
    looks = [
        [start.snapshot.stack.tobytes() for start in make_starts(one, ladder, 5, seed)]
        for one, seed in ((emulator, 0), (Emulator(seed=9), 0), (emulator, 1))
    ]
    assert looks[0] == looks[1]
    assert not set(looks[0]) & set(looks[2])


def test_where_nothing_moves_the_rest_of_the_game_differs(emulator: Emulator) -> None:
    """Spec D4: the top of 14-22 has one look; its start states still differ, in what goes on in the room below."""
    ladder = BEGINNINGS["14-22"]
    starts = make_starts(emulator, ladder, 3, seed=0)
    assert len({start.snapshot.stack.tobytes() for start in starts}) == 1
    below = set()
    for start in starts:
        emulator.restore(start.snapshot)
        assert arrives(emulator, ladder)
        below.add(emulator.stack.tobytes())
    assert len(below) == 3


def test_start_states_that_cannot_be(emulator: Emulator, monkeypatch: pytest.MonkeyPatch) -> None:
    """Spec G2: too few phases to live from, or no state at all, is one clear line."""
    with pytest.raises(UserError, match="only 0 of 0 start states"):
        make_starts(emulator, BEGINNINGS["1L"], 0, seed=0)
    monkeypatch.setattr(montezuma_env, "PHASES", range(2, 5))
    with pytest.raises(UserError, match=r"only 3 of 4 start states survive the script: 1L\. Ask for fewer"):
        make_starts(emulator, BEGINNINGS["1L"], 4, seed=0)
    assert emulator.screens


# The environment


def test_gymnasium_accepts_it() -> None:
    """Spec B4: Gymnasium's own checker has nothing to say (warnings are errors here); spaces; the id."""
    env = gymnasium.make(DOMAIN.env_id, start_states=1, max_steps=60, render_mode="rgb_array").unwrapped
    assert isinstance(env, MontezumaLadder)
    assert env.observation_space == gymnasium.spaces.Box(0, 255, OBSERVATION_SHAPE, np.uint8)
    assert env.action_space == gymnasium.spaces.Discrete(18)
    check_env(env)


def test_an_episode_of_the_environment(env: MontezumaLadder) -> None:
    """Spec B4: from the top to the base nine steps of DOWN; ``info`` says where the agent is and what it reached."""
    image, info = env.reset(seed=1)
    assert (info["position"], info["alive"]) == ((1, 21, 192), True)
    assert np.array_equal(image, env.emulator.stack)
    for step in range(9):
        assert not info["labels"][CLIMB_DOWN.name]
        image, reward, terminated, truncated, info = env.step(DOWN)
        assert (reward, terminated, truncated) == (0.0, False, False), step
    assert (info["position"], info["alive"]) == ((1, 21, 148), True)
    assert info["labels"][CLIMB_DOWN.name]
    assert env.labels()[0]
    steps = 9
    while info["alive"] and not truncated:
        *_, truncated, info = env.step(NOOP)
        steps += 1
    assert truncated == (steps == 60)


def test_start_states_are_drawn_or_asked_for(env: MontezumaLadder) -> None:
    """Spec D4: reset with a seed repeats, without draws all of them, and one can be asked for by number."""
    looks = {start.snapshot.stack.tobytes(): number for number, start in enumerate(env.starts)}
    drawn = [looks[env.reset(seed=seed)[0].tobytes()] for seed in (5, 5)]
    assert drawn[0] == drawn[1]
    assert {looks[env.reset()[0].tobytes()] for _ in range(40)} == set(range(STARTS))
    for number in range(STARTS):
        assert looks[env.reset(options={"start_state": number})[0].tobytes()] == number


def test_pictures_are_of_the_state(env: MontezumaLadder) -> None:
    """Spec B4: the console's picture, also right after a reset, when the emulator still shows another state."""
    for number in range(2):
        env.reset(options={"start_state": number})
        first = env.render()
        assert first.shape == (210, 160, 3)
        env.step(RIGHT)
        assert not np.array_equal(env.render(), first)
        for _ in range(5):
            env.step(RIGHT)
        env.reset(options={"start_state": number})
        assert np.array_equal(env.render(), first)
        assert np.array_equal(first, env.starts[number].picture)
    first[:] = 0
    assert env.render().any()
    assert MontezumaLadder(start_states=1).render() is None


def test_the_end_of_an_episode_is_chosen() -> None:
    """Spec B4: at the beginning of a death, or when all lives are lost; cut at ``max_steps``."""
    for end_at_death, max_steps, over in ((True, 150, True), (False, 150, True), (False, 9, False)):
        env = MontezumaLadder("1M", max_steps=max_steps, end_at_death=end_at_death, start_states=1)
        env.reset()
        steps, terminated, truncated = 0, False, False
        while not terminated and not truncated:
            _, _, terminated, truncated, info = env.step(LEFT)
            steps += 1
        assert not info["alive"]
        assert (terminated, truncated) == (over, not over)
        assert (steps == 9) == (end_at_death or not over)
        assert env.emulator.ale.game_over() == (steps > 9)


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
        assert engine.alive(now)[0] == info["alive"]
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


def test_ids_images_and_positions(engine: MontezumaEngine) -> None:
    """Start states have the first ids for ever; every step of every environment makes a new one, with its own image."""
    contract: Engine = engine
    assert contract.n_actions == 18
    assert contract.observation_shape == OBSERVATION_SHAPE
    assert set(engine.reset()) <= set(range(STARTS))
    starts = engine.images(np.arange(STARTS))
    assert np.array_equal(starts, np.stack([start.snapshot.stack for start in engine.starts]))
    assert engine.positions(np.arange(STARTS)).tolist() == [[1, 21, 192]] * STARTS
    before, first = engine.ids, engine.n_states
    shown = [engine.images(before)]
    rng = np.random.default_rng(0)
    for number in range(12):
        step = engine.step(rng.choice([DOWN, UP], size=2))
        assert step.next_ids.tolist() == [first + 2 * number, first + 2 * number + 1]
        assert step.rewards.dtype == np.float32
        assert engine.n_states == first + 2 * number + 2
        shown.append(engine.images(step.next_ids))
        assert np.array_equal(shown[-1][..., :3], shown[-2][..., 1:])  # one new frame each
    ids = np.arange(first, engine.n_states)
    assert np.array_equal(engine.images(ids), np.concatenate(shown[1:]))
    backwards = np.array([first + 3, 0, first + 1, 0])
    out = np.zeros((4, *OBSERVATION_SHAPE), np.uint8)
    assert engine.images(backwards, out) is out
    assert np.array_equal(out[[0, 2]], np.stack([shown[2][1], shown[1][1]]))
    assert np.array_equal(out[1], starts[0])
    assert np.array_equal(out[1], out[3])
    positions = engine.positions(ids)
    assert positions.dtype == np.int64
    assert (positions[:, :2] == (1, 21)).all()
    assert (distance_to_base(positions) == np.abs(positions[:, 2] - 148)).all()
    engine.images(ids)[...] = 0  # the caller's to keep
    assert np.array_equal(engine.images(ids), np.concatenate(shown[1:]))
    assert engine.images(np.zeros(0, np.int64)).shape == (0, *OBSERVATION_SHAPE)


def test_old_states_are_forgotten() -> None:
    """Images of the newest ``memory`` states and of the start states are kept; positions and labels of all."""
    engine = MontezumaEngine("1L", 2, start_states=2, memory=20)
    shown, positions = [engine.images(np.arange(2))], [engine.positions(np.arange(2))]
    for number in range(40):
        step = engine.step(np.array([DOWN, UP] if number < 9 else [NOOP, DOWN]))
        shown.append(engine.images(step.next_ids))
        positions.append(engine.positions(step.next_ids))
        assert engine.oldest == max(2, engine.n_states - 20)
    images = np.concatenate(shown)
    for keep in (np.arange(2), np.arange(engine.oldest, engine.n_states)):
        assert np.array_equal(engine.images(keep), images[keep])
    assert len(engine.images(engine.ids)) == 2
    with pytest.raises(ValueError, match=f"state {engine.oldest - 1} is forgotten; the oldest kept is {engine.oldest}"):
        engine.images(np.array([0, engine.oldest - 1]))
    everything = np.arange(engine.n_states)
    assert np.array_equal(engine.positions(everything), np.concatenate(positions))
    assert np.array_equal(engine.labels(everything)[:, 0], at_base(np.concatenate(positions)))
    assert engine.labels(everything)[:, 0].sum() >= 1


def test_what_is_not_known_is_refused(engine: MontezumaEngine) -> None:
    """Unknown states, actions and buffers never give a wrong state or image; arguments that cannot be are said."""
    engine.reset()
    for read in (engine.images, engine.labels, engine.positions, engine.alive):
        for ids in ([engine.n_states], [-1], [0, engine.n_states + 5]):
            with pytest.raises(ValueError, match="ids are 0 to"):
                read(np.array(ids))
    known = engine.n_states
    for actions in ([0, N_ACTIONS], [-1, 0], [0], [0, 0, 0]):
        with pytest.raises(IndexError, match="actions are 2 numbers"):
            engine.step(np.array(actions))
    assert engine.n_states == known
    wrong = (np.zeros((1, *OBSERVATION_SHAPE), np.float32), np.zeros((2, *OBSERVATION_SHAPE), np.uint8))
    for out in (*wrong, np.zeros((1, 84, 4, 84), np.uint8).transpose(0, 1, 3, 2)):
        with pytest.raises(ValueError, match="out must be contiguous uint8"):
            engine.images(np.array([0]), out)  # type: ignore[arg-type]
    with pytest.raises(UserError, match="unknown start: 9X"):
        MontezumaEngine("9X", 1)
    for count, memory in ((0, 10), (4, 3)):
        with pytest.raises(UserError, match=f"no such engine: count={count}, memory={memory}"):
            MontezumaEngine("1L", count, memory=memory)


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


def test_rewards_and_ends() -> None:
    """Spec B4: the key gives the game's 100; a death ends the episode, or only the last one does."""
    engine = MontezumaEngine("1L", 1, start_states=1, max_steps=30)
    rewards = [float(engine.step(np.array([action])).rewards[0]) for action in (LEFT, FIRE, FIRE)]
    assert sum(rewards) == 100
    for end_at_death in (True, False):
        engine = MontezumaEngine("1M", 1, start_states=1, max_steps=150, end_at_death=end_at_death)
        step, number = engine.step(np.array([LEFT])), 1
        while not step.terminated[0] and not step.truncated[0]:
            step, number = engine.step(np.array([LEFT])), number + 1
        assert not engine.alive(step.next_ids)[0]
        assert step.terminated[0]
        assert number == 9 if end_at_death else 9 < number < 150
        assert engine.ids.tolist() == [0]
        assert engine.elapsed.tolist() == [0]
        assert engine.alive(np.array([0]))[0]


def played(engine: MontezumaEngine, actions: NDArray[np.int64]) -> list[NDArray[np.generic]]:
    """All that an engine says while it plays the actions (T, E)."""
    said: list[NDArray[np.generic]] = []
    for row in actions:
        step = engine.step(row)
        said += [*step, engine.ids, engine.elapsed, engine.images(step.next_ids), engine.images(engine.ids)]
        said += [engine.positions(step.next_ids), engine.labels(step.next_ids), engine.alive(step.next_ids)]
    return said


def test_a_seed_says_everything() -> None:
    """Spec G1: two engines of one seed play the same; of another seed they begin elsewhere."""
    actions = busy(np.random.default_rng(1), (50, 2))
    one, same = (MontezumaEngine("1L", 2, start_states=2, max_steps=12) for _ in range(2))
    other = MontezumaEngine("1L", 1, start_states=2, seed=1)
    first = played(one, actions)
    assert all(np.array_equal(a, b) for a, b in zip(first, played(same, actions), strict=True))
    assert not np.array_equal(one.images(np.arange(2)), other.images(np.arange(2)))


def test_snapshots_are_exact() -> None:
    """Spec G1: an engine resumed from plain arrays goes on bit for bit, its memory overrun or not."""
    actions = busy(np.random.default_rng(2), (140, 2))
    make = {"start_states": 5, "max_steps": 25, "memory": 90}
    unbroken, resumed = (MontezumaEngine("1L", 2, **make) for _ in range(2))  # type: ignore[arg-type]
    for begin, end in ((5, 40), (80, 140)):
        played(unbroken, actions[(unbroken.n_states - 5) // 2 : begin])
        snapshot = {name: np.array(values) for name, values in unbroken.snapshot().items()}
        assert not any(values.dtype == object for values in snapshot.values())
        kept = np.arange(unbroken.oldest, unbroken.n_states)
        assert (len(kept) == 90) == (begin == 80)
        images = unbroken.images(kept)
        assert len(snapshot["frames"]) <= len(kept) + 2 * 3 + 5 * 4  # each once; few of forgotten states and starts
        expected = played(unbroken, actions[begin:end])
        played(resumed, actions[7:9])  # what it did before is gone
        resumed.restore(snapshot)
        assert (resumed.n_states, resumed.oldest) == (kept[-1] + 1, kept[0])
        assert np.array_equal(resumed.images(kept), images)
        for values in snapshot.values():
            values.fill(0)  # the engine has its own copies
        assert all(np.array_equal(a, b) for a, b in zip(played(resumed, actions[begin:end]), expected, strict=True))
        everything = np.arange(unbroken.n_states)
        assert np.array_equal(resumed.positions(everything), unbroken.positions(everything))


@pytest.mark.parametrize("name", ["facts", "alive", "stacks"])
def test_a_snapshot_whose_parts_do_not_fit_is_refused(name: str) -> None:
    """Spec G2: as many positions and stacks as there are states; before anything is played."""
    engine = MontezumaEngine("1L", 2, start_states=2, max_steps=12)
    played(engine, busy(np.random.default_rng(1), (5, 2)))
    snapshot = engine.snapshot()
    with pytest.raises(ValueError, match="differ in number"):
        engine.restore({**snapshot, name: snapshot[name][:-1]})


def test_without_the_emulator_there_is_one_line(monkeypatch: pytest.MonkeyPatch) -> None:
    """Spec G2: neither the environment nor the engine can be made, and both say why."""
    monkeypatch.setitem(sys.modules, "ale_py", None)
    for make in (MontezumaLadder, lambda: MontezumaEngine("1L", 2)):
        with pytest.raises(UserError, match="cannot be played") as error:
            make()
        assert "\n" not in str(error.value)
