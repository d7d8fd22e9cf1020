"""Do options learned over 1,000 layouts work on layouts that nobody played? DoorKey, members' verdicts as reward.

    python -m studies.many_layouts docs/results/many-layouts.csv --seeds 0-4

A cell is a method and a seed: all options of an ensemble, learned together, looked at on the way. A look lets each
option play alone, greedily, from the start of 100 layouts that training drew from (``trained``) and of 100 others
(``new``), see ``hypogoal.evaluation.zero_shot``. The others are those from ``FIRST`` on whose grid is none of a layout
that anything was learned on. Kept and gone on with as in ``studies.hypotheses``; ``--tables`` draws the cells.

Controls show what limits success: ``planned`` options take the shortest path to a positive prediction, so what they
lack is the members' fault; ``oracle`` options learn from true sub-goals, so what they lack is learning's; ``trained``
against ``new`` layouts shows how policies generalise; ``one-layout`` what variety is worth. More exploration, and
convolutions over the cells, are what we tried where learning failed.
"""

from __future__ import annotations

import itertools
import time
from collections import defaultdict
from collections.abc import Iterator
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from hypogoal.core.artefacts import open_artefact
from hypogoal.core.compute import prepare
from hypogoal.core.config import parse_integers
from hypogoal.domains.base import Layouts
from hypogoal.domains.doorkey import DOMAIN, DoorKeyConfig
from hypogoal.domains.doorkey_env import layout_of
from hypogoal.evaluation.zero_shot import OF_OPTIONS, alone, shortest_ways
from hypogoal.hypotheses.config import TrainEnsembleConfig
from hypogoal.meta.config import TrainOptionsConfig, layout_seeds
from hypogoal.meta.training import assemble
from hypogoal.options.loop import OptionLoop
from hypogoal.stages.train_ensemble import train_ensemble
from studies.cells import Cell, Jobs, Row, collect_once, interval, parser_of, printed, read_rows, run_cells, table

TRAINED, FIRST, TRIED = "1000-1999", 5000, 100  # layouts to learn in; where the new ones begin, and how many
LEARNT = (0, 1, 2)  # layouts of the states that ensembles learn from
PLANNED = (1,)  # step: where there is nothing to learn
LOOKS = (100_000, 300_000, 1_000_000, 3_000_000)  # environment steps, of all options together
LOOKS_SHOWN = 2  # the last ones; earlier looks are in the cells alone
GOAL = 0.7  # zero-shot success within twice the shortest path
ENSEMBLE_STEPS = 150
EXPLORING = {"epsilon_steps": 1_000_000, "epsilon_final": 0.2}  # steps of an option's own: it hardly falls
GRID = {**EXPLORING, "embedding": "grid"}
# A title, settings of the ensemble and of its options.
METHODS: dict[str, tuple[str, dict[str, Any], dict[str, Any]]] = {
    "dbat": ("D-BAT's members", {}, {}),
    "none": ("members without diversity", {"diversity": "none"}, {}),
    "one-layout": ("D-BAT's, one layout", {}, {"layouts": "1000-1000"}),
    "oracle": ("true sub-goals", {}, {"termination": "oracle"}),
    "exploring": ("true sub-goals, exploring", {}, {"termination": "oracle", **EXPLORING}),
    "oracle-grid": ("true sub-goals, grid", {}, {"termination": "oracle", **GRID}),
    "dbat-grid": ("D-BAT's, grid", {}, GRID),
    "none-grid": ("no diversity, grid", {"diversity": "none"}, GRID),
    "planned": ("D-BAT's, planned", {}, {"network": "planned", "layouts": "1000-1000"}),
}
WITH_DBATS = ("one-layout", "oracle", "exploring", "oracle-grid", "dbat-grid", "planned")
ENSEMBLES = {**dict.fromkeys(WITH_DBATS, "dbat"), "none-grid": "none"}  # of another method
KEYS = ("method", "seed", "step", "layouts", "sub_goal", "member")
COLUMNS = (*KEYS, *OF_OPTIONS, "steps_per_second", "states")
WHERE = ("trained", "new")


def new_layouts(first: int = FIRST) -> list[int]:
    """The first seeds from there on whose grids nothing was learned on, and which differ from each other."""
    grids = {layout_of(seed).grid for seed in (*LEARNT, *layout_seeds(TRAINED))}
    new: list[int] = []
    for seed in itertools.count(first):
        if (grid := layout_of(seed).grid) not in grids:
            grids.add(grid)
            new.append(seed)
        if len(new) == TRIED:
            return new
    raise AssertionError("there is always another seed")


def ensemble_of(work: Path, method: str, seed: int) -> Path:
    """Where the ensemble is; trained if it is not there."""
    name = ENSEMBLES.get(method, method)
    out = work / f"{name}-{seed}"
    if not (out / "manifest.json").exists():
        config = TrainEnsembleConfig(**{"steps": ENSEMBLE_STEPS, "workers": 1, **METHODS[name][1]})
        train_ensemble(work / "data.h5", config, out, seed=seed, force=True, quiet=True)
    return out


