"""Scripted play in a room of Montezuma's Revenge, from around the places of its sub-goals and elsewhere."""

from collections.abc import Iterator, Sequence
from itertools import cycle
from typing import Any, NamedTuple

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from numpy.random import Generator

from hypogoal.core.arrays import Bytes, Ints
from hypogoal.domains.montezuma import emulator as game
from hypogoal.domains.montezuma.emulator import DYING, ROOM, Emulator, Position
from hypogoal.domains.montezuma.ladders import BASES, LADDERS, SHAFT_ENTRY, SHAFT_EXIT, TOPS
from hypogoal.domains.montezuma.sub_goals import REACH, SubGoal

ROLLOUT_STEPS = 40
PHASES = (2, 200)  # the fewest and the most frames for which a room's enemies move before the first step
ROLLOUTS_PER_PHASE = 4
STARTS = {  # the shares of starts by kind, among the kinds that a room has
    "spot": 0.5,
    "ladder": 0.15,
    "side": 0.1,
    "anywhere": 0.25,
}

LONGEST_REPEAT = 8  # the most agent steps for which one action is repeated
JITTER = 0.1  # share of the steps at which a random action is played instead
HEADINGS = (game.DOWN, game.UP, game.LEFT, game.RIGHT)
HEADING = 0.7  # share of the actions that are a heading; the others are any action
CLOSE = 1  # distance from a spot, in RAM units, at which an agent that heads for the spot stops
STEPS_ASIDE = 3  # the most agent steps away from a spot or side before a rollout begins
HELD = 0.5  # share of the starts at a spot where the agent stays at the spot, against the conveyor belt in room 1
STRIDE = 4  # RAM units that the agent walks or climbs in an agent step

# Where the agent can be placed.
BLACK_SHARE = 0.95  # the least black share of the agent's box in the open; the rows of its feet must be all black
FEET = 4  # the rows of the agent's feet
SNAP = 3  # in some rooms the floor is drawn up to this many RAM units below the row of entry
LAVA_ROOMS = (10, 18, 20, 22)
LAVA_BELOW = 220  # the y below which there is lava, on which the agent stands only if it is placed there


class Shown(NamedTuple):
    """A state of a rollout: its observation, uint8 (84, 84, 4), its facts, uint8 (8,), and the last two actions."""

    stack: Bytes
    facts: Bytes
    action: int
    previous_action: int

    @property
    def dying(self) -> bool:
        """Whether the agent is dying."""
        return bool(self.facts[DYING])


class Expert:
    """A script that plays in a room. ``rng`` makes all random choices.

    A rollout begins at a start, whose kind is drawn by ``STARTS``. The starts of a kind take turns. Actions are
    repeated for some steps. Some actions lead to a spot, and most of the others are headings. A rollout ends when the
    agent leaves the room, or would revive after a death.
    """

    def __init__(
        self,
        emulator: Emulator,
        room: int,
        rng: Generator,
        sub_goals: Sequence[SubGoal],
    ):
        self.emulator = emulator
        self.room = room
        self.rng = rng
        self.places = find_standing_places(emulator, room)
        self.spots = []
        sides = []
        for goal in sub_goals:
            self.spots += [spot for spot in goal.spots if spot.room == room]
            sides += [side for side in goal.sides if side.room == room]
        starts: dict[str, Sequence[Any]] = {
            "spot": self.spots,
            "side": sides,
            "ladder": find_climbs(room),
        }
        self.in_turn = {}  # the starts of each kind, in a random order, again and again
        for kind, rows in starts.items():
            if rows:
                order = rng.permutation(rows)
                self.in_turn[kind] = cycle(order.tolist())
        self.kinds = [kind for kind in STARTS if kind in self.in_turn or kind == "anywhere"]
        weights = np.array([STARTS[kind] for kind in self.kinds])
        self.chances = weights / weights.sum()

    def play(self) -> Iterator[Shown]:
        """Yield the states of rollouts, without end.

        ``ROLLOUTS_PER_PHASE`` rollouts at a time begin with the room's enemies in one random phase.
        """
        while True:
            phase = int(self.rng.integers(*PHASES, endpoint=True))
            scene = self.emulator.place(self.room, game.RIGHT_EDGE, game.EDGE_Y, phase=phase, settle=0)
            if scene is None:
                continue
            for _ in range(ROLLOUTS_PER_PHASE):
                self.emulator.restore(scene)
                first = self._begin()
                if first is not None:
                    yield from self._rollout(first)

    def _begin(self) -> Shown | None:
        """Bring the agent to a start and fill the stack.

        Return the state, or None if the agent is dying or left the room.
        """
        stays = self._place()
        action = previous = game.NOOP
        for _ in range(game.STACK):
            previous = action
            if stays:
                action, _ = towards(self.emulator.position(), self.spots)
            self.emulator.step(action)
        shown = Shown(self.emulator.stack, self.emulator.facts(), action, previous)
        stayed = shown.facts[ROOM] == self.room
        return shown if stayed and not shown.dying else None

    def _place(self) -> bool:
        """Place the agent where a rollout begins.

        Return whether the agent is to stay at a spot while the stack fills.
        """
        rng, emulator = self.rng, self.emulator
        kind = self.kinds[rng.choice(len(self.kinds), p=self.chances)]
        action, steps = game.NOOP, 0  # the agent plays ``action`` for ``steps`` agent steps, which are not drawn
        stays = False
        if kind == "anywhere":
            row = rng.integers(len(self.places))
            x, y = self.places[row].tolist()
        elif kind == "ladder":
            x, y, action, longest = next(self.in_turn[kind])
            steps = int(rng.integers(1, longest + 1))
        else:
            _, x, y = next(self.in_turn[kind])
            x += int(rng.integers(-REACH, REACH + 1))
            share = HELD if kind == "spot" else 0.0
            stays = rng.random() < share
            if not stays:
                side = rng.integers(2)
                action = (game.LEFT, game.RIGHT)[side]
                steps = int(rng.integers(STEPS_ASIDE + 1))
        emulator.write("x", x)
        emulator.write("y", y)
        emulator.frames(action, game.FRAME_SKIP * steps)
        return stays

    def _rollout(self, shown: Shown) -> Iterator[Shown]:
        """Yield the first state of a rollout, and then the states after it."""
        yield shown
        action, left = game.NOOP, 0
        homing = self.rng.random() if self.spots else 0.0
        for _ in range(ROLLOUT_STEPS):
            if left == 0:
                action, left = self._next_action(homing)
            left -= 1
            played = action
            if self.rng.random() < JITTER:
                played = int(self.rng.integers(game.N_ACTIONS))
            self.emulator.step(played)
            following = Shown(self.emulator.stack, self.emulator.facts(), played, shown.action)
            revived = shown.dying and not following.dying
            if revived or following.facts[ROOM] != self.room:
                return
            shown = following
            yield shown

    def _next_action(self, homing: float) -> tuple[int, int]:
        """Draw an action, and its number of agent steps. The action leads to a spot with the probability ``homing``."""
        if self.rng.random() < homing:
            return towards(self.emulator.position(), self.spots)
        if self.rng.random() < HEADING:
            number = self.rng.integers(len(HEADINGS))
            action = HEADINGS[number]
        else:
            action = int(self.rng.integers(game.N_ACTIONS))
        steps = int(self.rng.integers(1, LONGEST_REPEAT + 1))
        return action, steps


