"""Do options distilled from plans of other layouts work on layouts that nobody played? DoorKey.

    python -m studies.distilled docs/results/distilled.csv --seeds 0-4

A cell is a method and a seed: an ensemble's options, distilled by ``train-options --preset distilled`` or planned in
the new layouts themselves, each then played alone as in ``studies.many_layouts``, in layouts that were learned in
(``trained``) and in 100 others from ``FIRST`` on (``new``). With ``--choosing`` they play 100 layouts from
``CHOOSING`` on instead, on which settings are chosen. The options stay in ``--work``, for
``studies.distilled_agents``.
"""

from __future__ import annotations

import time
from collections.abc import Iterator
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch

from hypogoal.core.artefacts import Artefact, open_artefact
from hypogoal.core.compute import prepare
from hypogoal.core.config import resolve
from hypogoal.core.own_code import vouched
from hypogoal.core.seeding import torch_generator
from hypogoal.core.tensors import load_tensors
from hypogoal.domains.base import Layouts
from hypogoal.domains.doorkey import DOMAIN, DoorKeyConfig
from hypogoal.evaluation.zero_shot import OF_OPTIONS
from hypogoal.hypotheses.config import TrainEnsembleConfig
from hypogoal.meta.config import TrainOptionsConfig
from hypogoal.meta.training import assemble
from hypogoal.options.choosers import Ids
from hypogoal.options.distilled import DistilledLearner
from hypogoal.options.networks import apply_to_states
from hypogoal.stages.train_ensemble import train_ensemble
from hypogoal.stages.train_options import train_options
from studies.cells import Jobs, Row, collect_once, difference, interval, parser_of, printed, run_cells, table
from studies.many_layouts import ENSEMBLE_STEPS, KEYS, WHERE, new_layouts, of_seeds, picked, read, tried_out

FIRST = 6000  # new layouts begin here; those from 5000 on were seen while settings were chosen
CHOOSING = 2000  # layouts on which settings are chosen begin here
PICKING = tuple(range(1000, 1050))  # layouts on which members are picked
CHOOSE, STEP = 0, 1  # of a cell: looked at on layouts to choose on, or on new ones
GRID = {  # the first setting
    "embedding": "grid",
    "layouts": "1000-1199",
    "option_batch": 256,
    "steps": 160_000,
    "rate_steps": 160_000,
}
TRUE = {"termination": "oracle"}
OWN = "studies.distilled:OwnStates"
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
    "oracle": ("true sub-goals, distilled", "dbat", TRUE),
    "oracle-many": ("true sub-goals, 800 layouts", "dbat", TRUE | {"layouts": "1000-1799"}),
    "oracle-own": ("true sub-goals, also from states of its own play", "dbat", TRUE | {"network": OWN}),
    "oracle-drawn": ("true sub-goals, actions drawn", "dbat", TRUE),
}
PUBLISHED = tuple(METHODS)[:8]  # the others are tried on layouts on which settings are chosen
SAME_OPTIONS = {"oracle-drawn": "oracle"}  # as those of another method, played in another way
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
    if changes.get("network") == "planned":
        return TrainOptionsConfig(**changes)
    return resolve(TrainOptionsConfig, stage="train-options", preset="distilled", options=changes)


