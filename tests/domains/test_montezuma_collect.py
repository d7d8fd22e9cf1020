"""Montezuma's Revenge: collected states, their labels and origins, and the domain (Spec B4-B7)."""

from __future__ import annotations

import multiprocessing
import time
from collections import Counter
from itertools import islice

import gymnasium
import numpy as np
import pytest
from numpy.typing import NDArray

from hypogoal.core.config import model_of
from hypogoal.core.errors import UserError
from hypogoal.core.progress import Progress
from hypogoal.core.seeding import rng_for
from hypogoal.data import Collected, States
from hypogoal.domains.base import Domain, defaults_of, load_domain, settings_of
from hypogoal.domains.montezuma import states as montezuma_states
from hypogoal.domains.montezuma.domain import DOMAIN, MontezumaConfig, labelled_rooms, unlabelled_rooms
from hypogoal.domains.montezuma.emulator import (
    DOWN,
    FRAME_SKIP,
    NOOP,
    RAM,
    ROOMS,
    SPRITE_HEIGHT,
    SPRITE_WIDTH,
    UP,
    Position,
    picture,
    pixel,
)
from hypogoal.domains.montezuma.ladders import LADDERS
from hypogoal.domains.montezuma.states import (
    KINDS,
    POSITIVE,
    RoomStates,
    choose,
    emulator_of_process,
    expert_play,
    gather,
    kinds_of,
    labels_of,
    may_be_held_out,
    origins_of,
    standing_places,
)
from hypogoal.domains.montezuma.sub_goals import CLIMB_DOWN, SUB_GOALS
from hypogoal.observations import digest

pytestmark = pytest.mark.atari

TINY = MontezumaConfig(states_per_room=24, unlabelled_per_room=10, heldout_per_room=6, workers=1)
SEED = 3
RUNNING_ON = {index for index, ladder in enumerate(LADDERS) if ladder.runs_on}
BASE_ROOMS = {ladder.base.room for ladder in LADDERS if not ladder.runs_on}


@pytest.fixture(scope="module")
def one() -> Collected:
    """N = 1, this process."""
    return DOMAIN.collect(TINY, SEED, Progress("collect", 1, quiet=True))


@pytest.fixture(scope="module")
def two() -> Collected:
    """N = 2, two others."""
    return DOMAIN.collect(TINY.model_copy(update={"groups": 2, "workers": 2}), SEED, Progress("collect", 1, quiet=True))


@pytest.fixture(scope="module")
def fresh() -> tuple[Collected, Progress]:
    """N = 1, other held-out states."""
    progress = Progress("collect", 1, quiet=True)
    return DOMAIN.collect(TINY.model_copy(update={"heldout_seed": 1}), SEED, progress), progress


@pytest.fixture(scope="module")
def first_room() -> RoomStates:
    """Labelled states of room 1."""
    return gather(1, 150, SEED, ("test",), held_out=False, unclear=False, sub_goals=[CLIMB_DOWN])


def part(states: States, where: NDArray[np.bool_], without: str = "") -> dict[str, NDArray[np.generic]]:
    """Everything of some states, by name."""
    origins = {name: values[where] for name, values in states.origins.items() if name != without}
    return {"observations": states.observations[where], "labels": states.labels[where], **origins}


def assert_same(left: dict[str, NDArray[np.generic]], right: dict[str, NDArray[np.generic]]) -> None:
    """The same to the byte."""
    assert left.keys() == right.keys()
    for name, values in left.items():
        np.testing.assert_array_equal(values, right[name], err_msg=name)


def ram(**values: list[int]) -> NDArray[np.uint8]:
    """RAM (n, 128) with these bytes; else alive, walking on the ground."""
    count = len(values["room"])
    memory = np.zeros((count, 128), np.uint8)
    for name, given in ({"pose": [18] * count, "jump": [255] * count} | values).items():
        memory[:, RAM[name]] = given
    return memory


