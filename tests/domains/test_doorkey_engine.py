"""The fast DoorKey engines are pixel- and step-exact with the MiniGrid environment (Spec B1, B2)."""

import itertools
from collections import Counter
from typing import Any

import numpy as np
import pytest
from minigrid.core.world_object import Key
from numpy.typing import NDArray

from hypogoal.domains.doorkey.engine import START, DoorKeyEngine
from hypogoal.domains.doorkey.env import DOOR_LABELS, SUB_GOALS, DoorKeyEnv, GridLayout
from hypogoal.domains.doorkey.rules import DROP, FORWARD, N_ACTIONS, PICKUP, TOGGLE

LAYOUTS = range(100, 120)
STEPS = 110
MAX_STEPS = 50


def shortest_actions(engine: DoorKeyEngine) -> list[int]:
    """A shortest way to the goal, walked back from it."""
    ids, steps, _ = engine.search()
    goal = int(np.argmax(engine.at_goal(ids)))
    target, actions = int(ids[goal]), []
    for depth in range(int(steps[goal]) - 1, -1, -1):
        before = ids[steps == depth]
        reaching = [
            (int(state), action)
            for action in range(N_ACTIONS)
            if action != DROP
            for state in before[engine.follow(before, np.full(len(before), action)) == target]
        ]
        target, action = reaching[0]
        actions.append(action)
    assert target == START
    return actions[::-1]


def busy_action(env: DoorKeyEnv, rng: np.random.Generator) -> int:
    """A random action that likes to use what is in front: keys, the door, an empty cell to drop on."""
    x, y = env.front_pos
    ahead = env.grid.get(int(x), int(y))
    if rng.random() < 0.5:
        if isinstance(ahead, Key):
            return PICKUP
        if ahead is env.door:
            return int(rng.choice([TOGGLE, FORWARD]))
        if ahead is None and env.held and rng.random() < 0.25:
            return DROP
        return FORWARD
    return int(rng.integers(N_ACTIONS))


def count_events(seen: Counter[str], held: int, door: tuple[bool, bool], env: DoorKeyEnv) -> None:
    """What the last step did, so that the test can say that it tested it."""
    seen["pickup"] += len(env.held) > held
    seen["drop"] += len(env.held) < held
    seen[f"hold {len(env.held)}"] += 1
    was_locked, was_open = door
    seen["unlock"] += was_locked and not env.door.is_locked
    seen["close"] += was_open and not env.door.is_open
    seen["reopen"] += not was_locked and not was_open and env.door.is_open
    seen["in the doorway"] += env.grid.get(int(env.agent_pos[0]), int(env.agent_pos[1])) is env.door


def play_side_by_side(layout_seed: int, seen: Counter[str], wrong_key: str = "harmless") -> None:
    """One MiniGrid env and the engine (its other two envs doing something else), in step.

    Episodes begin on a shortest path: to the goal, then to the open door, in turn; they go on at random.
    """
    label = DOOR_LABELS[layout_seed % 2]
    world: Any = {"door_label": label, "wrong_key": wrong_key, "max_steps": MAX_STEPS}
    env = DoorKeyEnv(layout_seed=layout_seed, **world)
    engine = DoorKeyEngine(layout_seed, 3, **world)
    rng = np.random.default_rng(layout_seed)
    path: list[int] = []
    shortest = engine.shortest_path()
    if shortest is None:
        assert wrong_key == "ends"
    else:
        path = shortest_actions(engine)
        assert len(path) == shortest
    scripts = itertools.cycle([path, path[: path.index(TOGGLE) + 1] if path else []])
    script = list(next(scripts))
    first, _ = env.reset()
    assert np.array_equal(engine.images(engine.ids), np.stack([first] * 3))
    for _ in range(STEPS):
        held, door = len(env.held), (env.door.is_locked, env.door.is_open)
        action = script.pop(0) if script else busy_action(env, rng)
        image, reward, terminated, truncated, info = env.step(action)
        count_events(seen, held, door, env)
        step = engine.step(np.array([action, *rng.integers(N_ACTIONS, size=2)]))
        outcome = (step.rewards[0], step.terminated[0], step.truncated[0])
        assert outcome == (reward, terminated, truncated)
        assert np.array_equal(engine.images(step.next_ids[:1])[0], image)
        assert engine.labels(step.next_ids)[0].tolist() == list(info["labels"].values())
        if terminated or truncated:
            seen["terminated"] += terminated
            seen["a wrong key"] += terminated and not reward
            seen["truncated"] += truncated
            image, _ = env.reset()
            script = list(next(scripts))
        assert np.array_equal(engine.images(engine.ids)[0], image)
        assert engine.elapsed[0] == env.step_count


def test_engines_are_exact_to_minigrid() -> None:
    """Spec B1, B2: pixels, rewards, ends and labels equal at every step of 20 layouts; all rules used."""
    seen: Counter[str] = Counter()
    for layout_seed in LAYOUTS:
        play_side_by_side(layout_seed, seen)
    for event in ("pickup", "drop", "unlock", "close", "reopen", "in the doorway", "terminated", "truncated"):
        assert seen[event] >= 10, (event, seen)
    assert seen["hold 1"] >= 50
    assert seen["hold 2"] >= 50
    assert seen["hold 3"] >= 25


