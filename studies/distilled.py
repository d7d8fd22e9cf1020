"""Do options distilled from plans of other layouts work on layouts that nobody played? DoorKey.

    python -m studies.distilled docs/results/distilled.csv --seeds 0-4

A cell is a method and a seed: an ensemble's options, distilled by ``train-options --preset distilled`` or planned in
the new layouts themselves, each then played alone as in ``studies.many_layouts``, in layouts that were learned in
(``trained``) and in 100 others from ``FIRST`` on (``new``). The options stay in ``--work``, for
``studies.distilled_agents``.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from typing import Any

from hypogoal.core.artefacts import Artefact, open_artefact
from hypogoal.core.compute import prepare
from hypogoal.core.config import resolve
from hypogoal.core.tensors import load_tensors
from hypogoal.domains.base import Layouts
from hypogoal.domains.doorkey import DOMAIN, DoorKeyConfig
from hypogoal.evaluation.zero_shot import OF_OPTIONS
from hypogoal.hypotheses.config import TrainEnsembleConfig
from hypogoal.meta.config import TrainOptionsConfig
from hypogoal.meta.training import assemble
from hypogoal.stages.collect import collect
from hypogoal.stages.train_ensemble import train_ensemble
from hypogoal.stages.train_options import train_options
from studies.cells import Cell, Row, difference, interval, parser_of, run_cells, table
from studies.many_layouts import ENSEMBLE_STEPS, KEYS, WHERE, new_layouts, of_seeds, picked, read, tried_out

FIRST = 6000  # new layouts begin here; those from 5000 on were seen while settings were chosen
PICKING = tuple(range(1000, 1050))  # layouts on which members are picked
STEP = 1  # of a cell: options are looked at once
GRID = {  # the first setting
    "embedding": "grid",
    "layouts": "1000-1199",
    "option_batch": 256,
    "steps": 160_000,
    "rate_steps": 160_000,
}
ENSEMBLES: dict[str, dict[str, Any]] = {"dbat": {}, "none": {"diversity": "none"}, "one": {"members": 1}}
# A title, the ensemble, settings of the options.
METHODS: dict[str, tuple[str, str, dict[str, Any]]] = {
    "grid": ("D-BAT, distilled, grid, 200 layouts", "dbat", GRID),
    "dbat": ("D-BAT, distilled", "dbat", {}),
    "planned": ("D-BAT, planned", "dbat", {"network": "planned"}),
    "none": ("no diversity, distilled", "none", {}),
    "none-planned": ("no diversity, planned", "none", {"network": "planned"}),
    "one": ("one classifier, distilled", "one", {}),
    "one-planned": ("one classifier, planned", "one", {"network": "planned"}),
    "oracle": ("true sub-goals, distilled", "dbat", {"termination": "oracle"}),
}
COLUMNS = (*KEYS, *OF_OPTIONS, "cpu_seconds")


def ensemble_of(work: Path, name: str, seed: int) -> Artefact:
    """One of ``ENSEMBLES``; trained if it is not there."""
    out = work / f"{name}-{seed}"
    if not (out / "manifest.json").exists():
        config = TrainEnsembleConfig(**{"steps": ENSEMBLE_STEPS, "workers": 1, **ENSEMBLES[name]})
        train_ensemble(work / "data.h5", config, out, seed=seed, force=True, quiet=True)
    return open_artefact(out, "ensemble")


def settings_of(method: str) -> TrainOptionsConfig:
    """The preset's, or those of planned options, which learn in no layout."""
    _, _, changes = METHODS[method]
    if "network" in changes:
        return TrainOptionsConfig(**changes)
    return resolve(TrainOptionsConfig, stage="train-options", preset="distilled", options=changes)


def run_cell(work: Path, method: str, seed: int) -> list[Row]:
    """Distil an ensemble's options, then play each alone, on layouts learned in and on new ones; a row of each."""
    prepare()
    source = ensemble_of(work, METHODS[method][1], seed)
    config, spent, state = settings_of(method), 0.0, None
    if config.network == "distilled":
        out, begun = work / f"options-{method}-{seed}", time.process_time()
        train_options(source.path, config, out, seed=seed, force=True, quiet=True)
        spent, state = time.process_time() - begun, load_tensors(out / "options.safetensors")
    rows = []
    for where, seeds in zip(WHERE, (PICKING, new_layouts(FIRST)), strict=True):
        played = TrainOptionsConfig(
            network=config.network,
            embedding=config.embedding,
            termination=config.termination,
            environments=len(seeds),
            mask_reached=False,
        )
        loop = assemble(DOMAIN, source.path, source.config, played, seed, layouts=Layouts(tuple(seeds)))
        if state is not None:
            loop.learner.load(state)
        place = {"method": method, "seed": seed, "step": STEP, "layouts": where, "cpu_seconds": spent}
        rows += [place | row for row in tried_out(loop, source.config["sub_goals"])]
    return rows