def test_sets_and_sizes(one: Collected, two: Collected) -> None:
    """Spec B4, B5: of each room as many states as asked for: the groups' rooms, the unlabelled two, all 24."""
    for data, groups in ((one, (1,)), (two, (1, 2, 6))):
        assert Counter(data.labelled.origins["room"].tolist()) == dict.fromkeys(groups, 24)
        assert Counter(data.unlabelled.origins["room"].tolist()) == dict.fromkeys((9, 18), 10)
        assert Counter(data.heldout.origins["room"].tolist()) == dict.fromkeys(range(ROOMS), 6)
        for states in (data.labelled, data.unlabelled, data.heldout):
            count = len(states.labels)
            assert states.labels.shape == (count, 1)
            assert states.observations.shape == (count, 84, 84, 4)
            assert (states.observations.max((1, 2)) > 0).all(), "a blank frame"
            assert {(values.dtype, len(values)) for values in states.origins.values()} == {(np.dtype(np.int64), count)}
        assert set(data.heldout.origins) - set(data.labelled.origins) == {"seen"}


def test_labels_follow_from_position_and_life(one: Collected, two: Collected) -> None:
    """Spec B4, B5: reached within two units of a base, alive, and nowhere else; positives wherever a base counts."""
    for states in (one.labelled, two.labelled, one.heldout):
        origins = states.origins
        for index in range(len(states.labels)):
            room, x, y = (int(origins[name][index]) for name in ("room", "x", "y"))
            at = [
                number
                for number, ladder in enumerate(LADDERS)
                if room == ladder.base.room and abs(x - ladder.base.x) <= 2 and abs(y - ladder.base.y) <= 2
            ]
            assert [origins["ladder"][index]] == (at or [-1])
            assert states.labels[index, 0] == (bool(at) and not origins["dying"][index])
            assert origins["group"][index] == {1: 1, 2: 2, 6: 2}.get(room, origins["group"][index])
        rooms = set(np.unique(origins["room"]).tolist())
        assert set(np.unique(origins["room"][states.labels[:, 0]]).tolist()) == BASE_ROOMS & rooms
        assert (states.labels[:, 0] <= (origins["kind"] == KINDS.index("base"))).all()


def test_states_are_those_of_the_game(first_room: RoomStates, monkeypatch: pytest.MonkeyPatch) -> None:
    """Spec B4, B5: replayed, the rollouts show each state, and the emulator agrees on position, life and actions."""
    wanted = {digest(stack): index for index, stack in enumerate(first_room.observations)}
    labels, origins = labels_of(first_room.ram, [CLIMB_DOWN])[:, 0], origins_of(first_room, CLIMB_DOWN)
    emulator = emulator_of_process()
    played: list[int] = []
    step = emulator.step
    monkeypatch.setattr(emulator, "step", lambda action: (played.append(action), step(action))[1])
    for _ in islice(expert_play(emulator, 1, rng_for(SEED, "test", 1), [CLIMB_DOWN]), 5000):
        index = wanted.pop(digest(emulator.stack), None)
        if index is not None:
            room, x, y = emulator.position()
            bases = [ladder.base for ladder in LADDERS if ladder.base.room == room]
            at = any(abs(x - base.x) <= 2 and abs(y - base.y) <= 2 for base in bases)
            assert labels[index] == (at and emulator.alive())
            assert [origins[name][index] for name in ("room", "x", "y")] == [room, x, y]
            assert origins["dying"][index] != emulator.alive()
            assert [origins[name][index] for name in ("previous_action", "action")] == played[-2:]
        if not wanted:
            break
    assert not wanted


