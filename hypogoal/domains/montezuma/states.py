"""How states of a room of Montezuma's Revenge are gathered by scripted play, with labels and origins."""

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
LADDER_POSES = (ON_LADDER, 0)  # climbing, and holding still; on ropes the poses are 14 and 4
ON_GROUND = 255  # the RAM's value of ``jump`` on the ground

POSITIVE = len(KINDS)  # stands for a state's kind, where a sub-goal holds
# The least shares of a room's states by kind, as far as the rollouts reached such states.
KIND_SHARES = {
    POSITIVE: 0.2,
    NEAR_BASE: 0.15,
    CLIMBING: 0.15,
    TOP: 0.05,
    JUMPING: 0.1,
    DEAD: 0.1,
}
SPARE = 1.25  # the number of states to gather, relative to the number to keep
# The least shares of positives among the states to keep, at all places of a room together, and at each place. The room
# is played in until they are reached.
FEWEST_POSITIVES, FEWEST_AT_A_PLACE = 0.1, 0.02
MOST_STEPS = 60  # agent steps per state to keep, after which a room is given up; two to four are usual
At = tuple[str, int]  # a sub-goal's name, and the index of a place of the sub-goal
HELD_OUT_EACH = 3  # one stack in three, by its digest, may be held out, and the other stacks are for training


def tell_kinds(facts: Ints) -> Ints:
    """Return each state's kind, an index into ``KINDS``, int64 (n,), from facts (n, ``FACTS``).

    If several kinds fit, the first of ``fits`` is taken.
    """
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
    """Return states with observations, labels of the sub-goals, bool (n, G), and origins, int64 (n,) each.

    The origins are room, x and y; group, the room's group 1..7, or 0 if the room has no ladder; kind, an index into
    ``KINDS``; ladder, the index of the first sub-goal's place at which the state is, see ``SubGoal.at``; dying, 0 or 1;
    action, 0..17, which led to the last frame; and previous_action, which led to the frame before.
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
    """Gather ``wanted`` different states of a room, by rollouts until there are enough, and a choice among the states.

    Only ``unlabelled`` states are also at unclear places, such as bases of ladders that continue through the floor.
    Raises ``UserError`` if the room has too few different states.
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
    """Choose ``wanted`` of n states. Return their indices in order, int64 (wanted,).

    Each kind has at least its share, spread over positions. The other states are chosen at random.
    """
    from pandas import DataFrame  # not above, because the import takes long, and most stages do not need it

    order = rng.permutation(len(kinds))
    rows = np.column_stack([kinds, positions])
    alike = DataFrame(rows[order])
    ranks = alike.groupby([*alike]).cumcount()  # first states of a kind and position come before any second state
    spread = order[np.argsort(ranks, kind="stable")]
    first = []
    for kind, share in KIND_SHARES.items():
        of_kind = spread[kinds[spread] == kind]
        count = int(share * wanted)
        first += of_kind[:count].tolist()
    others = order[~np.isin(order, first)]
    left = wanted - len(first)
    return np.sort([*first, *others[:left]])
