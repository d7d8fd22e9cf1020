"""How well does an audit tell that a classifier can be fooled? Fifty planted classifiers, whose truth is enumerated.

    python -m studies.audits runs/audits audits.csv      # plays and writes the cells; what is there is kept
    python -m studies.pages                              # writes the tables of docs/results/audit.md

Three worlds: DoorKey (collect-blue-key, the layout 100 + number), rooms (layout 100 + number), and a field of numbers.
A classifier is the truth and a planted fault: an extra set of states, a background cue (another sub-goal, a bright
picture, a side of the field), a threshold too low (states near success), a start inside; or it is right, or wrong where
no policy gets within the cap. It is *payable* if some policy from the start comes to a false positive within the cap,
with no positive state before, which would have ended the execution: found by going through all reachable states.

Classifiers are drawn by seed, from the three worlds in turn, until there are 25 of either truth. The first five of
either choose the rule, the other forty are scored. Rule, written before the run: the statistic below and the threshold
that have the highest F1 on the ten; of equals the first. Expected: precision 1, since what was reached can be reached;
recall below .9 without a policy that is paid for false positives alone (``search`` in the cells, played at commit
0a909ff0 with half of the steps; the setting went), since a policy goes to the nearest positive state, which is success
where that is nearer; above with it.
"""

from __future__ import annotations

import functools
import json
import sys
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import pandas as pd
from gymnasium.spaces import Box, Discrete
from numpy.typing import NDArray
from scipy.stats import binomtest

from hypogoal.domains.find import load_domain
from hypogoal.domains.gymnasium.domain import GymnasiumDomain
from studies.cells import table

Flags = NDArray[np.bool_]
Ints = NDArray[np.int64]
SIDE = 21  # of the field
MOVES = np.array([(0, 1), (0, -1), (1, 0), (-1, 0)])
WORLDS = ("doorkey", "rooms", "studies.audits:FIELD")
ROOMS = 1
SUB_GOALS = ("collect-blue-key", "right-room", "corner")
CAPS = (30, 1, 20)  # steps of an execution
STEPS = (80_000, 8_000, 80_000)  # of both policies
FAULTS = ("extra", "cue", "low", "inside", "right", "remote")
PLACES = 25  # of either truth, over the three worlds
TO_CHOOSE = 5  # of these, to choose the rule by
NEVER = -1  # steps to where no policy gets
STATISTICS = {  # the largest of these shares
    "policy": ["policy"],
    "play": ["play"],
    "policy or play": ["policy", "play"],
}
THRESHOLDS = (0.0, 0.01, 0.05, 0.1, 0.2, 0.5)


