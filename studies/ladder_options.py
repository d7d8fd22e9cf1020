"""How near to a ladder's base do options stop that were learned on it? Figure 4.

    python -m studies.ladder_options docs/results/figure4-ladders.csv --groups 1 --seeds 10

A cell is a method, N (labelled ladder groups), a ladder and a seed: the options of all members of an ensemble, learned
on that ladder. The stages themselves are run, in the folder of ``--work``; ensembles stay there, of options only the
rows of the CSV. Kept and gone on with as in ``studies.hypotheses``; ``--tables`` draws the cells.

View, network and Table 1 are the paper's, but K = 3, and 40,000 steps an option with the light network. Nine ladders:
the paper's twelve without those whose tops are bases. Ensembles train for the steps with the highest balanced accuracy
of the best member over all rooms (D-BAT 25, no diversity 1,000, CNN 50). The unit is the ensemble, so
a seed: its ladders are six looks at the same members.
Commits f88cd87 to 5bdde7c, 2.5 core hours; seeds 12 to 16 at N = 1: 033b90a9 and 77a9bdec, 5 core hours.
"""

from __future__ import annotations

import shutil
from collections.abc import Callable, Iterator
from functools import partial
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from hypogoal.core.artefacts import open_artefact
from hypogoal.core.config import integers
from hypogoal.core.processes import in_processes
from hypogoal.domains.montezuma.domain import DOMAIN, MontezumaConfig
from hypogoal.domains.montezuma.sub_goals import CLIMB_DOWN, LABELLED_ROOMS
from hypogoal.evaluation.distance import option_numbers
from hypogoal.options.tables import Executions
from hypogoal.stages.train_ensemble import train_ensemble
from hypogoal.stages.train_options import train_options
from studies.cells import Jobs, Row, amount, collect_once, parser_of, printed, read_rows, run_cells, table
from studies.ladders import read as read_lengths

Settings = dict[str, Any]
METHODS: dict[str, tuple[str, Settings, Settings]] = {  # a title, settings of the ensemble and of its options
    "dbat": ("D-BAT", {"diversity": "dbat"}, {}),
    "none": ("no diversity", {"diversity": "none"}, {}),
    "cnn": ("one classifier", {"members": 1, "diversity": "none"}, {}),
    "oracle": ("true sub-goal", {"diversity": "dbat"}, {"termination": "oracle"}),  # whatever the ensemble
}
ENSEMBLES = {"oracle": "dbat"}  # whose ensemble is another method's
OF_SEVERAL = ("dbat", "none")  # whose members differ
PAIRS = (("none", "dbat"), ("cnn", "dbat"), ("cnn", "none"))  # which methods are compared
MEMBERS, STEPS = 3, 40_000
# The paper's Figure 4 has three more, whose tops are bases themselves.
LADDERS = ("1L", "1M", "1R", "2-6", "3-9", "14-22", "0-4", "5-11", "7-13")
MOST_GROUPS = 7  # which leave no ladder without labels
KEYS = ("groups", "method", "seed", "ladder", "step", "member")
NUMBERS = ("distance", "reached_base", "inside_at_start", "timed_out", "died", "duration")
# Last: the same executions without the rule of 300; rows of 0.13 and before have none.
COLUMNS = (*KEYS, "ensemble_steps", *NUMBERS, "stop_distance")
LENGTHS = Path("docs/results/figure3-ladders.csv")
CHOOSING = {1: range(5)}  # seeds by N that pick the length; of all others every seed


def length(groups: int, method: str) -> int:
    """The rule: the look at which the best member's balanced accuracy over all rooms is highest, mean over seeds."""
    cells = read_lengths(LENGTHS, groups)[method]
    seeds = [steps for seed, steps in cells.items() if seed in CHOOSING.get(groups, cells)]
    looks = seeds[0]
    return max(looks, key=lambda look: np.mean([steps[look]["balanced_accuracy_all"].max() for steps in seeds]))


def ensemble_of(work: Path, groups: int, method: str, seed: int) -> Path:
    """Where the ensemble is; trained if it is not there."""
    out = work / f"{method}-{groups}-{seed}"
    if not (out / "manifest.json").exists():
        usual = {**DOMAIN.defaults["train-ensemble"], "members": MEMBERS, "workers": 1}
        settings = usual | {"steps": length(groups, method)} | METHODS[method][1]
        train_ensemble(work / f"groups-{groups}.h5", out, seed=seed, force=True, quiet=True, **settings)
    return out


