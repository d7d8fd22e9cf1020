"""States of a room of Montezuma's Revenge from scripted play, with kinds and labels (Spec B4, B5)."""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import cache
from itertools import cycle
from typing import Any, NamedTuple

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from numpy.typing import NDArray

from hypogoal.core.errors import UserError
from hypogoal.core.seeding import rng_for
from hypogoal.domains.montezuma import emulator as game
from hypogoal.domains.montezuma.emulator import RAM, Emulator, Position
from hypogoal.domains.montezuma.ladders import (
    BASES,
    GROUPS,
    LADDERS,
    REACH,
    SHAFT_ENTRY,
    SHAFT_EXIT,
    TOPS,
    Ladder,
    at_base,
    within,
)
from hypogoal.domains.montezuma.sub_goals import FACT_BYTES, SubGoal
from hypogoal.observations import digest

KINDS = ("base", "near-base", "on-ladder", "top", "jumping", "dying", "elsewhere")
BASE, NEAR_BASE, CLIMBING, TOP, JUMPING, DYING, ELSEWHERE = range(len(KINDS))
NEAR = 12  # from a base, in RAM units, in x and in y
LADDER_POSES = (game.ON_LADDER, 0)  # climbing, holding still; on ropes 14 and 4
ON_GROUND = 255  # the RAM's value for the jump without one

POSITIVE = len(KINDS)  # in place of its kind, where a sub-goal holds
# The least shares of a room's states by kind, as far as the rollouts reached them.
KIND_SHARES = {POSITIVE: 0.2, NEAR_BASE: 0.15, CLIMBING: 0.15, TOP: 0.05, JUMPING: 0.1, DYING: 0.1}
SPARE = 1.25  # states to gather, relative to those to keep
# Play in a room until these shares of the states to keep are positive, at all its bases and at each.
FEWEST_POSITIVES, FEWEST_AT_A_BASE = 0.1, 0.02
MOST_STEPS = 60  # agent steps per state to keep, after which a room is given up; two to four are usual
HELD_OUT_EACH = 3  # every third stack, by digest, is for the held-out set

ROLLOUT_STEPS = 40
SETTLE = 4  # agent steps that fill the stack with frames of the start
PHASES = (2, 200)  # frames for which the room's enemies move before the first step
ROLLOUTS_PER_PHASE = 4
STARTS = {"spot": 0.5, "ladder": 0.15, "side": 0.1, "anywhere": 0.25}  # shares, among the kinds that a room has

LONGEST_REPEAT = 8  # agent steps of one action
JITTER = 0.1  # share of the steps with another action in between
HEADINGS = (game.DOWN, game.UP, game.LEFT, game.RIGHT)
HEADING = 0.7  # share of the actions that are a heading; the others are any action
CLOSE = 1  # distance from a spot, in RAM units, at which an agent that heads for it stops
STEPS_ASIDE = 3  # most steps from a spot or side before a rollout begins
HELD = 0.5  # share of the starts at a spot where the agent stays there, against the conveyor belt in room 1
STRIDE = 4  # RAM units that the agent walks or climbs in an agent step

# Where the agent can be placed.
BLACK_SHARE = 0.95  # of the agent's box if it stands in the open; the rows of its feet are all black
FEET = 4  # rows
SNAP = 3  # in some rooms the floor is drawn so much below the row of entry
LAVA_ROOMS = (10, 18, 20, 22)
LAVA_BELOW = 220  # y; the agent stands on lava only if placed there


@dataclass(frozen=True)
class RoomStates:
    """States of one or several rooms."""

    observations: NDArray[np.uint8]  # (n, 84, 84, 4)
    ram: NDArray[np.uint8]  # (n, 128), the console's memory
    actions: NDArray[np.int64]  # (n, 2), the last one and the one before it


def positions_of(ram: NDArray[np.uint8]) -> NDArray[np.int64]:
    """Room, x, y, int64 (n, 3), from RAM (n, 128)."""
    return ram[:, [RAM["room"], RAM["x"], RAM["y"]]].astype(np.int64)


def labels_of(ram: NDArray[np.uint8], sub_goals: Sequence[SubGoal]) -> NDArray[np.bool_]:
    """Spec B4: whether each sub-goal holds, bool (n, G), from RAM (n, 128) alone."""
    facts, alive = ram[:, FACT_BYTES].astype(np.int64), ram[:, RAM["dying"]] == 0
    return np.stack([sub_goal.holds(facts, alive) for sub_goal in sub_goals], axis=1)


