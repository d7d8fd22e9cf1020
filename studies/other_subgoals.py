"""What members know of rooms nobody labelled, for sub-goals other than climbing down a ladder, with labels of room 1.

    python -m studies.other_subgoals docs/results/other-subgoals.csv --seeds 0-2

A cell is a sub-goal, a method and a seed, trained and scored as in ``studies.ladders``. ``--tables`` draws them.
``--options FOLDER`` learns options in room 1 there, stage by stage, and writes how their last executions ended.
"""

from __future__ import annotations

import csv
from collections.abc import Callable, Iterator, Sequence
from functools import partial
from pathlib import Path

import numpy as np

from hypogoal.cli import main as main_of
from hypogoal.options.tables import Executions
from studies import ladders
from studies.cells import Row, interval, parser_of, run_cells, table

SUB_GOALS = ("climb-up-ladder", "pass-enemy-left", "pass-enemy-right", "pass-lasers")
METHODS = ("dbat", "none", "cnn")
LOOKS = (25, 100, 300)
GROUPS, HELDOUT = 1, 100
COLUMNS = ("sub_goal", *ladders.COLUMNS)


def run_cell(sub_goal: str, method: str, seed: int) -> list[Row]:
    """One ensemble of ``studies.ladders``, of another sub-goal."""
    return [{"sub_goal": sub_goal, **row} for row in ladders.run_cell(GROUPS, method, seed, LOOKS, sub_goal, HELDOUT)]


# Start, sub-goal, termination.
OPTIONS = (
    ("up-1L", "climb-up-ladder", "oracle"),
    ("skull-right", "pass-enemy-left", "oracle"),
    ("up-1L", "climb-up-ladder", "learned"),
)


ENDS = ("start", "sub_goal", "termination", "steps", "member", "executions", "reached", "died", "within_4")


def learn_options(folder: Path, out: Path, steps: int, terminations: Sequence[str]) -> None:
    """Ensembles of room 1 and options from a start, by the command line; a row an option: how its executions ended."""
    new = not out.exists()
    with out.open("a", encoding="utf-8", newline="") as file:
        rows = csv.writer(file, lineterminator="\n")
        if new:
            rows.writerow(ENDS)
        for start, sub_goal, termination in OPTIONS:
            if termination not in terminations:
                continue
            names = (f"{sub_goal}.h5", sub_goal, f"{start}-{termination}-{steps}")
            data, ensemble, options = (folder / name for name in names)
            few = [f"sub_goals={sub_goal}", "unlabelled_per_room=200", "heldout_per_room=20", "workers=1"]
            short = ["members=3", "steps=100", "workers=1"]
            if not data.exists():
                stage("collect", "montezuma", out=data, settings=few)
            if not ensemble.exists():
                stage("train-ensemble", str(data), out=ensemble, settings=short)
            learning = [f"start={start}", f"termination={termination}", f"steps={steps}"]
            stage("train-options", str(ensemble), out=options, settings=learning)
            ended = Executions.read(options / Executions.FILE)
            for member in sorted(set(ended.option.tolist())):
                last = ended.of(member)
                counts = (last.reached.sum(), last.terminated.sum(), (last.distance <= 4).sum())
                rows.writerow([start, sub_goal, termination, steps, member, len(last.step), *counts])
            file.flush()


def stage(name: str, given: str, *, out: Path, settings: list[str]) -> None:
    """A command of hypogoal."""
    words = [word for setting in settings for word in ("--set", setting)]
    if code := main_of([name, given, "--out", str(out), "-q", *words]):
        raise SystemExit(code)


def tables(path: Path) -> Iterator[str]:
    """The table of the page, as lines of Markdown."""
    titles = [
        "",
        "",
        "mean member's ranking",
        "picked: steps",
        "its ranking",
        "its balanced accuracy",
        "D-BAT ahead in",
    ]
    yield from table(titles, (row for goal in SUB_GOALS for row in _rows(goal, ladders.read(path, GROUPS, goal))))


def _rows(sub_goal: str, numbers: ladders.Numbers) -> Iterator[list[str]]:
    for method, seeds in numbers.items():
        means = np.array([looks[LOOKS[-1]]["ranking_unseen"].mean() for looks in seeds.values()])
        steps = f"{ladders.picked(seeds, 'first')}, {ladders.picked(seeds, 'second')}"
        rankings, dbat = (ladders.crossed(each, "ranking") for each in (seeds, numbers["dbat"]))
        accuracies = ladders.crossed(seeds, "balanced_accuracy")
        ahead = "-" if method == "dbat" else f"{(dbat > rankings).sum()} of {len(rankings)}"
        if np.isnan(rankings).any():  # one half of the unseen rooms has no positive
            yield [sub_goal, method, interval(means), *["-"] * 4]
        else:
            yield [sub_goal, method, interval(means), steps, interval(rankings), interval(accuracies), ahead]


def main() -> None:
    """Run the cells that are not in the file yet."""
    parser = parser_of(__doc__, "0-2")
    parser.add_argument("--sub-goals", default=",".join(SUB_GOALS), help="comma-separated; all by default")
    parser.add_argument("--options", type=Path, help="a folder: learn options there instead")
    parser.add_argument("--steps", type=int, default=8_000, help="of each option")
    parser.add_argument("--terminations", default="oracle,learned", help="comma-separated")
    arguments = parser.parse_args()
    if arguments.tables:
        print("\n".join(tables(arguments.csv)))
        return
    if arguments.options:
        learn_options(arguments.options, arguments.csv, arguments.steps, arguments.terminations.split(","))
        return
    jobs: dict[tuple[str, ...], Callable[[], list[Row]]] = {
        (sub_goal, method, str(seed)): partial(run_cell, sub_goal, method, seed)
        for sub_goal in arguments.sub_goals.split(",")
        for seed in arguments.seeds
        for method in METHODS
    }
    run_cells(arguments.csv, COLUMNS, ("sub_goal", "method", "seed"), jobs, lambda _: LOOKS, arguments.workers)


if __name__ == "__main__":
    main()
