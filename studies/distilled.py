"""Options distilled from plans of other layouts, and agents over them, on layouts that nobody played: their tables.

    python -m studies.distilled docs/results/distilled.csv
    python -m studies.distilled docs/results/distilled-agents.csv

``examples/distilled.py`` distils such options. Members learn from layouts 0 to 2 (K = 3, 150 steps); options are
distilled in layouts 1000 to 1299 and play alone, greedily, 50 of them and 100 new ones (from 6000 on). An option
succeeds if its true sub-goal holds at its member's first positive prediction, within twice the shortest path. Agents
learn in layouts 1000 to 1199 for 200,000 steps. Commits: 7347275 (``grid``, planned), c9f4649 (``deep``), 637edae
(planned controls, true sub-goals, harsh layouts, PPO), 089cd98, bdbb64b (harsh), d1bf4bb.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterator
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from hypogoal.domains.doorkey.domain import DOMAIN
from studies.cells import interval, parser_of, read_rows, table

METHODS = {
    "grid": "D-BAT, distilled by the smaller network",
    "dbat": "D-BAT, distilled",
    "planned": "D-BAT, planned",
    "none": "no diversity, distilled",
    "none-planned": "no diversity, planned",
    "one": "one classifier, distilled",
    "one-planned": "one classifier, planned",
    "oracle": "true sub-goals, distilled",
    "oracle-drawn": "true sub-goals, distilled, actions drawn",
}
CONTRASTS = (  # a minus b; of four, a minus b minus (c minus d)
    ("dbat", "planned"),
    ("none", "none-planned"),
    ("dbat", "none"),
    ("planned", "none-planned"),
    ("dbat", "none", "planned", "none-planned"),
)
SIGNS = (1, -1, -1, 1)
LEARNED, NEW = "trained", "new"  # layouts: where options learned, and others
PLAYED = "1"  # the step of rows on these; the others are of layouts on which settings were chosen
WORLDS = {"many": "plain", "many-harsh": "harsh"}
OPTIONS = {
    "distilled": "distilled",
    "grid": "distilled by the smaller network",
    "planned": "planned in the new layouts",
    "pixels-grid": "none, PPO from pixels",
}
SCORES = {
    "within_2": "within twice the shortest path",
    "success": "solved",
}
UNIFORM = "_uniform"  # what columns of uniform-random choice end in

# By method and layouts; then by seed and sub-goal: the members' numbers (K,).
Found = dict[tuple[str, str], dict[int, dict[str, NDArray[np.float64]]]]


def read(path: Path, name: str) -> Found:
    """A number of all cells."""
    numbers: Found = defaultdict(lambda: defaultdict(dict))
    for row in read_rows(path):
        if row["step"] != PLAYED:
            continue
        of_seed = numbers[row["method"], row["layouts"]][int(row["seed"])]
        members = of_seed.get(row["sub_goal"], np.empty(0))
        of_seed[row["sub_goal"]] = np.append(members, float(row[name]))
    return numbers


def mean_member(numbers: Found, method: str) -> dict[int, float]:
    """By seed, the mean over members and sub-goals on new layouts."""
    return {
        seed: float(np.mean([members[goal].mean() for goal in DOMAIN.sub_goals]))
        for seed, members in numbers[method, NEW].items()
    }


def picked_member(numbers: Found, method: str) -> dict[int, float]:
    """By seed, the mean over sub-goals on new layouts, of the member that is best where options learned."""
    picked = {}
    for seed, members in numbers[method, NEW].items():
        learned = numbers[method, LEARNED][seed]
        scores = [members[goal][int(np.argmax(learned[goal]))] for goal in DOMAIN.sub_goals]
        picked[seed] = float(np.mean(scores))
    return picked


def tables(path: Path) -> Iterator[str]:
    """What the cells of options say, as lines of Markdown."""
    within = read(path, "within_2")
    wrong = read(path, "false_positives")
    rows = []
    for method, title in METHODS.items():
        rows.append(
            [
                title,
                interval(_values(mean_member(within, method)), 2),
                interval(_values(picked_member(within, method)), 2),
                interval(_values(mean_member(wrong, method)), 2),
                str(len(within[method, NEW])),
            ]
        )
    yield "Zero-shot success within twice the shortest path on new layouts, mean over five sub-goals."
    yield "Picked: the member that is best on 50 layouts learned in.\n"
    titles = ["members and policies", "reached, mean member", "reached, picked member", "false positives", "seeds"]
    yield from table(titles, rows)
    yield "Differences over the seeds that both have.\n"
    contrasts = (_contrast(within, methods) for methods in CONTRASTS)
    yield from table(["difference", "mean member", "picked member", "seeds"], contrasts)


def _contrast(within: Found, methods: tuple[str, ...]) -> list[str]:
    seeds = sorted(set.intersection(*(set(within[method, NEW]) for method in methods)))
    name = f"{METHODS[methods[0]]} - {METHODS[methods[1]]}"
    if len(methods) > 2:
        name += f", minus the same of {METHODS[methods[2]]}"
    cells = [name]
    for of_members in (mean_member, picked_member):
        total = np.zeros(len(seeds))
        for sign, method in zip(SIGNS, methods, strict=False):
            by_seed = of_members(within, method)
            total += sign * np.array([by_seed[seed] for seed in seeds])
        cells.append(interval(total, 3))
    return [*cells, str(len(seeds))]


def _values(by_seed: dict[int, float]) -> NDArray[np.float64]:
    return np.array(list(by_seed.values()))


def tables_of_agents(path: Path) -> Iterator[str]:
    """What the cells of agents say, as lines of Markdown."""
    cells: dict[tuple[str, str], list[dict[str, str]]] = defaultdict(list)
    for row in read_rows(path):
        cells[row["world"], row["options"]].append(row)
    rows = []
    for world, world_title in WORLDS.items():
        for options, title in OPTIONS.items():
            if agents := cells[world, options]:
                columns = [_column(agents, score + chooser) for score in SCORES for chooser in ("", UNIFORM)]
                rows.append([world_title, title, *(interval(values, 2) for values in columns), str(len(agents))])
    yield "100 new layouts, without learning there, those that can be solved.\n"
    titles = [f"{score}, {chooser}" for score in SCORES.values() for chooser in ("agent", "random choice")]
    yield from table(["world", "options", *titles, "seeds"], rows)


def _column(agents: list[dict[str, str]], name: str) -> NDArray[np.float64]:
    return np.array([float(row[name]) for row in agents if row[name]])


def main() -> None:
    """Print the tables."""
    path = parser_of(__doc__).parse_args().csv
    drawn = tables_of_agents if path.stem.endswith("agents") else tables
    print("\n".join(drawn(path)))


if __name__ == "__main__":
    main()
