"""States of a room of Montezuma's Revenge from scripted play, with labels and origins."""

from collections import Counter
from collections.abc import Sequence

import numpy as np
from numpy.random import Generator

from hypogoal.core.arrays import Ints
from hypogoal.core.errors import UserError
from hypogoal.core.seeding import rng_for
from hypogoal.data import States
from hypogoal.domains.montezuma.emulator import DYING, JUMP, ON_LADDER, POSE, Emulator
from hypogoal.domains.montezuma.expert import Expert, Shown
from hypogoal.domains.montezuma.ladders import BASES
from hypogoal.domains.montezuma.sub_goals import (
    CLIMB_DOWN,
    CLIMB_UP,
    LABELLED_ROOMS,
    SubGoal,
    around,
    inside,
    judge_sub_goals,
)
from hypogoal.observations import digest

KINDS = ("base", "near-base", "on-ladder", "top", "jumping", "dying", "elsewhere")
BASE, NEAR_BASE, CLIMBING, TOP, JUMPING, DEAD, ELSEWHERE = range(len(KINDS))
NEAR_BASES = around(BASES, 12)
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
    DEAD: 0.1,
}
SPARE = 1.25  # states to gather, relative to those to keep
# Play in a room until these shares of the states to keep are positive, at all its places and at each.
FEWEST_POSITIVES, FEWEST_AT_A_PLACE = 0.1, 0.02
MOST_STEPS = 60  # agent steps per state to keep, after which a room is given up; two to four are usual
At = tuple[str, int]  # a sub-goal's name and the index of its place
HELD_OUT_EACH = 3  # every third stack, by its digest, may be held out; all others, and only they, are for training


def tell_kinds(facts: Ints) -> Ints:
    """Each state's kind, an index into ``KINDS``, int64 (n,), from facts (n, ``FACTS``): the first that fits."""
    fits = {
        DEAD: facts[:, DYING] > 0,
        BASE: CLIMB_DOWN.at(facts) >= 0,
        NEAR_BASE: inside(NEAR_BASES, facts).any(1),
        CLIMBING: np.isin(facts[:, POSE], LADDER_POSES),
        TOP: CLIMB_UP.at(facts) >= 0,
        JUMPING: facts[:, JUMP] != ON_GROUND,
    }
    return np.select([*fits.values()], [*fits], default=ELSEWHERE)


def describe_states(shown: Sequence[Shown], sub_goals: Sequence[SubGoal]) -> States:
    """Observations, labels of the sub-goals (n, G), and origins, int64 (n,) each.

    Origins: room, x, y; group 1..7 of the room (0: it has no ladder); kind, an index into ``KINDS``; ladder, the index
    of the first sub-goal's place at which the state is, see ``SubGoal.at``; dying, 0 or 1; action, 0..17, that led to
    the last frame, and previous_action, that led to the one before.
    """
    stacks, every, actions, previous = zip(*shown, strict=True)
    facts = np.stack(every).astype(int)
    room, x, y, *_ = facts.T
    group = np.zeros_like(room)
    for number, rooms in enumerate(LABELLED_ROOMS[CLIMB_DOWN.name]["groups"], 1):
        group[np.isin(room, rooms)] = number
    origins = {
        "room": room,
        "x": x,
        "y": y,
        "group": group,
        "kind": tell_kinds(facts),
        "ladder": sub_goals[0].at(facts),
        "dying": np.sign(facts[:, DYING]),
        "action": np.array(actions),
        "previous_action": np.array(previous),
    }
    labels = judge_sub_goals(facts, sub_goals)
    return States(np.stack(stacks), labels, origins)


def gather(split: str, room: int, wanted: int, seed: int, sub_goals: Sequence[SubGoal]) -> States:
    """``wanted`` different states of a room: rollouts until there are enough, then a choice among them.

    Only the ``unlabelled`` ones are also at unclear places, such as bases of ladders that continue through the floor.
    A room with too few different states is a ``UserError``.
    """
    held_out = split == "heldout"
    stream = (split, 0) if held_out else (split,)
    rng = rng_for(seed, "montezuma", *stream, room)
    left_out: set[At] = set()
    sought: set[At] = set()
    for goal in sub_goals:
        unclear = () if split == "unlabelled" else goal.unclear
        for index, place in enumerate(goal.places):
            if place.room == room:
                chosen = left_out if index in unclear else sought
                chosen.add((goal.name, index))
    reached: Counter[At] = Counter()
    looks = set()
    pool: list[Shown] = []

    def enough() -> bool:
        if len(pool) < SPARE * wanted:
            return False
        if not sought:
            return True
        each = [reached[place] for place in sought]
        enough_together = sum(each) >= FEWEST_POSITIVES * wanted
        enough_of_each = min(each) >= FEWEST_AT_A_PLACE * wanted
        return enough_together and enough_of_each

    expert = Expert(Emulator(), room, rng, sub_goals)
    for step, shown in enumerate(expert.play()):
        if enough() or step == MOST_STEPS * wanted:
            break
        look = digest(shown.stack)
        may_be_held_out = look[0] % HELD_OUT_EACH == 0
        if look in looks or may_be_held_out != held_out:
            continue
        looks.add(look)
        facts = shown.facts[None]
        places = {(goal.name, goal.at(facts).item()) for goal in sub_goals}
        if places & left_out:
            continue
        pool.append(shown)
        if not shown.dying:
            reached.update(places)
    if len(pool) < wanted:
        raise UserError(
            f"room {room} does not show {wanted} different states", f"{len(pool)} in {step} steps", "Ask for fewer."
        )
    states = describe_states(pool, sub_goals)
    kinds = np.where(states.labels.any(1), POSITIVE, states.origins["kind"])
    positions = np.stack([states.origins[name] for name in ("room", "x", "y")], axis=1)
    return states.where(choose(kinds, positions, wanted, rng))


def choose(kinds: Ints, positions: Ints, wanted: int, rng: Generator) -> Ints:
    """Ordered indices of ``wanted`` of n states: each kind's share, spread over positions; the others at random."""
    from pandas import DataFrame  # takes longer to import than most stages need it

    order = rng.permutation(len(kinds))
    rows = np.column_stack([kinds, positions])
    alike = DataFrame(rows[order])
    ranks = alike.groupby([*alike]).cumcount()  # the first of a kind and position come before the second of any
    spread = order[np.argsort(ranks, kind="stable")]
    first = []
    for kind, share in KIND_SHARES.items():
        of_kind = spread[kinds[spread] == kind]
        count = int(share * wanted)
        first += of_kind[:count].tolist()
    others = order[~np.isin(order, first)]
    left = wanted - len(first)
    return np.sort([*first, *others[:left]])