def test_wrong_keys_end_episodes() -> None:
    """Spec H2: in the environment and in the engine, at every step; the goal and the limit still end some."""
    seen: Counter[str] = Counter()
    for layout_seed in LAYOUTS[:15]:
        play_side_by_side(layout_seed, seen, "ends")
    assert seen["a wrong key"] >= 5
    assert seen["terminated"] - seen["a wrong key"] >= 5


def test_the_plan_is_what_follows() -> None:
    """Spec H3: every state and action of the plan, stepped; nothing follows where an episode ends."""
    engine = DoorKeyEngine(5, 1, wrong_key="ends")
    ids, actions, following, final, solved = engine.plan()
    assert set(following.ravel().tolist()) <= set(ids.tolist())
    for column, action in enumerate(actions.tolist()):
        expected = engine.follow(ids[~final], np.full((~final).sum(), action))
        assert np.array_equal(following[~final, column], expected)
    assert (following[final] == ids[final][:, None]).all()
    labels = engine.labels(ids)
    assert np.array_equal(final, labels[:, 4] | labels[:, 0] | labels[:, 1])
    assert np.array_equal(solved, labels[:, 4])


def test_codes_say_the_whole_image() -> None:
    """64 one-byte codes and the tiles give the image; states of one image have one code row."""
    engine = DoorKeyEngine(0, 1)
    ids = engine.reachable()
    codes = engine.codes(ids)
    tiled = engine.tiles[codes].reshape(-1, 8, 8, 8, 8, 3).transpose(0, 1, 3, 2, 4, 5).reshape(-1, 64, 64, 3)
    assert np.array_equal(tiled, engine.images(ids))
    assert len(np.unique(codes, axis=0)) == len(ids)
    assert len({image.tobytes() for image in engine.images(ids)}) == len(ids)


def test_reachable_states_of_seed_0() -> None:
    """Spec B2, B3: 1,640 images without drop, with the positives that the authors' definitions give."""
    engine = DoorKeyEngine(0, 1)
    positives = engine.labels(engine.reachable()).sum(axis=0)
    assert dict(zip(SUB_GOALS, positives.tolist(), strict=True)) == {
        "collect-blue-key": 836,
        "collect-green-key": 836,
        "collect-red-key": 1288,
        "open-red-door": 468,
        "go-to-goal": 8,
    }
    assert len(engine.reachable()) == 1640
    in_front = DoorKeyEngine(0, 1, door_label="in-front")
    assert in_front.labels(in_front.reachable())[:, 3].sum() == 8


def corridor() -> GridLayout:
    """Agent, red key, door, goal in a row (cells 9 to 12), the other keys walled in."""
    open_cells = {9, 10, 11, 12, 50, 52}
    return GridLayout(frozenset(range(64)) - open_cells, door=11, goal=12, start=9, direction=0, keys=(50, 52, 10))


def test_a_corridor_counted_by_hand(monkeypatch: pytest.MonkeyPatch) -> None:
    """Spec B3, F5: pick up, forward, toggle, forward, forward; states without drop on paper.

    Key lying 4, held and locked 8, held and open 12 + 1 on the goal, held and closed 8.
    """
    monkeypatch.setattr("hypogoal.domains.doorkey.engine.make_layout", lambda seed: corridor())
    engine = DoorKeyEngine(0)
    assert engine.shortest_path() == 5
    assert shortest_actions(engine) == [PICKUP, FORWARD, TOGGLE, FORWARD, FORWARD]
    assert len(engine.reachable()) == 33


def test_random_success() -> None:
    """Spec F5: none below the shortest path, else a few; seeds repeat."""
    engine = DoorKeyEngine(9, 1, max_steps=500)
    assert DoorKeyEngine(9, 1, max_steps=engine.shortest_path() - 1).random_success(200, np.random.default_rng(0)) == 0
    share = engine.random_success(600, np.random.default_rng(0))
    assert share == engine.random_success(600, np.random.default_rng(0))
    assert 0 < share < 0.2


def test_ids_are_stable_and_survive_a_snapshot() -> None:
    """Spec G1: a resumed engine gives the same ids as one that never stopped."""

    def play(engine: DoorKeyEngine, actions: NDArray[np.int64]) -> NDArray[np.int64]:
        return np.stack([engine.step(row).next_ids for row in actions])

    actions = np.random.default_rng(3).integers(N_ACTIONS, size=(600, 4))
    unbroken = DoorKeyEngine(7, 4)
    play(unbroken, actions[:300])
    early = unbroken.images(np.arange(unbroken.n_states))
    snapshot = unbroken.snapshot()
    expected = play(unbroken, actions[300:])
    assert np.array_equal(unbroken.images(np.arange(len(early))), early)
    resumed = DoorKeyEngine(7, 4)
    resumed.restore(snapshot)
    assert resumed.n_states == len(early)
    assert np.array_equal(play(resumed, actions[300:]), expected)
    assert np.array_equal(resumed.elapsed, unbroken.elapsed)