def run_cell(work: Path, groups: int, method: str, seed: int, ladder: str) -> list[Row]:
    """Learn the options of one ensemble on one ladder; of each member the last executions' numbers."""
    ensemble = ensemble_of(work, groups, ENSEMBLES.get(method, method), seed)
    out = work / f"options-{groups}-{method}-{seed}-{ladder}"
    usual = {**DOMAIN.defaults["train-options"], "start": ladder, "steps": STEPS}
    train_options(ensemble, out, seed=seed, force=True, quiet=True, **(usual | METHODS[method][2]))
    executions = Executions.read(out / "executions.csv")
    members = open_artefact(out, "options").config["members"]
    trained = open_artefact(ensemble, "ensemble").config["steps"]
    rows = []
    for member in range(members):
        of_member = executions.at(executions.option == member)
        numbers = option_numbers(of_member).iloc[0] if len(of_member) else dict.fromkeys(NUMBERS, float("nan"))
        place = dict(zip(KEYS, (groups, method, seed, ladder, STEPS, member), strict=True))
        rows.append(
            place
            | {"ensemble_steps": trained}
            | {name: float(numbers[name]) for name in NUMBERS}
            | {"stop_distance": float(of_member.distance.mean()) if len(of_member.step) else float("nan")}
        )
    kept = out.parent / "executions"  # for Figure 5
    kept.mkdir(exist_ok=True)
    shutil.copyfile(out / "executions.csv", kept / f"{out.name}-{STEPS}.csv")
    shutil.rmtree(out)
    return rows


Distances = dict[tuple[str, str], dict[int, NDArray[np.float64]]]  # by method and ladder, by seed: (K,)


def read(path: Path, groups: int, name: str = "distance") -> Distances:
    """A number of the cells of one N."""
    numbers: Distances = {}
    for row in read_rows(path):
        if int(row["groups"]) == groups:
            seeds = numbers.setdefault((row["method"], row["ladder"]), {})
            seed = int(row["seed"])
            seeds[seed] = np.append(seeds.get(seed, np.empty(0)), float(row[name] or "nan"))
    return numbers


def tables(path: Path) -> Iterator[str]:
    """What the cells say, as lines of Markdown."""
    for groups in range(1, 8):
        if distances := read(path, groups):
            yield from _tables(groups, distances, read(path, groups, "inside_at_start"))
            if groups < MOST_GROUPS:
                by_true_distance = read(path, groups, "stop_distance")
                yield from _leads(groups, {"300 units": distances, "its true distance": by_true_distance})


def _leads(groups: int, measures: dict[str, Distances]) -> Iterator[str]:
    """How much farther one method stops than another on ladders without labels, ensemble by ensemble."""
    rooms = {str(room) for group in LABELLED_ROOMS[CLIMB_DOWN.name]["groups"][:groups] for room in group}
    new = [ladder for ladder in LADDERS if not rooms & {*ladder.rstrip("LMR").split("-")}]
    rows = []
    for (counted, distances), (other, nearer) in product(measures.items(), PAIRS):
        for name, of_members in (("best", np.min), ("mean", np.mean)):
            gaps = gaps_of(distances, other, nearer, new, of_members)
            titles = [METHODS[other][0], METHODS[nearer][0], f"{name} member", counted]
            rows.append([*titles, amount(np.array([*gaps.values()]), 0), ", ".join(map(str, gaps))])
    yield f"N = {groups}: one method minus another, mean over {len(new)} ladders without labels.\n"
    header = [
        "method",
        "compared with",
        "which member",
        "a positive start counts",
        "stops farther away by, units",
        "ensembles, by seed",
    ]
    yield from table(header, rows)