def kinds_of(ram: NDArray[np.uint8]) -> NDArray[np.int64]:
    """Each state's kind, an index into ``KINDS``, int64 (n,): dying first, else the first that fits."""
    positions = positions_of(ram)
    fits = {
        DYING: ram[:, RAM["dying"]] > 0,
        BASE: at_base(positions),
        NEAR_BASE: within(positions, BASES, NEAR).any(1),
        CLIMBING: np.isin(ram[:, RAM["pose"]], LADDER_POSES),
        TOP: within(positions, TOPS, REACH).any(1),
        JUMPING: ram[:, RAM["jump"]] != ON_GROUND,
    }
    return np.select(list(fits.values()), list(fits), default=ELSEWHERE).astype(np.int64)


def origins_of(states: RoomStates, sub_goal: SubGoal) -> dict[str, NDArray[np.int64]]:
    """The states' origins, int64 (n,) each.

    room, x, y; group 1..7 of the room (0: it has no ladder); kind, an index into ``KINDS``; ladder, the index of the
    sub-goal's place at which the state is, see ``SubGoal.at``; dying, 0 or 1; action, 0..17, that led to the last
    frame, and previous_action, that led to the one before.
    """
    positions = positions_of(states.ram)
    group = np.zeros(len(positions), np.int64)
    for number, rooms in enumerate(GROUPS, start=1):
        group[np.isin(positions[:, 0], rooms)] = number
    return {
        "room": positions[:, 0],
        "x": positions[:, 1],
        "y": positions[:, 2],
        "group": group,
        "kind": kinds_of(states.ram),
        "ladder": sub_goal.at(states.ram[:, FACT_BYTES].astype(np.int64)),
        "dying": (states.ram[:, RAM["dying"]] > 0).astype(np.int64),
        "action": states.actions[:, 0],
        "previous_action": states.actions[:, 1],
    }


def may_be_held_out(looks: bytes) -> bool:
    """Whether a stack is for testing, by its digest; all others are for training.

    Only the stack's bytes decide, so no stack is ever on both sides, and the held-out set does not depend on which
    states are labelled.
    """
    return looks[0] % HELD_OUT_EACH == 0


@cache
def emulator_of_process() -> Emulator:
    """One emulator for all rooms of a process; a room's states do not depend on the rooms before it."""
    return Emulator()


def gather(
    room: int,
    wanted: int,
    seed: int,
    stream: tuple[str | int, ...],
    *,
    sub_goals: Sequence[SubGoal],
    held_out: bool,
    unclear: bool,
) -> RoomStates:
    """``wanted`` different states of a room: rollouts until there are enough, then a choice among them.

    ``seed`` and ``stream`` determine all randomness, see ``rng_for``; ``held_out``, the side of ``may_be_held_out``;
    ``unclear``, whether to keep states at unclear places, such as bases of ladders that continue through the floor. A
    room with too few different states is a ``UserError``.
    """
    rng = rng_for(seed, *stream, room)
    left_out = set() if unclear else {(goal.name, place) for goal in sub_goals for place in goal.unclear}
    present = {(goal.name, place) for goal in sub_goals for place, at in enumerate(goal.places) if at.room == room}
    positives = dict.fromkeys(present - left_out, 0)

    def enough() -> bool:
        if len(pool) < SPARE * wanted:
            return False
        each = positives.values()
        return not each or (sum(each) >= FEWEST_POSITIVES * wanted and min(each) >= FEWEST_AT_A_BASE * wanted)

    seen: set[bytes] = set()
    pool: list[Shown] = []
    for step, shown in enumerate(expert_play(emulator_of_process(), room, rng, sub_goals)):
        if enough() or step == MOST_STEPS * wanted:
            break
        looks = digest(shown.stack)
        if looks in seen or may_be_held_out(looks) != held_out:
            continue
        seen.add(looks)
        facts = shown.ram[None, FACT_BYTES].astype(np.int64)
        places = {(goal.name, int(goal.at(facts)[0])) for goal in sub_goals}
        if places & left_out:
            continue
        pool.append(shown)
        if shown.ram[RAM["dying"]] == 0:
            for place in places & positives.keys():
                positives[place] += 1
    if len(pool) < wanted:
        fault = f"room {room} does not show {wanted} different states"
        raise UserError(fault, f"{len(pool)} in {step} steps", "Ask for fewer.")
    ram = np.stack([shown.ram for shown in pool])
    kinds = np.where(labels_of(ram, sub_goals).any(1), POSITIVE, kinds_of(ram))
    chosen = [pool[index] for index in choose(kinds, positions_of(ram), wanted, rng)]
    return RoomStates(
        np.stack([shown.stack for shown in chosen]),
        np.stack([shown.ram for shown in chosen]),
        np.array([(shown.action, shown.previous_action) for shown in chosen]),
    )