def tables(path: Path) -> Iterator[str]:
    """What the cells say, as lines of Markdown."""
    within, wrong, success = (read(path, name) for name in ("within_2", "wrong_yes", "success"))
    spent = read(path, "cpu_seconds")
    methods = [method for method in METHODS if (method, STEP, WHERE[1]) in within]
    yield "Zero-shot success within twice the shortest path on new layouts, mean over five sub-goals."
    yield "Picked: the member that is best on 50 layouts learned in."
    yield ""
    yield from table(
        ["options", "mean member", "picked member", "false positives", "any success", "CPU minutes", "seeds"],
        (
            [
                METHODS[method][0],
                interval(of_seeds(within, (method, STEP, WHERE[1])), 2),
                interval(picked(within, method, STEP), 2),
                interval(of_seeds(wrong, (method, STEP, WHERE[1])), 2),
                interval(of_seeds(success, (method, STEP, WHERE[1])), 2),
                f"{minutes:.1f}" if (minutes := of_seeds(spent, (method, STEP, WHERE[1])).max() / 60) else "-",
                str(len(within[method, STEP, WHERE[1]])),
            ]
            for method in methods
        ),
    )
    yield "By sub-goal, mean member."
    yield ""
    yield from table(
        ["sub-goal", *(METHODS[method][0] for method in methods)],
        (
            [goal, *(f"{of_seeds(within, (method, STEP, WHERE[1]), goal).mean():.2f}" for method in methods)]
            for goal in DOMAIN.sub_goals
        ),
    )
    yield from _differences(path)


def _differences(path: Path) -> Iterator[str]:
    """What the rules ask for, seed by seed: distilled minus planned; diversity's share in the picked member."""
    within = read(path, "within_2")
    pairs = [
        ("dbat", "planned"),
        ("grid", "planned"),
        ("none", "none-planned"),
        ("one", "one-planned"),
        ("dbat", "none"),
        ("dbat", "one"),
    ]
    yield "Differences over the seeds that both have."
    yield ""
    lines = []
    for first, second in pairs:
        keys = [(method, STEP, WHERE[1]) for method in (first, second)]
        seeds = sorted(set(within[keys[0]]) & set(within[keys[1]]))
        if not seeds:
            continue
        some = {(method, STEP, where): {seed: within[method, STEP, where][seed] for seed in seeds}
                for method in (first, second) for where in WHERE}  # fmt: skip
        means, picks = ([of(some, method) for method in (first, second)] for of in (_means, _picks))
        name = f"{METHODS[first][0]} - {METHODS[second][0]}"
        lines.append([name, difference(means[0] - means[1], 3), difference(picks[0] - picks[1], 3), str(len(seeds))])
    yield from table(["difference", "mean member", "picked member", "seeds"], lines)


def _means(numbers: Any, method: str) -> Any:
    return of_seeds(numbers, (method, STEP, WHERE[1]))


def _picks(numbers: Any, method: str) -> Any:
    return picked(numbers, method, STEP)


def main() -> None:
    """Run the cells that are not in the file yet."""
    parser = parser_of(__doc__, "0")
    parser.add_argument("--work", type=Path, default=Path("runs/distilled"), help="the folder of data and artefacts")
    parser.add_argument("--methods", default=",".join(METHODS), help=f"of {', '.join(METHODS)}")
    arguments = parser.parse_args()
    if arguments.tables:
        print("\n".join(tables(arguments.csv)))
        return
    if not (arguments.work / "data.h5").exists():
        collect(DOMAIN, DoorKeyConfig(heldout_layouts=1), arguments.work / "data.h5", quiet=True)
    jobs: dict[Cell, Callable[[], list[Row]]] = {
        (method, str(seed)): partial(run_cell, arguments.work, method, seed)
        for seed in arguments.seeds
        for method in arguments.methods.split(",")
    }
    run_cells(arguments.csv, COLUMNS, KEYS[:2], jobs, lambda _: (STEP,), arguments.workers)


if __name__ == "__main__":
    main()