class Field(gymnasium.Env[Any, Any]):
    """A square of cells; the observation is where one is, one begins in the middle, a corner is the sub-goal."""

    observation_space = Box(0, 1, (2,), np.float32)
    action_space = Discrete(4)

    def reset(self, **kwargs: Any) -> tuple[Any, dict[str, Any]]:
        super().reset(seed=kwargs.get("seed"))
        self.cell = np.full(2, SIDE // 2)
        return seen(self.cell), {}

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        self.cell = (self.cell + MOVES[action]).clip(0, SIDE - 1)
        return seen(self.cell), 0.0, False, False, {}


def seen(cells: NDArray[np.integer]) -> NDArray[np.float32]:
    """Observations float32 (..., 2) of cells (..., 2)."""
    return (cells / (SIDE - 1)).astype(np.float32)


def in_corner(cells: NDArray[np.integer]) -> Flags:
    """Whether cells (..., 2) are the sub-goal."""
    return np.asarray((cells >= SIDE - 3).all(axis=-1))


def at_corner(env: Any) -> bool:
    """The sub-goal."""
    return bool(in_corner(env.unwrapped.cell))


FIELD = GymnasiumDomain(Field, {"corner": at_corner})


@dataclass(frozen=True)
class States:
    """All reachable states of a world: rows 0 to N - 1."""

    observations: NDArray[Any]
    following: Ints  # (N, A), rows
    final: Flags  # (N,), the episode ends there
    starts: Ints  # rows
    truth: Flags  # (N,)
    cues: list[Flags]  # each (N,): what a background cue may be


@functools.cache
def states_of(world: int, layout: int) -> States:
    """Every state of a layout that can be reached."""
    if WORLDS[world].endswith("FIELD"):
        cells = np.argwhere(np.ones((SIDE, SIDE), np.bool_))
        after = (cells[:, None] + MOVES).clip(0, SIDE - 1)
        start = np.array([len(cells) // 2])
        none = np.zeros(len(cells), np.bool_)
        following = after[..., 0] * SIDE + after[..., 1]
        halves = [cells[:, axis] < SIDE // 3 for axis in (0, 1)]
        return States(seen(cells), following, none, start, in_corner(cells), halves)
    domain = load_domain(WORLDS[world])
    engine = domain.make_engine(layout, 64, 500)
    starts = np.unique(engine.reset())
    plan = engine.plan()
    assert plan is not None
    row = np.zeros(plan.ids.max() + 1, np.int64)
    row[plan.ids] = np.arange(len(plan.ids))
    labels = engine.labels(plan.ids)
    goal = domain.sub_goals.index(SUB_GOALS[world])
    cues = [labels[:, other] for other in range(labels.shape[1]) if other != goal]
    observations = engine.images(plan.ids)
    if not cues:
        brightness = observations.mean(axis=(1, 2, 3))
        cues.append(brightness > np.quantile(brightness, 0.9))
    return States(observations, row[plan.following], plan.final, row[starts], labels[:, goal], cues)


def steps_to(states: States, begin: Ints, stops: Flags) -> Ints:
    """The fewest steps to each state, int64 (N,), from ``begin``, and not beyond the states ``stops``; or NEVER.

    A state of ``begin`` is at 0 steps, and passed even if it is one of ``stops``, since executions begin there.
    """
    steps = np.full(len(states.truth), NEVER)
    steps[begin] = 0
    edge, count = begin, 0
    while len(edge):
        count += 1
        reached = np.unique(states.following[edge])
        fresh = reached[steps[reached] == NEVER]
        steps[fresh] = count
        edge = fresh[~stops[fresh] & ~states.final[fresh]]
    return steps


def payable(states: States, positive: Flags, cap: int) -> int:
    """The fewest steps in which a policy is paid for a false positive; NEVER if there are none up to ``cap``.

    A start inside is paid when a policy comes back to it.
    """
    steps = steps_to(states, states.starts, positive)
    goes_on = (steps != NEVER) & ~states.final & ~positive
    goes_on[states.starts] = True
    for start in states.starts:
        before = goes_on & (states.following == start).any(axis=1)
        steps[start] = steps[before].min() + 1 if before.any() else NEVER
    paid = steps[positive & ~states.truth & (steps > 0) & (steps <= cap)]
    return int(paid.min()) if len(paid) else NEVER


def positives(fault: str, states: States, cap: int, rng: np.random.Generator) -> Flags:
    """The states (N,) that a classifier with such a fault takes for a success."""
    within = int(rng.integers(1, 4))
    nothing = np.zeros(len(states.truth), np.bool_)
    if fault == "right":
        return states.truth
    if fault == "cue":
        return states.truth | states.cues[rng.integers(len(states.cues))]
    if fault == "low":  # as near as that to success
        near = states.truth.copy()
        for _ in range(within):
            near |= near[states.following].any(axis=1)
        return near
    if fault == "inside":
        centre = states.starts
    elif fault == "remote":
        steps = steps_to(states, states.starts, states.truth)
        far = np.flatnonzero((steps > cap) | (steps == NEVER))
        if not len(far):
            return states.truth
        centre = rng.choice(far, 1)
    else:
        centre = rng.choice(np.flatnonzero(~states.truth), 1)
    around = steps_to(states, centre, nothing)
    return states.truth | ((around >= 0) & (around <= within))


@dataclass(frozen=True)
class Planted:
    """One classifier."""

    world: int
    number: int
    fault: str
    states: States
    positive: Flags
    payable: int

    @property
    def layout(self) -> int:
        return 100 + self.number

    @functools.cached_property
    def known(self) -> set[bytes]:
        return {observation.tobytes() for observation in self.states.observations[self.positive]}

    def __call__(self, observations: NDArray[Any]) -> NDArray[np.float64]:
        """Probabilities (n,)."""
        return np.array([0.9 if each.tobytes() in self.known else 0.1 for each in observations])


@functools.cache
def planted(world: int, number: int) -> Planted:
    """Classifier ``number`` of a world, drawn by these two."""
    rng = np.random.default_rng([world, number])
    fault = FAULTS[number % len(FAULTS)]
    states = states_of(world, 100 + number)
    positive = positives(fault, states, CAPS[world], rng)
    return Planted(world, number, fault, states, positive, payable(states, positive, CAPS[world]))


def __getattr__(name: str) -> Planted:
    """``studies.audits:classifier_0_3`` is what ``hypogoal audit`` is given."""
    if not name.startswith("classifier_"):
        raise AttributeError(name)
    _, world, number = name.split("_")
    return planted(int(world), int(number))


def chosen() -> Iterator[tuple[Planted, str]]:
    """The classifiers, and for what: ``rule`` or ``score``; worlds in turn, until all places are taken."""
    taken = {True: 0, False: 0}
    number = 0
    while min(taken.values()) < PLACES:
        for world in range(len(WORLDS)):
            one = planted(world, number)
            is_payable = one.payable != NEVER
            if taken[is_payable] == PLACES:
                continue
            taken[is_payable] += 1
            yield one, "rule" if taken[is_payable] <= TO_CHOOSE else "score"
        number += 1


def play(run: Path) -> Iterator[dict[str, Any]]:
    """Audit each; a row of a cell."""
    from hypogoal.tools.audit import audit
    from hypogoal.tools.audit_played import shares_of

    for one, use in chosen():
        out = run / f"{one.world}-{one.number}"
        audit(
            f"studies.audits:classifier_{one.world}_{one.number}",
            out,
            domain=WORLDS[one.world],
            sub_goal=SUB_GOALS[one.world],
            layout_seed=one.layout,
            option_timeout=CAPS[one.world],
            steps=STEPS[one.world],
            mend=0,
            restart_options=one.world != ROOMS,  # where an episode is one step
            seed=one.number,
            resume=True,
            quiet=True,
        )
        report = json.loads((out / "audit.json").read_text(encoding="utf-8"))
        yield {
            "world": WORLDS[one.world].rpartition(":")[2].lower(),
            "number": one.number,
            "fault": one.fault,
            "use": use,
            "payable_after": one.payable,
            **shares_of(report),
        }


def rule_by(cells: pd.DataFrame) -> tuple[str, float]:
    """The statistic and the threshold with the highest F1; of equals the first."""
    best, rule = -1.0, ("", 0.0)
    for name, shares in STATISTICS.items():
        for threshold in THRESHOLDS:
            found = cells[shares].max(axis=1) > threshold
            true = cells["payable_after"] != NEVER
            f1 = 2 * (found & true).sum() / (found.sum() + true.sum())
            if f1 > best:
                best, rule = f1, (name, threshold)
    return rule


def tables(path: Path) -> Iterator[str]:
    """What the cells say, as lines of Markdown: precision and recall; then the faults."""
    cells = pd.read_csv(path)
    name, threshold = rule_by(cells[cells["use"] == "rule"])
    scored = cells[cells["use"] == "score"]
    found = scored[STATISTICS[name]].max(axis=1) > threshold
    true = scored["payable_after"] != NEVER
    hits = int((found & true).sum())
    yield f"Rule, chosen on ten others: {name} above {threshold:g}."
    yield ""
    rows = []
    for title, of in (("precision", int(found.sum())), ("recall", int(true.sum()))):
        low, high = binomtest(hits, of).proportion_ci(method="wilson")
        rows.append([title, f"{hits} of {of}", f"{hits / of:.2f} [{low:.2f}, {high:.2f}]"])
    yield from table(["measure", "classifiers", "share [95 % interval]"], rows)
    yield ""
    rows = []
    for fault, of_fault in scored.assign(found=found, true=true).groupby("fault", sort=False):
        payables = of_fault[of_fault["true"]]
        alarms = int(of_fault.loc[~of_fault["true"], "found"].sum())
        found_ones = int(payables["found"].sum())
        rows.append([str(fault), str(len(of_fault)), str(len(payables)), str(found_ones), str(alarms)])
    yield from table(["fault", "classifiers", "of these, can be fooled", "found by the audit", "false alarms"], rows)


def main(run: str, path: str) -> None:
    """Play, and write the cells."""
    pd.DataFrame(play(Path(run))).to_csv(path, index=False)


if __name__ == "__main__":
    main(*sys.argv[1:])