def gaps_of(
    distances: Distances,
    other: str,
    nearer: str,
    ladders: list[str],
    of_members: Callable[[NDArray[np.float64]], np.floating[Any]],
) -> dict[int, float]:
    """By seed, how much farther ``other`` stops than ``nearer``: mean over ladders, for seeds that both have on all."""
    cells = [distances.get((method, ladder), {}) for method in (other, nearer) for ladder in ladders]
    gaps = {}
    shared = set(cells[0]).intersection(*cells) if cells else set()
    for seed in sorted(shared):
        of_other = [of_members(distances[other, ladder][seed]) for ladder in ladders]
        of_nearer = [of_members(distances[nearer, ladder][seed]) for ladder in ladders]
        gap = float(np.mean(of_other) - np.mean(of_nearer))
        if not np.isnan(gap):
            gaps[seed] = gap
    return gaps


def _tables(groups: int, distances: Distances, inside: Distances) -> Iterator[str]:
    methods = [method for method in METHODS if any(name == method for name, _ in distances)]
    learned = [method for method in methods if method != "oracle"]  # the control may lag behind
    whole = [ladder for ladder in LADDERS if all((method, ladder) in distances for method in learned)]
    yield f"N = {groups}: distance to the nearest true base, RAM units.\n"
    rows = []
    for ladder in whole:
        stops = [stop for method in methods for stop in _stops(method, distances.get((method, ladder), {}))]
        rows.append([ladder, *stops])
    titles = [title for method in methods for title in _titles(method)]
    yield from table(["ladder", *titles], rows)
    yield f"N = {groups}: the share of executions that began inside their own termination set, mean over members.\n"
    began = []
    for ladder in whole:
        began.append([ladder, *(f"{np.mean([*inside[method, ladder].values()]):.2f}" for method in learned)])
    yield from table(["ladder", *(f"{METHODS[method][0]}, positive starts" for method in learned)], began)


def best_mean_worst(seeds: dict[int, NDArray[np.float64]]) -> tuple[float, float, float]:
    """The best, the mean and the worst member's number, mean over seeds."""
    best, mean, worst = (
        float(np.mean([reduce(members) for members in seeds.values()])) for reduce in (np.min, np.mean, np.max)
    )
    return best, mean, worst


def _titles(method: str) -> list[str]:
    """Name a method's columns: one for each of best, mean and worst member, if its members differ."""
    title = METHODS[method][0]
    return [f"{title}, {which}" for which in ("best", "mean", "worst")] if method in OF_SEVERAL else [title]


def _stops(method: str, seeds: dict[int, NDArray[np.float64]]) -> list[str]:
    """Write a method's cells of one ladder, in the order of its columns."""
    if not seeds:
        return ["-"] * len(_titles(method))
    best, mean, worst = best_mean_worst(seeds)
    shown = (best, mean, worst) if method in OF_SEVERAL else (mean,)
    return [f"{number:.0f}" for number in shown]


def main() -> None:
    """Run the cells that are not in the file yet."""
    parser = parser_of(__doc__, "10")
    parser.add_argument(
        "--work", type=Path, default=Path("runs/ladder-options"), help="the folder of data and ensembles"
    )
    parser.add_argument("--groups", type=integers, default=(1,), help="N: 1 or 1,2")
    parser.add_argument("--methods", default=",".join(METHODS), help=f"of {', '.join(METHODS)}")
    parser.add_argument("--ladders", default=",".join(LADDERS), help=f"of {', '.join(LADDERS)}")
    arguments = parser.parse_args()
    if printed(arguments, tables):
        return
    work, methods = arguments.work, arguments.methods.split(",")
    for groups in arguments.groups:
        settings = MontezumaConfig(groups=groups, workers=1)
        collect_once(DOMAIN, settings, work / f"groups-{groups}.h5")
    trained = {ENSEMBLES.get(method, method) for method in methods}
    ensembles = [
        partial(ensemble_of, work, groups, method, seed)
        for groups in arguments.groups
        for seed in arguments.seeds
        for method in sorted(trained)
    ]
    if arguments.workers > 1:  # else each when it is needed
        in_processes(ensembles, arguments.workers, lambda *_: None)
    jobs: Jobs = {
        (str(groups), method, str(seed), ladder): partial(run_cell, work, groups, method, seed, ladder)
        for groups in arguments.groups
        for seed in arguments.seeds
        for ladder in arguments.ladders.split(",")
        for method in methods
    }
    run_cells(arguments.csv, COLUMNS, KEYS[:4], jobs, lambda _: (STEPS,), arguments.workers)


if __name__ == "__main__":
    main()