def towards(position: Position, spots: Sequence[Position]) -> tuple[int, int]:
    """Return an action that moves the agent to the nearest spot or holds it there, and its number of agent steps."""
    spot = min(spots, key=lambda spot: abs(position.x - spot.x) + abs(position.y - spot.y))
    aside = spot.x - position.x
    if abs(aside) > CLOSE:
        steps = max(1, round(abs(aside) / STRIDE))
        return (game.RIGHT if aside > 0 else game.LEFT), steps
    if position.y > spot.y:
        return game.DOWN, 1
    if position.y < spot.y and spot in TOPS and spot not in BASES:
        return game.UP, 1
    return game.NOOP, 1


def find_climbs(room: int) -> list[tuple[int, int, int, int]]:
    """Return the climbs that begin in a room.

    A climb is x and y where it begins, its action, and the most agent steps in which it does not leave the room.
    """
    climbs = []
    for ladder in LADDERS:
        highest, lowest = ladder.top.y, ladder.base.y
        if ladder.joins_rooms:
            highest, lowest = SHAFT_ENTRY, SHAFT_EXIT
        ways = (ladder.base, game.UP, highest - ladder.base.y), (ladder.top, game.DOWN, ladder.top.y - lowest)
        for start, action, height in ways:
            if start.room == room:
                climbs.append((start.x, start.y, action, height // STRIDE - 1))
    return climbs


def find_standing_places(emulator: Emulator, room: int) -> Ints:
    """Return the places of a room where an agent stands on something, in the open, as x and y, int64 (n, 2).

    Many places lie inside walls, so the agent's box must be black, with something under the feet. Room 15 has no black
    places, so the row of entry is taken.
    """
    black = ~game.picture(emulator, room).any(2)
    x = np.arange(game.LEFT_EDGE, game.RIGHT_EDGE + 1)
    y = np.arange(SHAFT_EXIT, SHAFT_ENTRY + 1)
    # The agent's box at each place, and below the box the row under the feet.
    boxes = sliding_window_view(black, (game.SPRITE_HEIGHT + 1, game.SPRITE_WIDTH))
    boxes = boxes[np.ix_(game.SPRITE_TOP - y, x + game.SPRITE_LEFT)]
    body = boxes[:, :, :-1]
    feet = body[:, :, -FEET:]
    floor = boxes[:, :, -1]
    in_the_open = body.mean((2, 3)) >= BLACK_SHARE
    has_floor = floor.mean(2) <= 0.5
    stands = in_the_open & feet.all((2, 3)) & has_floor
    if room in LAVA_ROOMS:
        stands[y < LAVA_BELOW] = False
    rows, columns = np.nonzero(stands)
    if not len(rows):
        entry = np.full_like(x, game.EDGE_Y)
        return np.stack([x, entry], axis=1)
    below_entry = np.abs(y - game.EDGE_Y) <= SNAP
    level = np.where(below_entry, game.EDGE_Y, y)
    places = np.stack([x[columns], level[rows]], axis=1)
    return np.unique(places, axis=0)
