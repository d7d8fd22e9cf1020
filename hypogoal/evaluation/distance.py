"""How near to the true sub-goal options stop (Spec F3, F4; Figures 4 and 5)."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from hypogoal.core.seeding import rng_for
from hypogoal.evaluation.rooms import method_rank
from hypogoal.evaluation.statistics import aggregate_with_deviation

LAST = 100  # executions of an option that count
INSIDE = 300  # the distance of an execution that begins inside its own termination set (the paper's, a ladder's length)
NEAR = 4  # Manhattan distance that counts as there: the farthest corner of the base region, 2 in x and 2 in y
ORACLE = "oracle termination"
WHICH = ("best", "validated", "mean", "worst")
HIT, MISS, BEGAN_INSIDE = range(3)  # what became of an execution
SHARES = ("reached_base", "inside_at_start", "timed_out", "died")


@dataclass(frozen=True)
class Executions:
    """Executions of options in the order in which they ended, arrays (n,): the rows of ``executions.csv``.

    Attributes:
        step: environment steps when it ended.
        option: g*K + k.
        duration: steps.
        reached: its own termination classifier said yes.
        inside_at_start: that classifier said yes where it began.
        terminated: the episode ended in a terminal state: the agent died.
        room, x, y: where it stopped.
        distance: from there to the nearest true sub-goal, in the domain's units.
    """

    step: NDArray[np.int64]
    option: NDArray[np.int64]
    duration: NDArray[np.int64]
    reached: NDArray[np.bool_]
    inside_at_start: NDArray[np.bool_]
    terminated: NDArray[np.bool_]
    room: NDArray[np.int64]
    x: NDArray[np.int64]
    y: NDArray[np.int64]
    distance: NDArray[np.int64]

    def of(self, option: int, last: int = LAST) -> Executions:
        """The last executions of one option."""
        rows = np.flatnonzero(self.option == option)[-last:]
        return Executions(*(getattr(self, name)[rows] for name in self.__dataclass_fields__))

    def positions(self) -> NDArray[np.int64]:
        """Where they stopped, (n, 3)."""
        return np.stack([self.room, self.x, self.y], axis=1)


def counted(executions: Executions) -> NDArray[np.float64]:
    """Spec F3: each execution's distance as it counts, (n,): 300 where it began inside its own termination set."""
    return np.where(executions.inside_at_start, INSIDE, executions.distance).astype(np.float64)


def at_base(executions: Executions) -> NDArray[np.bool_]:
    """Spec F3: which executions got to a true base, bool (n,): within 4 of one, and not inside at the start."""
    return (executions.distance <= NEAR) & ~executions.inside_at_start


def fates(executions: Executions) -> NDArray[np.int64]:
    """Figure 5: what became of executions, (n,): ``HIT`` at a true base, ``MISS``, or ``BEGAN_INSIDE``."""
    return np.select([executions.inside_at_start, at_base(executions)], [BEGAN_INSIDE, HIT], MISS)


def option_numbers(executions: Executions, *, never_offered: bool = False) -> dict[str, float | int]:
    """Spec F3: what is said of one option's last executions.

    Args:
        executions: its own.
        never_offered: it has none because it would always have begun inside its own termination set: that counts 300.

    Returns:
        executions (how many), distance (mean as counted), executions_deviation (of it, n - 1), duration (mean steps),
        and shares of executions: reached_base, inside_at_start, timed_out (neither its classifier nor a death ended
        it), died. NaN without executions, the deviation also of one.
    """
    count = len(executions.step)
    if count == 0:
        nothing = dict.fromkeys(("distance", "executions_deviation", "duration", *SHARES), float("nan"))
        return {"executions": 0, **nothing, **({"distance": float(INSIDE)} if never_offered else {})}
    distance = counted(executions)
    return {
        "executions": count,
        "distance": float(distance.mean()),
        "executions_deviation": float(distance.std(ddof=1)) if count > 1 else float("nan"),
        "duration": float(executions.duration.mean()),
        "reached_base": float(at_base(executions).mean()),
        "inside_at_start": float(executions.inside_at_start.mean()),
        "timed_out": float((~executions.reached & ~executions.terminated).mean()),
        "died": float(executions.terminated.mean()),
    }


