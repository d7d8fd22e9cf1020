"""States of a room of Montezuma's Revenge from scripted play, with labels and origins (Spec B4, B5)."""

from collections import Counter
from collections.abc import Sequence
from functools import cache

import numpy as np
from numpy.random import Generator

from hypogoal.core.arrays import Bytes, Ints
from hypogoal.core.errors import UserError
from hypogoal.core.seeding import rng_for
from hypogoal.data import States
from hypogoal.domains.montezuma.emulator import ON_LADDER, RAM, Emulator, Position
from hypogoal.domains.montezuma.expert import Expert, Shown
from hypogoal.domains.montezuma.ladders import BASES, REACH, TOPS, within
from hypogoal.domains.montezuma.sub_goals import CLIMB_DOWN, SubGoal, facts_of, labels_of
from hypogoal.observations import digest

KINDS = ("base", "near-base", "on-ladder", "top", "jumping", "dying", "elsewhere")
BASE, NEAR_BASE, CLIMBING, TOP, JUMPING, DYING, ELSEWHERE = range(len(KINDS))
NEAR = 12  # from a base, in RAM units, in x and in y
LADDER_POSES = (ON_LADDER, 0)  # climbing, holding still; on ropes 14 and 4
ON_GROUND = 255  # the RAM's value for the jump without one

POSITIVE = len(KINDS)  # in place of its kind, where a sub-goal holds
# The least shares of a room's states by kind, as far as the rollouts reached them.
KIND_SHARES = {
    POSITIVE: 0.2,
    NEAR_BASE: 0.15,
    CLIMBING: 0.15,
    TOP: 0.05,
    JUMPING: 0.1,
    DYING: 0.1,
}
SPARE = 1.25  # states to gather, relative to those to keep
# Play in a room until these shares of the states to keep are positive, at all its places and at each.
FEWEST_POSITIVES, FEWEST_AT_A_PLACE = 0.1, 0.02
MOST_STEPS = 60  # agent steps per state to keep, after which a room is given up; two to four are usual
HELD_OUT_EACH = 3  # every third stack, by digest, is for the held-out set


def kinds_of(ram: Bytes) -> Ints:
    """Each state's kind, an index into ``KINDS``, int64 (n,), from RAM (n, 128): dying, else the first that fits."""
    positions = facts_of(ram)[:, :3]
    fits = {
        DYING: ram[:, RAM["dying"]] > 0,
        BASE: within(positions, BASES, REACH).any(1),
        NEAR_BASE: within(positions, BASES, NEAR).any(1),
        CLIMBING: np.isin(ram[:, RAM["pose"]], LADDER_POSES),
        TOP: within(positions, TOPS, REACH).any(1),
        JUMPING: ram[:, RAM["jump"]] != ON_GROUND,
    }
    return np.select(list(fits.values()), list(fits), default=ELSEWHERE)


def states_of(shown: Sequence[Shown], sub_goals: Sequence[SubGoal]) -> States:
    """Observations, labels of the sub-goals (n, G), and origins, int64 (n,) each.

    Origins: room, x, y; group 1..7 of the room (0: it has no ladder); kind, an index into ``KINDS``; ladder, the index
    of the first sub-goal's place at which the state is, see ``SubGoal.at``; dying, 0 or 1; action, 0..17, that led to
    the last frame, and previous_action, that led to the one before.
    """
    ram = np.stack([state.ram for state in shown])
    facts, dying = facts_of(ram), ram[:, RAM["dying"]] > 0
    room, x, y, *_ = facts.T
    group = np.zeros_like(room)
    for number, rooms in enumerate(CLIMB_DOWN.groups, start=1):
        group[np.isin(room, rooms)] = number
    origins = {
        "room": room,
        "x": x,
        "y": y,
        "group": group,
        "kind": kinds_of(ram),
        "ladder": sub_goals[0].at(facts),
        "dying": dying.astype(np.int64),
        "action": np.array([state.action for state in shown]),
        "previous_action": np.array([state.previous_action for state in shown]),
    }
    stacks = np.stack([state.stack for state in shown])
    return States(stacks, labels_of(facts, ~dying, sub_goals), origins)


def may_be_held_out(look: bytes) -> bool:
    """Whether a stack is for testing, by its digest; all others are for training.

    Only the stack's bytes decide, so no stack is ever on both sides, and the held-out set does not depend on which
    states are labelled.
    """
    return look[0] % HELD_OUT_EACH == 0


@cache
def emulator_of_process() -> Emulator:
    """One emulator for all rooms of a process; a room's states do not depend on the rooms before it."""
    return Emulator()


def gather(split: str, room: int, wanted: int, seed: int, sub_goals: Sequence[SubGoal]) -> States:
    """``wanted`` different states of a room: rollouts until there are enough, then a choice among them.

    Only the ``unlabelled`` ones are also at unclear places, such as bases of ladders that continue through the floor.
    A room with too few different states is a ``UserError``.
    """
    held_out, unclear = split == "heldout", split == "unlabelled"
    stream = (split, 0) if held_out else (split,)
    rng = rng_for(seed, "montezuma", *stream, room)
    left_out, sought = set(), set()  # a sub-goal's name and the index of its place
    for goal in sub_goals:
        for index, place in enumerate(goal.places):
            if index in goal.unclear and not unclear:
                left_out.add((goal.name, index))
            elif place.room == room:
                sought.add((goal.name, index))
    reached: Counter[tuple[str, int]] = Counter()
    looks: set[bytes] = set()
    pool: list[Shown] = []

    def enough() -> bool:
        if len(pool) < SPARE * wanted:
            return False
        if not sought:
            return True
        each = [reached[place] for place in sought]
        together_enough = sum(each) >= FEWEST_POSITIVES * wanted
        return together_enough and min(each) >= FEWEST_AT_A_PLACE * wanted

    expert = Expert(emulator_of_process(), room, rng, sub_goals)
    for step, shown in enumerate(expert.play()):
        if enough() or step == MOST_STEPS * wanted:
            break
        look = digest(shown.stack)
        if look in looks or may_be_held_out(look) != held_out:
            continue
        looks.add(look)
        facts = facts_of(shown.ram[None])
        places = {(goal.name, int(goal.at(facts)[0])) for goal in sub_goals}
        if places & left_out:
            continue
        pool.append(shown)
        if not shown.dying:
            reached.update(places)
    if len(pool) < wanted:
        fault = f"room {room} does not show {wanted} different states"
        raise UserError(fault, f"{len(pool)} in {step} steps", "Ask for fewer.")
    states = states_of(pool, sub_goals)
    kinds = np.where(states.labels.any(1), POSITIVE, states.origins["kind"])
    positions = np.stack([states.origins[name] for name in Position._fields], axis=1)
    return states.where(choose(kinds, positions, wanted, rng))


def choose(kinds: Ints, positions: Ints, wanted: int, rng: Generator) -> Ints:
    """Ordered indices of ``wanted`` of n states: each kind's share, spread over positions; the others at random."""
    from pandas import DataFrame  # takes longer to import than most stages need it

    order = rng.permutation(len(kinds))
    alike = DataFrame(np.column_stack([kinds, positions])[order])
    ranks = alike.groupby([*alike]).cumcount()  # the first of a kind and position come before the second of any
    spread = order[np.argsort(ranks, kind="stable")]
    first = np.zeros(0, np.int64)
    for kind, share in KIND_SHARES.items():
        of_kind = spread[kinds[spread] == kind]
        first = np.append(first, of_kind[: int(share * wanted)])
    others = order[~np.isin(order, first)]
    return np.sort(np.append(first, others[: wanted - len(first)]))
