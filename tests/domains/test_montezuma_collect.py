"""Montezuma's Revenge: collected states, their labels and origins, and the domain (Spec B4-B7)."""

from collections import Counter
from itertools import islice

import numpy as np
import pytest

from hypogoal.core.config import Config, model_of, resolve
from hypogoal.core.errors import UserError
from hypogoal.core.progress import Progress
from hypogoal.core.seeding import rng_for
from hypogoal.data import Collected, States
from hypogoal.domains.find import settings_of
from hypogoal.domains.montezuma import emulator as game
from hypogoal.domains.montezuma import states as montezuma_states
from hypogoal.domains.montezuma.domain import DOMAIN, MontezumaConfig
from hypogoal.domains.montezuma.emulator import DYING, JUMP, POSE, ROOM, ROOMS, X, Y
from hypogoal.domains.montezuma.expert import Expert, Shown, find_standing_places
from hypogoal.domains.montezuma.ladders import BASES, LADDERS, TOPS
from hypogoal.domains.montezuma.states import HELD_OUT_EACH, KINDS, POSITIVE, choose, describe_states, gather
from hypogoal.domains.montezuma.sub_goals import CLIMB_DOWN
from hypogoal.observations import digest

pytestmark = pytest.mark.atari

TINY = MontezumaConfig(states_per_room=24, unlabelled_per_room=10, heldout_per_room=6, workers=1)
SEED = 3
RUNNING_ON = {index for index, base in enumerate(BASES) if base in TOPS}


def states_in(room: int, wanted: int = 5, seed: int = SEED, split: str = "labelled") -> States:
    return gather(split, room, wanted, seed, [CLIMB_DOWN])


@pytest.fixture(scope="module")
def one() -> Collected:
    """N = 1, this process."""
    return DOMAIN.collect(TINY, SEED, Progress("collect", 1, quiet=True))


@pytest.fixture(scope="module")
def two() -> Collected:
    """N = 2, two others."""
    return DOMAIN.collect(TINY.model_copy(update={"groups": 2, "workers": 2}), SEED, Progress("collect", 1, quiet=True))


@pytest.fixture(scope="module")
def first_room() -> States:
    """Labelled states of room 1."""
    return states_in(1, 150)


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
    """Spec B4, B5: reached within two units of a base, alive, and nowhere else; no state where ladders run on."""
    for states in (one.labelled, two.labelled, one.heldout):
        origins = states.origins
        positions = np.stack([origins[name] for name in ("room", "x", "y")], axis=1)
        apart = np.abs(positions[:, None] - np.array(BASES))
        at = (apart[..., 0] == 0) & (apart[..., 1:] <= 2).all(-1)
        assert np.array_equal(origins["ladder"], np.where(at.any(1), at.argmax(1), -1))
        assert np.array_equal(states.labels[:, 0], at.any(1) & (origins["dying"] == 0))
        assert not RUNNING_ON & set(origins["ladder"].tolist())
        rooms = set(origins["room"].tolist())
        assert set(origins["room"][states.labels[:, 0]].tolist()) == {1, 6, 9, 10, 19, 21, 22} & rooms
    for unclear in (False, True):
        ladders = states_in(4, 60, split="unlabelled" if unclear else "labelled").origins["ladder"]
        assert bool(RUNNING_ON & set(ladders.tolist())) == unclear


def test_states_are_those_of_the_game(first_room: States, monkeypatch: pytest.MonkeyPatch) -> None:
    """Spec B4, B5: replayed, the rollouts show each state, and the emulator agrees on position, life and actions.

    Every kind occurs, a tenth of the states or more are positive, each ladder has some.
    """
    wanted = {digest(stack): index for index, stack in enumerate(first_room.observations)}
    assert len(wanted) == 150
    labels, origins = first_room.labels[:, 0], first_room.origins
    emulator, played = game.Emulator(), [0]
    step = emulator.step
    monkeypatch.setattr(emulator, "step", lambda action: (played.append(action), step(action))[1])
    for shown in islice(Expert(emulator, 1, rng_for(SEED, "montezuma", "labelled", 1), [CLIMB_DOWN]).play(), 5000):
        index = wanted.pop(digest(shown.stack), None)
        if index is None:
            continue
        assert [origins[name][index] for name in ("room", "x", "y")] == [*emulator.position()]
        assert origins["dying"][index] != emulator.alive()
        assert [origins[name][index] for name in ("previous_action", "action")] == played[-2:]
        if not wanted:
            break
    assert not wanted
    assert set(origins["kind"].tolist()) == set(range(len(KINDS)))
    assert 15 <= labels.sum() <= 60
    assert {LADDERS[index].name for index in origins["ladder"][labels]} == {"1L", "1M", "1R"}