class OwnStates(DistilledLearner):
    """It also learns from states of its own play: in the second half of training its network plays, greedily, in half
    of the environments; plans say what was best there (DAgger: Ross, Gordon and Bagnell 2011).
    """

    def act(self, ids: Ids, options: Ids, age: Ids, *, explore: bool = True) -> Ids:
        actions = super().act(ids, options, age, explore=explore)
        if explore and not self.loaded and 2 * self.steps >= self.config.rate_steps:
            half = slice(len(ids) // 2)
            actions[half] = self.actions[self.greedy(ids[half], options[half], age[half])]
        return actions


@torch.no_grad()
def drawn(learner: DistilledLearner, generator: torch.Generator, ids: Ids, options: Ids, age: Ids) -> Ids:
    """Actions drawn by their probabilities, in place of the most probable one, which may lead in circles."""
    scores = apply_to_states(learner.online, learner.pictures, ids)[np.arange(len(ids)), options]
    chosen: Ids = torch.multinomial(scores.softmax(1), 1, generator=generator)[:, 0].numpy()
    return chosen


def options_of(work: Path, method: str, seed: int) -> tuple[Path, float]:
    """Where the distilled options of an ensemble are, trained if they are not there, and the CPU seconds that took."""
    method = SAME_OPTIONS.get(method, method)
    out, seconds = work / f"options-{method}-{seed}", work / f"options-{method}-{seed}.seconds"
    if not (out / "manifest.json").exists():
        source, begun = ensemble_of(work, METHODS[method][1], seed), time.process_time()
        with vouched(OWN):
            train_options(source.path, settings_of(method), out, seed=seed, force=True, quiet=True)
        seconds.write_text(str(time.process_time() - begun), encoding="utf-8")
    return out, float(seconds.read_text(encoding="utf-8")) if seconds.exists() else 0.0


def run_cell(work: Path, method: str, seed: int, step: int) -> list[Row]:
    """An ensemble's options, each played alone; a row of each, on layouts learned in and new ones, or to choose on."""
    prepare()
    source = ensemble_of(work, METHODS[method][1], seed)
    config, spent, state = settings_of(method), 0.0, None
    if config.network != "planned":
        out, spent = options_of(work, method, seed)
        state = load_tensors(out / "options.safetensors")
    places = {"trained": PICKING, "new": new_layouts(FIRST)} if step == STEP else {"choosing": new_layouts(CHOOSING)}
    rows = []
    for where, seeds in places.items():
        played = TrainOptionsConfig(
            network="planned" if state is None else "distilled",
            embedding=config.embedding,
            termination=config.termination,
            environments=len(seeds),
            mask_reached=False,
        )
        loop = assemble(DOMAIN, source.path, source.config, played, seed, layouts=Layouts(tuple(seeds)))
        learner = loop.learner
        if state is not None:
            learner.load(state)
        if method == "oracle-drawn":
            assert isinstance(learner, DistilledLearner)
            learner.greedy = partial(drawn, learner, torch_generator(seed, "drawn"))  # type: ignore[method-assign]
        place = {"method": method, "seed": seed, "step": step, "layouts": where, "cpu_seconds": spent}
        rows += [place | row for row in tried_out(loop, source.config["sub_goals"])]
    return rows


def tables(path: Path) -> Iterator[str]:
    """What the cells say, as lines of Markdown."""
    within, wrong, success = (read(path, name) for name in ("within_2", "false_positives", "success"))
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
    yield "Layouts on which settings are chosen: mean over five sub-goals, one seed."
    yield ""
    keys = [(method, CHOOSE, "choosing") for method in METHODS if (method, CHOOSE, "choosing") in within]
    yield from table(
        ["options", "within 2", "any success", "CPU minutes"],
        (
            [
                METHODS[key[0]][0],
                *(interval(of_seeds(numbers, key), 3) for numbers in (within, success)),
                f"{of_seeds(spent, key).max() / 60:.1f}",
            ]
            for key in keys
        ),
    )


CONTRASTS = (  # a minus b; of four, a minus b minus (c minus d)
    ("dbat", "planned"),
    ("grid", "planned"),
    ("none", "none-planned"),
    ("one", "one-planned"),
    ("dbat", "none"),
    ("dbat", "one"),
    ("planned", "none-planned"),
    ("planned", "one-planned"),
    ("dbat", "none", "planned", "none-planned"),
)


def _differences(path: Path) -> Iterator[str]:
    """What the rules ask for, seed by seed: distilled minus planned; diversity's share in the picked member."""
    within = read(path, "within_2")
    yield "Differences over the seeds that both have."
    yield ""
    lines = []
    for methods in CONTRASTS:
        seeds = sorted(set.intersection(*(set(within[method, STEP, WHERE[1]]) for method in methods)))
        if not seeds:
            continue
        some = {
            (method, STEP, where): {seed: within[method, STEP, where][seed] for seed in seeds}
            for method in methods
            for where in WHERE
        }
        signed = [*zip((1, -1, -1, 1), methods, strict=False)]
        means = sum(sign * of_seeds(some, (method, STEP, WHERE[1])) for sign, method in signed)
        picks = sum(sign * picked(some, method, STEP) for sign, method in signed)
        name = " - ".join(METHODS[method][0] for method in methods[:2])
        name += "".join(f", minus the same of {METHODS[method][0]}" for method in methods[2:3])
        lines.append([name, difference(np.asarray(means), 3), difference(np.asarray(picks), 3), str(len(seeds))])
    yield from table(["difference", "mean member", "picked member", "seeds"], lines)


def main() -> None:
    """Run the cells that are not in the file yet."""
    parser = parser_of(__doc__, "0")
    parser.add_argument("--work", type=Path, default=Path("runs/distilled"), help="the folder of data and artefacts")
    parser.add_argument("--methods", default=",".join(PUBLISHED), help=f"of {', '.join(METHODS)}")
    parser.add_argument("--choosing", action="store_true", help="play the layouts on which settings are chosen")
    arguments = parser.parse_args()
    if printed(arguments, tables):
        return
    collect_once(DOMAIN, DoorKeyConfig(heldout_layouts=1), arguments.work / "data.h5")
    step = CHOOSE if arguments.choosing else STEP
    jobs: Jobs = {
        (method, str(seed)): partial(run_cell, arguments.work, method, seed, step)
        for seed in arguments.seeds
        for method in arguments.methods.split(",")
    }
    run_cells(arguments.csv, COLUMNS, KEYS[:2], jobs, lambda _: (step,), arguments.workers)


if __name__ == "__main__":
    main()
