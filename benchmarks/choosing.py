"""What choosing is worth, played by the agents of a sweep: the rows behind the result, and its tables.

hypogoal sweep examples/choosing.toml --out runs/choosing
python -m benchmarks.choosing runs/choosing docs/results/choosing-doorkey.csv
hypogoal run which-feature --out runs/which-feature
python -m benchmarks.choosing runs/which-feature docs/results/which-feature-rooms.csv
python -m benchmarks.choosing --tables docs/results/choosing-doorkey.csv
"""

from __future__ import annotations

import argparse
import csv
from collections.abc import Iterator
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from benchmarks.cells import interval, table
from hypogoal.core.artefacts import open_artefact
from hypogoal.core.seeding import rng_for
from hypogoal.domains.base import load_domain
from hypogoal.evaluation.choosing import ENVIRONMENTS, OF_CHOICE, OF_PLAY, UNIFORM, judge, play, qualities
from hypogoal.evaluation.curves import LEARNED
from hypogoal.meta.episodes import agent_of
from hypogoal.options.choosers import RandomChooser

METHODS = {  # by what the names of artefacts have in them, the longest first
    "dbat-truth-shape": "shape: D-BAT, K = 3",
    "divdis-truth-shape": "shape: DivDis, K = 3",
    "none-truth-shape": "shape: no diversity, K = 3",
    "one-truth-shape": "shape: one classifier, K = 1",
    "dbat-truth-place": "place: D-BAT, K = 3",
    "divdis-truth-place": "place: DivDis, K = 3",
    "none-truth-place": "place: no diversity, K = 3",
    "one-truth-place": "place: one classifier, K = 1",
    "dbat": "D-BAT, K = 6",
    "none": "no diversity, K = 6",
    "one": "one classifier, K = 1",
    "ppo": "PPO on primitive actions",
    "dqn": "DQN on primitive actions",
}
BASELINES = ("ppo", "dqn")
COLUMNS = ("method", "layout", "seed", "chooser", "quantity", "value")
SHOWN = {
    "success": "solved",
    "near": "within 1.5 shortest paths",
    "within_rho": "within-rho",
    "pair": "better of two",
    "score": "score",
}


def collect(run: Path, path: Path, baselines: Path | None = None) -> None:
    """Play every agent of a run, frozen, as the evaluation does, and chance with its options: a row per number.

    Of evaluated baselines it takes the last training episodes.
    """
    rows = [row for path in sorted((run / "agent").iterdir()) for row in _played(path)]
    if baselines:
        rows += [row for row in _numbers(baselines) if row["seed"] and not row["step"] and row["quantity"] in OF_PLAY]
    kept = []
    for row in rows:
        method = next(name for name in METHODS if f"-{name}-" in row["artefact"])
        chooser = "uniform" if row["method"] == UNIFORM else "agent"
        value = f"{float(row['value']):.4f}"
        kept.append((method, row["layout"], row["seed"], chooser, row["quantity"], value))
    order = {name: place for place, name in enumerate((*METHODS, "agent", "uniform", *OF_PLAY, *OF_CHOICE))}
    kept.sort(key=lambda row: (order[row[0]], int(row[1]), order[row[3]], order[row[4]]))
    with path.open("w", encoding="utf-8", newline="") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(COLUMNS)
        writer.writerows(kept)


def _played(path: Path) -> list[dict[str, str]]:
    artefact = open_artefact(path, "meta")
    config, seed = artefact.config, artefact.manifest["seed"]
    loop = agent_of(artefact, seed, ENVIRONMENTS)
    columns = load_domain(config["domain"]).sub_goals
    goals = np.repeat([columns.index(goal) for goal in config["sub_goals"]], config["members"])
    rows, quality = [], np.empty(0)
    for method in (LEARNED, UNIFORM):
        if method == UNIFORM:
            loop.chooser = RandomChooser(rng_for(seed, "uniform-choice"))
        played, choices = play(loop)
        quality = qualities(loop, goals, choices.states) if method == LEARNED else quality
        numbers = played | judge(choices, quality, config["members"])
        place = {"method": method, "layout": str(config["layout_seed"]), "seed": str(seed), "artefact": path.name}
        known = [name for name in (*OF_PLAY, *OF_CHOICE) if not np.isnan(numbers[name])]
        rows += [place | {"quantity": name, "value": str(numbers[name])} for name in known]
    return rows


def _numbers(run: Path) -> list[dict[str, str]]:
    with (run / "evaluation" / "numbers.csv").open(encoding="utf-8", newline="") as file:
        return list(csv.DictReader(file))


def tables(path: Path) -> Iterator[str]:
    """What the rows say, as lines of Markdown."""
    with path.open(encoding="utf-8", newline="") as file:
        rows = list(csv.DictReader(file))
    layouts = list(dict.fromkeys(row["layout"] for row in rows))
    methods = {name: title for name, title in METHODS.items() if any(row["method"] == name for row in rows)}

    def of(method: str, chooser: str, quantity: str) -> NDArray[np.float64]:
        found = {
            row["layout"]: float(row["value"])
            for row in rows
            if (row["method"], row["chooser"], row["quantity"]) == (method, chooser, quantity)
        }
        return np.array([found.get(layout, np.nan) for layout in layouts])

    yield f"Mean over {len(layouts)} layouts and Student's 95 % interval; of choices, where they are defined."
    yield ""
    yield from table(
        ["", "chooser", *SHOWN.values(), "95 % solved on", "90 % on"],
        (
            [
                title,
                "agent" if chooser == "agent" else UNIFORM,
                *(_mean(of(method, chooser, quantity)) for quantity in SHOWN),
                *(f"{(of(method, chooser, 'success') >= least).sum()} of {len(layouts)}" for least in (0.95, 0.9)),
            ]
            for method, title in methods.items()
            for chooser in (("agent",) if method in BASELINES else ("agent", "uniform"))
        ),
    )
    yield "Share of episodes solved, layout by layout: the agent / chance among its own options."
    yield ""
    yield from table(
        ["", *layouts],
        (
            [
                title,
                *(
                    f"{agent:.2f} / {chance:.2f}"
                    for agent, chance in zip(
                        of(method, "agent", "success"), of(method, "uniform", "success"), strict=True
                    )
                ),
            ]
            for method, title in methods.items()
            if method not in BASELINES
        ),
    )


def rooms(path: Path) -> Iterator[str]:
    """The tables of all settings of rooms, the last one first."""
    for which in ("", "-second", "-first"):
        of = path.with_stem(path.stem + which)
        if of.exists():
            yield f"The {which[1:] or 'third'} setting:"
            yield ""
            yield from tables(of)


def _mean(values: NDArray[np.float64]) -> str:
    known = values[~np.isnan(values)]
    few = f" (n = {len(known)})" if len(known) < len(values) else ""
    return f"{interval(known, 2)}{few}"


def main() -> None:
    """Take the numbers of a run, or draw the tables."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("run", type=Path, nargs="?", help="the folder of the sweep")
    parser.add_argument("csv", type=Path, help="the file of rows")
    parser.add_argument("--baselines", type=Path, help="the folder of the sweep of baselines")
    parser.add_argument("--tables", action="store_true", help="print the tables only")
    arguments = parser.parse_args()
    if not arguments.tables:
        collect(arguments.run, arguments.csv, arguments.baselines)
    drawn = rooms if arguments.csv.stem == "which-feature-rooms" else tables
    print("\n".join(drawn(arguments.csv)))


if __name__ == "__main__":
    main()