def run_cell(work: Path, method: str, seed: int, looks: tuple[int, ...]) -> list[Row]:
    """Learn the options of one ensemble; a row of each option, on trained and on new layouts, at each look."""
    prepare()
    source = open_artefact(ensemble_of(work, method, seed), "ensemble")
    config = TrainOptionsConfig(**{"layouts": TRAINED, **METHODS[method][2]})
    loop = assemble(DOMAIN, source.path, source.config, config, seed)
    trained = layout_seeds(config.layouts)
    tried = {"trained": trained[:: max(1, len(trained) // TRIED)][:TRIED], "new": new_layouts()}
    tests: dict[str, OptionLoop] = {}
    rows: list[Row] = []
    spent = 0.0
    for look in looks:
        begun = time.process_time()
        while loop.recorder.steps < look:
            loop.step()
        spent += time.process_time() - begun
        for where, seeds in tried.items():
            if where not in tests:
                alike = replace(config, layouts="", environments=len(seeds), replay=1_000, mask_reached=False)
                tests[where] = assemble(DOMAIN, source.path, source.config, alike, seed, layouts=Layouts(seeds))
            tests[where].learner.load(loop.learner.state())
            numbers = {"steps_per_second": look / max(spent, 1e-9), "states": float(loop.engine.n_states)}
            place = {"method": method, "seed": seed, "step": look, "layouts": where}
            rows += [place | row | numbers for row in tried_out(tests[where], source.config["sub_goals"])]
    return rows


def tried_out(loop: OptionLoop, sub_goals: list[str]) -> Iterator[Row]:
    """Each option alone in each environment's layout: the means over layouts."""
    loop.engine.reset()
    ways, members = shortest_ways(loop.engine), loop.terminations.options // len(sub_goals)
    for option in range(loop.terminations.options):
        sub_goal, goal = sub_goals[option // members], DOMAIN.sub_goals.index(sub_goals[option // members])
        numbers = alone(loop, option, goal, ways[:, goal])
        yield {"sub_goal": sub_goal, "member": option % members} | {
            name: float(numbers[name].mean()) for name in numbers
        }


# By method, step and layouts; then by seed and sub-goal: the members' numbers (K,).
Found = dict[tuple[str, int, str], dict[int, dict[str, NDArray[np.float64]]]]


def read(path: Path, name: str) -> Found:
    """A number of all cells."""
    numbers: Found = defaultdict(lambda: defaultdict(dict))
    for row in read_rows(path):
        of_seed = numbers[row["method"], int(row["step"]), row["layouts"]][int(row["seed"])]
        of_seed[row["sub_goal"]] = np.append(of_seed.get(row["sub_goal"], np.empty(0)), float(row[name]))
    return numbers


def of_seeds(numbers: Found, key: tuple[str, int, str], sub_goal: str = "") -> NDArray[np.float64]:
    """Each seed's mean over members, of one sub-goal or of all."""
    goals = [sub_goal] if sub_goal else DOMAIN.sub_goals
    return np.array([np.mean([members[goal].mean() for goal in goals]) for members in numbers[key].values()])


def picked(numbers: Found, method: str, step: int) -> NDArray[np.float64]:
    """Each seed's mean over sub-goals on new layouts, of the member that is best on those trained on."""
    trained, new = (numbers[method, step, where] for where in WHERE)
    return np.array(
        [np.mean([new[seed][goal][int(np.argmax(trained[seed][goal]))] for goal in DOMAIN.sub_goals]) for seed in new]
    )


def tables(path: Path) -> Iterator[str]:
    """What the cells say, as lines of Markdown."""
    within, wrong = read(path, "within_2"), read(path, "false_positives")
    steps = {method: sorted({step for name, step, _ in within if name == method}) for method in METHODS}
    methods = [method for method in METHODS if steps[method]]
    yield f"Zero-shot success within twice the shortest path (wanted: {GOAL}), mean member, mean over five sub-goals;"
    yield "with a 95 % interval over seeds. Picked: the member that is best on layouts trained on."
    yield ""
    yield from table(
        ["options", "steps", "trained layouts", "**new layouts**", "picked", "false positives", "seeds"],
        (
            [
                METHODS[method][0],
                f"{step:,}",
                *(interval(of_seeds(within, (method, step, where)), 2) for where in WHERE),
                interval(picked(within, method, step), 2),
                interval(of_seeds(wrong, (method, step, "new")), 2),
                str(len(within[method, step, "new"])),
            ]
            for method in methods
            for step in steps[method][-LOOKS_SHOWN:]
        ),
    )
    yield "By sub-goal, new layouts, the last look: within twice the shortest path / false positive, mean member."
    yield ""
    last = [(method, steps[method][-1], "new") for method in methods]

    def both(key: tuple[str, int, str], goal: str) -> str:
        return " / ".join(f"{of_seeds(numbers, key, goal).mean():.2f}" for numbers in (within, wrong))

    yield from table(
        ["sub-goal", *(METHODS[method][0] for method in methods)],
        ([goal, *(both(key, goal) for key in last)] for goal in DOMAIN.sub_goals),
    )


def main() -> None:
    """Run the cells that are not in the file yet."""
    parser = parser_of(__doc__, "0")
    parser.add_argument("--work", type=Path, default=Path("runs/many-layouts"), help="the folder of data and ensembles")
    parser.add_argument("--methods", default=",".join(METHODS), help=f"of {', '.join(METHODS)}")
    parser.add_argument("--looks", type=parse_integers, default=LOOKS, help="environment steps at which to look")
    arguments = parser.parse_args()
    if printed(arguments, tables):
        return
    collect_once(DOMAIN, DoorKeyConfig(heldout_layouts=1), arguments.work / "data.h5")
    looks = tuple(arguments.looks)

    def looks_of(cell: Cell) -> tuple[int, ...]:
        return PLANNED if cell[0] == "planned" else looks

    jobs: Jobs = {
        (method, str(seed)): partial(run_cell, arguments.work, method, seed, looks_of((method, str(seed))))
        for seed in arguments.seeds
        for method in arguments.methods.split(",")
    }
    run_cells(arguments.csv, COLUMNS, KEYS[:2], jobs, looks_of, arguments.workers)


if __name__ == "__main__":
    main()