def ladder_numbers(
    executions: Executions, sub_goals: Sequence[str], members: int, validated: Mapping[str, int | None], *, masked: bool
) -> list[dict[str, Any]]:
    """Spec F3: one options artefact, which was trained from one start (a ladder).

    Args:
        executions: its executions.
        sub_goals: G names.
        members: K.
        validated: per sub-goal the member that validation rooms pick, where that is known.
        masked: options that would begin inside their own termination set were not offered (Spec D6).

    Returns:
        Per sub-goal ``options`` (a row per member) and which member is ``best`` (the least mean distance), ``worst``
        and ``validated``; None where there is none.
    """
    rows = []
    masked = masked and len(executions.step) > 0
    for index, sub_goal in enumerate(sub_goals):
        options = [
            {"member": member, "option": option, **option_numbers(executions.of(option), never_offered=masked)}
            for member, option in enumerate(range(index * members, (index + 1) * members))
        ]
        distances = np.array([option["distance"] for option in options])
        known = np.flatnonzero(~np.isnan(distances))
        rows.append(
            {
                "sub_goal": sub_goal,
                "options": options,
                "best": int(known[distances[known].argmin()]) if len(known) else None,
                "worst": int(known[distances[known].argmax()]) if len(known) else None,
                "validated": validated.get(sub_goal),
            }
        )
    return rows


def distance_tables(rows: Sequence[Mapping[str, Any]], ladders: Sequence[str]) -> dict[str, list[dict[str, Any]]]:
    """Spec F3, Figure 4: distances over seeds, on each ladder and over all ladders.

    Args:
        rows: what was computed of each artefact: method, groups, ladder, seed and a row of :func:`ladder_numbers`.
        ladders: all ladders of the run, in their order.

    Returns:
        ``by_ladder``: per method, N, ladder: the distance of the best, validated, mean and worst member and the best
        member's shares, over seeds. ``over_ladders``: per method and N: the same, each seed's mean over ladders first.
        A seed that lacks one of the ladders is left out there, so that nothing is compared over unlike ladders.
        Artefacts alike in all of this count each for itself.
    """
    cells: dict[tuple[str, int | None, str], dict[tuple[tuple[int, int], str], dict[str, float]]] = {}
    for row in rows:
        own = cells.setdefault((row["method"], row["groups"], row["sub_goal"]), {})
        before = sum((seed, ladder) == (row["seed"], row["ladder"]) for (seed, _), ladder in own)
        own[(row["seed"], before), row["ladder"]] = _numbers(row)  # of one seed there may be several ensembles' options
    by_ladder, over_ladders = [], []
    for key in sorted(cells, key=_order):
        found = cells[key]
        about = dict(zip(("method", "groups", "sub_goal"), key, strict=True))
        seeds = sorted({seed for seed, _ in found})
        for ladder in ladders:
            here = [found[seed, ladder] for seed in seeds if (seed, ladder) in found]
            if here:
                by_ladder.append(
                    {**about, "ladder": ladder, "seeds": len(here), **_over_seeds(here, *map(str, key), ladder)}
                )
        whole = [seed for seed in seeds if all((seed, ladder) in found for ladder in ladders)]
        means = [
            {name: float(np.mean([found[seed, ladder][name] for ladder in ladders])) for name in _NAMES}
            for seed in whole
        ]
        over_ladders.append(
            {
                **about,
                "ladders": list(ladders),
                "seeds": len(whole),
                "incomplete_seeds": [seed[0] for seed in seeds if seed not in whole],
                **_over_seeds(means, *map(str, key)),
            }
        )
    return {"by_ladder": by_ladder, "over_ladders": over_ladders}


_NAMES = (*WHICH, "executions_deviation", *SHARES)


def _numbers(row: Mapping[str, Any]) -> dict[str, float]:
    """One artefact's numbers by the names in ``_NAMES``: distances, and of the best member the rest."""
    options, nothing = row["options"], float("nan")
    known = [option["distance"] for option in options if not np.isnan(option["distance"])]
    best = {} if row["best"] is None else options[row["best"]]
    return {
        "best": best.get("distance", nothing),
        "validated": nothing if row["validated"] is None else options[row["validated"]]["distance"],
        "mean": float(np.mean(known)) if known else nothing,
        "worst": max(known, default=nothing),
        **{name: best.get(name, nothing) for name in ("executions_deviation", *SHARES)},
    }


def _over_seeds(rows: Sequence[Mapping[str, float]], *names: str) -> dict[str, Any]:
    found = {}
    for name in _NAMES:
        unit = "share of executions" if name in SHARES else "units of position"
        rng = rng_for(0, "bootstrap", "distance", *names, name)
        found[name] = aggregate_with_deviation([row[name] for row in rows], [0] * len(rows), unit, rng)
    return found


def _order(key: tuple[str, int | None, str]) -> tuple[str, int, str, int]:
    method, groups, sub_goal = key
    return sub_goal, method_rank(method), method, -1 if groups is None else groups