def test_kinds() -> None:
    """Spec B5: kinds by hand: dying comes first, then the base, what is near it, ladders, tops, jumps."""
    memory = ram(
        room=[1, 1, 1, 1, 1, 1, 1, 2, 14, 2],
        x=[21, 21, 33, 34, 21, 77, 21, 77, 77, 30],
        y=[148, 148, 148, 148, 160, 213, 192, 200, 162, 250],
        dying=[0, 9, 0, 0, 0, 0, 0, 0, 0, 0],
        pose=[18, 22, 18, 18, 10, 10, 8, 0, 6, 6],
        jump=[255, 255, 255, 255, 255, 255, 255, 255, 4, 4],
    )
    found = [KINDS[kind] for kind in kinds_of(memory)]
    assert found[:5] == ["base", "dying", "near-base", "elsewhere", "near-base"]
    assert found[5:] == ["on-ladder", "top", "on-ladder", "top", "jumping"]
    assert labels_of(memory, [CLIMB_DOWN])[:, 0].tolist() == [True] + [False] * 9
    assert set(KINDS) == {"base", "near-base", "on-ladder", "top", "jumping", "dying", "elsewhere"}


def test_all_kinds_are_brought_about(first_room: RoomStates) -> None:
    """Spec B5: in room 1 every kind occurs, a tenth of the states or more are positive, each ladder has some."""
    origins, labels = origins_of(first_room, CLIMB_DOWN), labels_of(first_room.ram, [CLIMB_DOWN])[:, 0]
    assert set(origins["kind"].tolist()) == set(range(len(KINDS)))
    assert 15 <= labels.sum() <= 60
    assert {LADDERS[index].name for index in origins["ladder"][labels]} == {"1L", "1M", "1R"}
    assert len({digest(stack) for stack in first_room.observations}) == 150


def test_choice_prefers_what_is_rare() -> None:
    """Spec B5: each kind gets its share, from as many positions as there are, and nothing is taken twice."""
    rng = np.random.default_rng(0)
    kinds = np.array([POSITIVE] * 300 + [1] * 4 + [6] * 700)
    positions = np.zeros((len(kinds), 3), np.int64)
    positions[:10, 1] = np.arange(1, 11)  # ten of the first kind are where no other is
    kept = choose(kinds, positions, 100, rng)
    assert len(set(kept.tolist())) == len(kept) == 100
    assert (kinds[kept] == POSITIVE).sum() >= 20
    assert set(range(10)) | set(range(300, 304)) <= set(kept.tolist())
    assert len(choose(kinds[:5], positions[:5], 5, rng)) == 5


def test_bases_that_run_on_are_labelled_nowhere(one: Collected, two: Collected) -> None:
    """Spec B5: no labelled or held-out state is at such a base, alive or not; unlabelled ones may be."""
    for states in (one.labelled, two.labelled, one.heldout):
        assert not RUNNING_ON & set(states.origins["ladder"].tolist())
    for unclear in (False, True):
        found = gather(4, 60, SEED, ("test",), held_out=False, unclear=unclear, sub_goals=[CLIMB_DOWN])
        assert (RUNNING_ON & set(origins_of(found, CLIMB_DOWN)["ladder"].tolist()) != set()) == unclear


def test_held_out_states_do_not_depend_on_what_is_labelled(one: Collected, two: Collected) -> None:
    """Spec B5, F1: the same held-out states for every N, and the labelled and unlabelled ones common to both too."""
    everything = np.ones(len(one.heldout.labels), np.bool_)
    assert_same(part(one.heldout, everything, "seen"), part(two.heldout, everything, "seen"))
    assert_same(part(one.labelled, np.ones(24, np.bool_)), part(two.labelled, two.labelled.origins["room"] == 1))
    everything = np.ones(len(one.unlabelled.labels), np.bool_)
    assert_same(part(one.unlabelled, everything), part(two.unlabelled, everything))


def test_seen(one: Collected, two: Collected) -> None:
    """Spec F1: 2 in the labelled rooms, 1 in the unlabelled ones, 0 in all others."""
    for data, groups in ((one, (1,)), (two, (1, 2, 6))):
        expected = dict.fromkeys(range(ROOMS), 0) | {9: 1, 18: 1} | dict.fromkeys(groups, 2)
        rooms, seen = data.heldout.origins["room"], data.heldout.origins["seen"]
        assert dict(zip(rooms.tolist(), seen.tolist(), strict=True)) == expected