def test_kinds() -> None:
    """Spec B5: kinds by hand: dying comes first, then the base, what is near it, ladders, tops, jumps."""
    rows = [  # room, x, y, dying, pose, jump
        ((1, 21, 148, 0, 18, 255), "base"),
        ((1, 21, 148, 9, 22, 255), "dying"),
        ((1, 33, 148, 0, 18, 255), "near-base"),
        ((1, 34, 148, 0, 18, 255), "elsewhere"),
        ((1, 21, 160, 0, 10, 255), "near-base"),
        ((1, 77, 213, 0, 10, 255), "on-ladder"),
        ((1, 21, 192, 0, 8, 255), "top"),
        ((2, 77, 200, 0, 0, 255), "on-ladder"),
        ((14, 77, 162, 0, 6, 4), "top"),
        ((2, 30, 250, 0, 6, 4), "jumping"),
    ]
    shown = []
    for values, _ in rows:
        facts = np.zeros(len(game.FACTS), np.uint8)
        facts[[ROOM, X, Y, DYING, POSE, JUMP]] = values
        shown.append(Shown(np.zeros(game.OBSERVATION_SHAPE, np.uint8), facts, 0, 0))
    states = describe_states(shown, [CLIMB_DOWN])
    assert [KINDS[kind] for kind in states.origins["kind"]] == [kind for _, kind in rows]
    assert states.labels[:, 0].tolist() == [True] + [False] * 9


def test_held_out_states_are_their_own(one: Collected, two: Collected) -> None:
    """Spec B5, F1: the same for every N, where ``seen`` says what N is; no stack is twice, none on both sides."""
    np.testing.assert_array_equal(one.heldout.observations, two.heldout.observations)
    np.testing.assert_array_equal(one.unlabelled.observations, two.unlabelled.observations)
    in_first = two.labelled.origins["room"] == 1
    np.testing.assert_array_equal(one.labelled.observations, two.labelled.observations[in_first])
    for data, groups in ((one, (1,)), (two, (1, 2, 6))):
        expected = dict.fromkeys(range(ROOMS), 0) | {9: 1, 18: 1} | dict.fromkeys(groups, 2)
        rooms, seen = data.heldout.origins["room"], data.heldout.origins["seen"]
        assert dict(zip(rooms.tolist(), seen.tolist(), strict=True)) == expected
    for states, side in ((two.labelled, False), (two.unlabelled, False), (two.heldout, True)):
        digests = [digest(stack) for stack in states.observations]
        assert len(set(digests)) == len(digests) and {look[0] % HELD_OUT_EACH == 0 for look in digests} == {side}


def test_what_cannot_be_collected(monkeypatch: pytest.MonkeyPatch) -> None:
    """Spec G2: one line for more states than a room shows."""
    monkeypatch.setattr(montezuma_states, "MOST_STEPS", 1)
    with pytest.raises(UserError, match="room 16 does not show 50 different states"):
        states_in(16, 50)


def test_agents_are_put_where_one_can_stand() -> None:
    """Spec B5: the agent can climb neither into the floor that it stands on nor up into the air, away from ladders."""
    emulator = game.Emulator()
    rng = np.random.default_rng(0)
    for room in range(ROOMS):
        places = find_standing_places(emulator, room)
        shafts = [top.x for top in TOPS if top.room == room]
        free = places[[min((abs(x - shaft) for shaft in shafts), default=99) > 8 for x in places[:, 0]]]
        for x, y in rng.permutation(free)[:3].tolist():
            for action in (game.DOWN, game.UP):
                if emulator.place(room, x, y) is None:
                    continue
                emulator.frames(action, game.FRAME_SKIP)
                stays = emulator.position().y == y or emulator.read("fall") > 0 or not emulator.alive()
                assert stays, (room, x, y, action, emulator.position())


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


@pytest.mark.parametrize("room", [1, 6, 22])
def test_picture_and_pixel(room: int) -> None:
    """Spec F4: the room's picture lacks the agent; the agent is drawn within four pixels of where ``pixel`` says."""
    emulator = game.Emulator()
    empty = DOMAIN.picture(room)
    assert empty.shape == (210, 160, 3)
    for x, y in [(base.x, base.y) for base in BASES if base.room == room] + [(40, 235)]:
        emulator.place(room, x, y, settle=0)
        emulator.frames(game.NOOP, 1)
        rows, columns = np.nonzero((emulator.ale.getScreenRGB() != empty).any(2))
        column, row = DOMAIN.pixel(np.array([[room, x, y]]))[0]
        assert abs((columns.min() + columns.max()) / 2 - column) <= 4
        assert abs((rows.min() + rows.max()) / 2 - row) <= 4
        assert np.ptp(columns) < game.SPRITE_WIDTH and np.ptp(rows) < game.SPRITE_HEIGHT


def test_the_domains_defaults_are_those_of_its_stages() -> None:
    """Spec B6, D4: each is another than without the domain."""
    for stage in ("train-ensemble", "train-options"):
        config, plain = settings_of(Config, stage, "montezuma").flat(), resolve(model_of(stage), stage=stage).flat()
        own = DOMAIN.defaults[stage]
        assert all(config[key] == value != plain.get(key) for key, value in own.items())