def choose(
    kinds: NDArray[np.int64], positions: NDArray[np.int64], wanted: int, rng: np.random.Generator
) -> NDArray[np.int64]:
    """Ordered indices of ``wanted`` of n states: each kind's share, spread over positions; the others at random."""
    order = rng.permutation(len(kinds))
    latest: dict[tuple[int, ...], int] = {}  # by kind and position, the last rank so far
    ranks = np.empty(len(kinds), np.int64)  # within its kind and position
    for index in order.tolist():
        same = (int(kinds[index]), *positions[index].tolist())
        ranks[index] = latest[same] = latest.get(same, -1) + 1
    spread = order[np.argsort(ranks[order], kind="stable")]
    shares = [spread[kinds[spread] == kind][: int(share * wanted)] for kind, share in KIND_SHARES.items()]
    first = np.concatenate(shares)
    others = order[~np.isin(order, first)][: wanted - len(first)]
    return np.sort(np.concatenate([first, others]))


class Placing(NamedTuple):
    """Where a rollout begins: the agent is placed there, then plays ``action`` for ``steps`` agent steps, undrawn."""

    x: int
    y: int
    action: int = game.NOOP
    steps: int = 0
    hold: bool = False  # while the stack fills, return to the nearby base instead of doing nothing


class Shown(NamedTuple):
    """One state of a rollout: the observation, uint8 (84, 84, 4), the RAM, uint8 (128,), and the last two actions."""

    stack: NDArray[np.uint8]
    ram: NDArray[np.uint8]
    action: int
    previous_action: int


def expert_play(
    emulator: Emulator, room: int, rng: np.random.Generator, sub_goals: Sequence[SubGoal]
) -> Iterator[Shown]:
    """Spec B5: endlessly, the states of rollouts from around a room's spots, ladders, sides and platforms.

    Actions are repeated, most of them headings; some lead to a spot. A rollout ends when the agent leaves the room or
    would revive after a death.
    """
    spots = [spot for goal in sub_goals for spot in goal.spots or goal.places if spot.room == room]
    sides = [side for goal in sub_goals for side in goal.sides if side.room == room]
    starts = _starts(emulator, room, rng, spots, sides)
    kinds = list(starts)
    weights = np.array([STARTS[kind] for kind in kinds])
    while True:
        scene = _scene(emulator, room, rng)
        for _ in range(ROLLOUTS_PER_PHASE):
            emulator.restore(scene)
            start = starts[kinds[rng.choice(len(kinds), p=weights / weights.sum())]]()
            if (begun := _begin(emulator, room, start, spots)) is not None:
                yield from _rollout(emulator, room, begun, _expert_actions(emulator, spots, rng))


def _rollout(emulator: Emulator, room: int, begun: tuple[int, int], actions: Iterator[int]) -> Iterator[Shown]:
    shown = Shown(emulator.stack, emulator.ram().copy(), *begun)
    yield shown
    for action in actions:
        emulator.step(action)
        ram = emulator.ram().copy()
        revived = shown.ram[RAM["dying"]] > 0 and ram[RAM["dying"]] == 0
        if revived or ram[RAM["room"]] != room or emulator.ale.game_over():
            return
        shown = Shown(emulator.stack, ram, action, shown.action)
        yield shown


def _expert_actions(emulator: Emulator, spots: Sequence[Position], rng: np.random.Generator) -> Iterator[int]:
    action, left = game.NOOP, 0
    homing = rng.random() if spots else 0.0
    for _ in range(ROLLOUT_STEPS):
        if left == 0 and rng.random() < homing:
            action, left = _towards(emulator.position(), spots)
        elif left == 0:
            heading = rng.random() < HEADING
            action = HEADINGS[rng.integers(len(HEADINGS))] if heading else int(rng.integers(game.N_ACTIONS))
            left = int(rng.integers(1, LONGEST_REPEAT + 1))
        left -= 1
        yield int(rng.integers(game.N_ACTIONS)) if rng.random() < JITTER else action


def _towards(position: Position, spots: Sequence[Position]) -> tuple[int, int]:
    """An action that moves the agent to the nearest spot or holds it there, and its number of agent steps."""
    spot = min(spots, key=lambda spot: abs(position.x - spot.x) + abs(position.y - spot.y))
    aside = spot.x - position.x
    if abs(aside) > CLOSE:
        return (game.RIGHT if aside > 0 else game.LEFT), max(1, round(abs(aside) / STRIDE))
    upwards = position.y < spot.y and spot in TOPS and spot not in BASES
    return (game.DOWN if position.y > spot.y else game.UP if upwards else game.NOOP), 1