def test_no_stack_is_twice_and_none_on_both_sides(two: Collected) -> None:
    """Spec B5: stacks of a set are all different, held-out ones are in no other set, whatever the seed."""
    digests = [
        [digest(stack) for stack in states.observations] for states in (two.labelled, two.unlabelled, two.heldout)
    ]
    assert all(len(set(names)) == len(names) for names in digests)
    assert [{may_be_held_out(name) for name in names} for names in digests] == [{False}, {False}, {True}]


def test_seeds(one: Collected, fresh: tuple[Collected, Progress]) -> None:
    """Spec A8, F1: a stream's states are the same in any order of rooms; held-out draws leave the rest alone."""

    def draw(room: int, seed: int) -> RoomStates:
        return gather(room, 5, seed, ("test",), held_out=True, unclear=False, sub_goals=[CLIMB_DOWN])

    first, second = draw(6, 0), draw(23, 0)
    assert np.array_equal(draw(23, 0).observations, second.observations)
    assert np.array_equal(draw(6, 0).observations, first.observations)
    assert not np.array_equal(draw(6, 1).observations, first.observations)
    everything = np.ones(len(one.labelled.labels), np.bool_)
    assert_same(part(one.labelled, everything), part(fresh[0].labelled, everything))
    assert not np.array_equal(one.heldout.observations, fresh[0].heldout.observations)


def test_unlabelled_rooms() -> None:
    """Spec B5: a ladder room without labels and room 18; where every ladder has labels, two rooms without ladders."""
    chosen = [unlabelled_rooms(MontezumaConfig(groups=groups)) for groups in range(1, 8)]
    assert chosen == [(9, 18), (9, 18), (9, 18), (21, 18), (19, 18), (22, 18), (18, 12)]
    for groups, rooms in enumerate(chosen, start=1):
        assert not set(rooms) & set(labelled_rooms(MontezumaConfig(groups=groups)))
    assert len(labelled_rooms(MontezumaConfig(groups=7))) == 16


def test_progress_counts_states(fresh: tuple[Collected, Progress]) -> None:
    """Spec A1: progress knows from the start how many states there will be, and reaches them."""
    assert fresh[1].done == fresh[1].total == 24 + 2 * 10 + 24 * 6


def test_what_cannot_be_collected(monkeypatch: pytest.MonkeyPatch) -> None:
    """Spec G2: one line for a room that does not exist, and for more states than a room shows."""
    with pytest.raises(UserError, match=r"no such room: 24\. Rooms are 0 to 23"):
        gather(24, 5, SEED, ("test",), held_out=False, unclear=False, sub_goals=[CLIMB_DOWN])
    monkeypatch.setattr(montezuma_states, "MOST_STEPS", 1)
    with pytest.raises(UserError, match="room 16 does not show 50 different states"):
        gather(16, 50, SEED, ("test",), held_out=False, unclear=False, sub_goals=[CLIMB_DOWN])


def test_stopped_processes_are_not_waited_for() -> None:
    """Spec A1: when collecting is stopped, the processes that play stop too, in the midst of a long room."""

    class Stopped(Progress):
        def advance(self, n: int = 1, **numbers: float) -> None:
            raise KeyboardInterrupt

    begin = time.monotonic()
    config = TINY.model_copy(update={"workers": 2, "states_per_room": 10_000, "heldout_per_room": 1})
    with pytest.raises(KeyboardInterrupt):
        DOMAIN.collect(config, SEED, Stopped("collect", 1, quiet=True))
    assert not multiprocessing.active_children()
    assert time.monotonic() - begin < 30