def _scene(emulator: Emulator, room: int, rng: np.random.Generator) -> game.Snapshot:
    """The room with its enemies at a random phase; the agent is placed later."""
    while True:
        scene = emulator.place(
            room, game.RIGHT_EDGE, game.EDGE_Y, phase=int(rng.integers(*PHASES, endpoint=True)), settle=0
        )
        if scene is not None:
            return scene


def _begin(emulator: Emulator, room: int, start: Placing, spots: Sequence[Position]) -> tuple[int, int] | None:
    """Bring the agent to its start and fill the stack; the last two actions, None unless it is alive in the room."""
    emulator.write("x", start.x)
    emulator.write("y", start.y)
    emulator.frames(start.action, game.FRAME_SKIP * start.steps)
    action = previous = game.NOOP
    for _ in range(SETTLE):
        previous = action
        action = _towards(emulator.position(), spots)[0] if start.hold else game.NOOP
        emulator.step(action)
    return (action, previous) if emulator.alive() and emulator.position().room == room else None


def _starts(
    emulator: Emulator, room: int, rng: np.random.Generator, spots: Sequence[Position], sides: Sequence[Position]
) -> dict[str, Callable[[], Placing]]:
    """A function for each kind of start that the room has, which draws one. Several of a kind take turns."""
    places = standing_places(emulator, room)
    spots_in_turn, sides_in_turn = _in_turn(spots, rng), _in_turn(sides, rng)
    climbs = _in_turn([climb for ladder in LADDERS for climb in _climbs(ladder) if climb[0].room == room], rng)

    def beside(spot: Position, held: float) -> Placing:
        x = spot.x + int(rng.integers(-REACH, REACH + 1))
        if rng.random() < held:
            return Placing(x, spot.y, hold=True)
        return Placing(x, spot.y, (game.LEFT, game.RIGHT)[rng.integers(2)], int(rng.integers(STEPS_ASIDE + 1)))

    def climbing(end: Position, action: int, longest: int) -> Placing:
        return Placing(end.x, end.y, action, int(rng.integers(1, longest + 1)))

    starts: dict[str, Callable[[], Placing]] = {}
    if spots_in_turn:
        starts["spot"] = lambda: beside(next(spots_in_turn), HELD)
    if climbs:
        starts["ladder"] = lambda: climbing(*next(climbs))
    if sides_in_turn:
        starts["side"] = lambda: beside(next(sides_in_turn), 0.0)
    starts["anywhere"] = lambda: Placing(*places[rng.integers(len(places))].tolist())
    return starts


def standing_places(emulator: Emulator, room: int) -> NDArray[np.int64]:
    """Places x, y (n, 2) of a room where an agent placed there stands on something, in the open.

    Many places lie inside walls, where the game does not stop the agent from climbing about. So the agent's box must be
    black, with something under its feet. Room 15 has no black places; for it, the row of entry is taken.
    """
    black = (game.picture(emulator, room) == 0).all(2)
    x = np.arange(game.LEFT_EDGE, game.RIGHT_EDGE + 1)
    y = np.arange(SHAFT_EXIT, SHAFT_ENTRY + 1)
    boxes = sliding_window_view(
        black, (game.SPRITE_HEIGHT + 1, game.SPRITE_WIDTH)
    )  # the last row is the one under the feet
    boxes = boxes[np.ix_(game.SPRITE_TOP - y, x + game.SPRITE_LEFT)]
    stands = (boxes[:, :, :-1].mean((2, 3)) >= BLACK_SHARE) & boxes[:, :, -1 - FEET : -1].all((2, 3))
    stands &= boxes[:, :, -1].mean(2) <= 0.5
    if room in LAVA_ROOMS:
        stands[y < LAVA_BELOW] = False
    rows, columns = np.nonzero(stands)
    if not len(rows):
        return np.stack([x, np.full_like(x, game.EDGE_Y)], axis=1)
    level = np.where(np.abs(y - game.EDGE_Y) <= SNAP, game.EDGE_Y, y)
    return np.unique(np.stack([x[columns], level[rows]], axis=1), axis=0)


def _in_turn(items: Sequence[Any], rng: np.random.Generator) -> Iterator[Any] | None:
    """Cycles through the items in a random order; None if there are none."""
    return cycle([items[index] for index in rng.permutation(len(items)).tolist()]) if items else None


def _climbs(ladder: Ladder) -> list[tuple[Position, int, int]]:
    """Both climbs of a ladder: the start, the action, and the most agent steps without leaving the room."""
    one_room = ladder.top.room == ladder.base.room
    up = (ladder.top.y if one_room else SHAFT_ENTRY) - ladder.base.y
    down = ladder.top.y - (ladder.base.y if one_room else SHAFT_EXIT)
    return [(ladder.base, game.UP, up // STRIDE - 1), (ladder.top, game.DOWN, down // STRIDE - 1)]