def test_agents_are_put_where_one_can_stand() -> None:
    """Spec B5: the agent can climb neither into the floor that it stands on nor up into the air, away from ladders."""
    emulator = emulator_of_process()
    rng = np.random.default_rng(0)
    for room in range(ROOMS):
        places = standing_places(emulator, room)
        shafts = [ladder.top.x for ladder in LADDERS if ladder.top.room == room]
        free = places[[min((abs(x - shaft) for shaft in shafts), default=99) > 8 for x in places[:, 0]]]
        for x, y in rng.permutation(free)[:3].tolist():
            for action in (DOWN, UP):
                if emulator.place(room, x, y) is None:
                    continue
                emulator.frames(action, FRAME_SKIP)
                stays = emulator.position().y == y or emulator.read("fall") > 0 or not emulator.alive()
                assert stays, (room, x, y, action, emulator.position())


@pytest.mark.parametrize("room", [1, 6, 22])
def test_picture_and_pixel(room: int) -> None:
    """Spec F4: the room's picture lacks the agent; the agent is drawn within four pixels of where ``pixel`` says."""
    emulator = emulator_of_process()
    empty = picture(emulator, room)
    assert empty.shape == (210, 160, 3)
    for x, y in [(ladder.base.x, ladder.base.y) for ladder in LADDERS if ladder.base.room == room] + [(40, 235)]:
        emulator.place(room, x, y, settle=0)
        emulator.frames(NOOP, 1)
        rows, columns = np.nonzero((emulator.screen_rgb() != empty).any(2))
        column, row = pixel(np.array([[room, x, y]]))[0]
        assert abs((columns.min() + columns.max()) / 2 - column) <= 4
        assert abs((rows.min() + rows.max()) / 2 - row) <= 4
        assert np.ptp(columns) < SPRITE_WIDTH and np.ptp(rows) < SPRITE_HEIGHT
    assert np.array_equal(DOMAIN.picture(room), empty)


def test_the_domain_interface() -> None:
    """Spec B6, D4: found by name, with starts, distances, rooms and defaults that the stages take."""
    domain = load_domain("montezuma")
    assert isinstance(domain, Domain)
    assert domain is DOMAIN
    assert DOMAIN.starts[:4] == ("1L", "1M", "1R", "0-4") and DOMAIN.rooms_of("up-2-6") == (6, 2)
    assert DOMAIN.rooms_of("2-6") == (2, 6) and DOMAIN.rooms_of("1L") == (1,)
    assert DOMAIN.kinds == KINDS
    bases = np.array([ladder.base for ladder in LADDERS])
    assert DOMAIN.distance(bases).tolist() == [0] * 12
    assert DOMAIN.distance(bases[:1] + np.array([0, 5, 0])).tolist() == [5]
    assert DOMAIN.pixel(bases).shape == (12, 2)
    for stage in ("train-ensemble", "train-options"):
        config, plain = settings_of(stage, "montezuma"), model_of(stage)()
        own = defaults_of("montezuma", stage)
        assert all(getattr(config, key) == value != getattr(plain, key, None) for key, value in own.items())


def test_engine_and_environment_agree() -> None:
    """Spec B6: the engine that the domain makes shows what its Gymnasium environment does; labels in one order."""
    engine = DOMAIN.make_engine(0, 2, 50, start="1R", start_states=2)
    env = gymnasium.make(DOMAIN.env_id, start="1R", start_states=2)
    image, info = env.reset(options={"start_state": 0})
    assert np.array_equal(engine.images(np.array([0]))[0], image)
    assert engine.max_steps == 50
    assert image.shape == DOMAIN.observation_shape
    assert tuple(info["labels"]) == DOMAIN.sub_goals == tuple(SUB_GOALS)
    for _ in range(LADDERS[2].steps_down):
        assert not env.unwrapped.labels()[0]
        *_, info = env.step(DOWN)
    assert info["position"] == Position(*LADDERS[2].base)
    assert env.unwrapped.labels()[0]
