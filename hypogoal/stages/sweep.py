"""Spec A6, G4: an experiment's cells, run here or by Slurm. Every cell is one ordinary command with its own output.

``hypogoal run`` is the sweep of a named experiment on this machine.
"""

import contextlib
import json
from collections.abc import Callable, Iterable, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

from hypogoal.core.artefacts import check_parent
from hypogoal.core.compute import check_name
from hypogoal.core.drafts import GO_ON, sole_writer, sweep_up
from hypogoal.core.errors import UserError
from hypogoal.core.files import replace_text
from hypogoal.core.terminal import say
from hypogoal.core.workers import cores
from hypogoal.domains.base import load_domain
from hypogoal.experiments import records
from hypogoal.experiments.cells import DERIVED, Cell, Plan
from hypogoal.experiments.costs import LONG_SECONDS, cost_lines, machine_factor, wall_seconds
from hypogoal.experiments.experiment import Experiment, load_experiment
from hypogoal.experiments.named import CELLS, EXPERIMENTS, FIGURES, NAMES
from hypogoal.experiments.planning import make_plan
from hypogoal.experiments.runners import slurm
from hypogoal.experiments.runners.local import run_cells
from hypogoal.experiments.status import done_of, left_of, stamp_of
from hypogoal.experiments.toml_file import read_toml
from hypogoal.settings import CONFIGS, TABLES

AGAIN = "give the same command again to go on"
_say = partial(say, err=True)


def config_class_of(stage: str, domain: str = "doorkey") -> type:
    """The settings of a stage, by its command's name; of ``run``, the domain's experiment's. Else a ``UserError``."""
    if stage == "collect":
        return load_domain(domain, given=True).config_class
    if stage == "run":
        for name, experiment in EXPERIMENTS.items():
            if domain == experiment.domain and name not in CELLS.values():
                return experiment.config_class
        raise UserError("no experiment uses this domain", domain, f"Experiments: {', '.join(EXPERIMENTS)}.")
    if stage not in CONFIGS:
        raise UserError("no such stage", stage, f"Choose one of {', '.join(TABLES)}.")
    return CONFIGS[stage]


def plan(
    experiment: str,
    out: Path,
    *,
    preset: str | None = None,
    assignments: Iterable[str] = (),
    seeds: str | None = None,
    device: str = "auto",
    short: bool = False,
) -> Plan:
    """The cells of an experiment in the folder ``out``.

    It is named, one of the paper's figures, a TOML file, or ``module:function``, a name that the user must have given.
    ``assignments`` are ``KEY=VALUE`` or ``STAGE.KEY=VALUE``, of a TOML file ``AXIS=VALUES``; ``preset`` is of a named
    one, a figure has its own; ``seeds`` are the run seeds, ``0-9``; ``device`` is of the training stages. ``short``:
    leave seed and layout out of names if there is a single agent; a folder that was begun with other names keeps those.
    What is unknown is a ``UserError``.
    """
    check_name(device)
    assignments = [*assignments]
    experiment = CELLS.get((experiment, preset or ""), experiment)
    name, own_preset = FIGURES.get(experiment, (experiment, None))
    if own_preset not in (None, preset or own_preset):
        raise UserError(f"{experiment} has its own preset", preset, f"For another, give {name} with --preset.")
    source = _experiment(name)
    if seeds:
        assignments.insert(0, f"{'seeds' if 'seeds' in source.settings else 'seed'}={seeds}")  # before --set's own
    short = _has_short_names(out, otherwise=short)
    return make_plan(source, out, assignments, preset=preset or own_preset, device=device, short=short)


def _experiment(name: str) -> Experiment:
    if name in EXPERIMENTS:
        return EXPERIMENTS[name]
    if name.endswith(".toml"):
        return read_toml(Path(name))
    if ":" in name:
        return load_experiment(name)
    do = f"Choose one of {', '.join(NAMES)}, or give a .toml file or module:function."
    raise UserError("unknown experiment", name, do)


def _has_short_names(out: Path, *, otherwise: bool) -> bool:
    """Whether the cells of the run in this folder have short names; ``otherwise`` if there is none."""
    try:
        before, _ = records.read_plan(out)
    except UserError:  # none, or a damaged one: refused when the run is to be continued
        return otherwise
    return out / "ensemble" in {cell.out for cell in before.cells}


def run(planned: Plan, out: Path, *, force: bool = False, resume: bool = False, quiet: bool = False) -> None:
    """Spec A6: :func:`sweep`, but what is there is refused (``UserError``) unless resumed or forced."""
    if out.exists() and not (force or resume):
        raise UserError("the run exists already", out, "Give --resume to finish it, --force to make it anew.")
    sweep(planned, out, force=force and not (resume and _begun(out, planned)), quiet=quiet, go_on=GO_ON)


def _begun(out: Path, planned: Plan) -> bool:
    """Whether these cells were begun and are not all done: what ``--force --resume`` goes on with."""
    try:
        before, _ = records.read_plan(out)
        records.check_same(out, planned.cells)
    except records.LostPlan:
        raise
    except UserError:
        return False
    return len(done_of(replace(planned, anew=before.anew))) < len(planned.cells)


def sweep(
    planned: Plan,
    out: Path,
    *,
    force: bool = False,
    quiet: bool = False,
    confirm: Callable[[str], None] | None = None,
    go_on: str = AGAIN,
) -> Path:
    """Run on this machine what is not finished, and gather every number; returns ``results.csv``.

    It may be killed at any time and started again: what is finished is recognised and never run again, what was begun
    goes on where it was. ``force``: make finished ones anew. ``confirm`` is asked before something long begins; it
    raises where the answer is no. A user who interrupts it is told to ``go_on``. Another process that runs it, another
    sweep's folder, or a cell that failed is a ``UserError``.
    """
    say = (lambda text: None) if quiet else _say
    _check_folder(out)
    with sole_writer(out):
        planned = _begin(planned, out, force=force, say=say, confirm=confirm)
        try:
            outcome = run_cells(planned, out, say=say)
        except KeyboardInterrupt as error:
            error.add_note(f"what is done is kept: {go_on}")
            raise
        with contextlib.suppress(*([UserError] if outcome.failed else [])):  # which is told below
            gather(out)
    if outcome.failed:
        name, why = next(iter(outcome.failed.items()))
        rest = f", {len(outcome.waiting)} wait for them" if outcome.waiting else ""
        what = f"{len(outcome.failed)} of {len(planned.cells)} cells failed{rest}; the first is {name}: {why}"
        raise UserError(what, None, "Fix it, then start again: what is done is kept.")
    say(f"all {len(planned.cells)} cells done")
    return out / records.RESULTS


def submit(
    planned: Plan,
    out: Path,
    options: slurm.Options,
    *,
    quiet: bool = False,
    confirm: Callable[[str], None] | None = None,
) -> list[dict[str, Any]]:
    """Have Slurm run what is not finished; arguments and errors as of :func:`sweep`, returns the jobs."""
    at_once = options.cap or len(planned.cells) or 1  # at the most: who else is in the queue is not known
    planned = replace(planned, workers=at_once)
    slurm.check(out, options)
    _check_folder(out)
    with sole_writer(out):
        planned = _begin(planned, out, force=False, say=(lambda text: None) if quiet else _say, confirm=confirm)
        if planned.anew:
            what = f"{len(planned.anew)} cells are still to be made again, as 'run --force' began to"
            raise UserError(what, out, records.GIVE)
        todo = left_of(planned.cells)
        return slurm.submit(planned, out, todo, options) if todo else []


def _check_folder(out: Path) -> None:
    if out.exists() and not out.is_dir():
        raise UserError("a run needs a folder, this is a file", out, "Choose another --out.")
    check_parent(out)


def _begin(
    planned: Plan, out: Path, *, force: bool, say: Callable[[str], None], confirm: Callable[[str], None] | None
) -> Plan:
    """Before the first cell: is this the sweep of this folder, what will it cost, is that wanted; the plan as written.

    What is to be made again is so until it is, however often the sweep is started. What is there though no plan has it
    is held against its command: it lay there before, or the plan was lost.
    """
    if alive := slurm.queued(out):
        raise UserError(f"this sweep is in Slurm's queue (job {alive[0]})", out, "End it with --cancel first.")
    anew = frozenset(cell.name for cell in planned.cells) if force else frozenset()
    unsure = [] if force else [cell for cell in planned.cells if cell.stage not in DERIVED and stamp_of(cell)]
    lost = "the sweep's plan is gone" if (out / records.LOGS).is_dir() and not (out / records.PLAN).exists() else ""
    if not force and (out / records.PLAN).is_file():
        try:
            records.check_same(out, planned.cells)
            before = records.read_plan(out)[0]
            anew, known = before.anew, {cell.name for cell in before.cells}
            unsure = [cell for cell in unsure if cell.name not in known]
        except records.LostPlan as error:
            lost = error.what
    planned = replace(planned, anew=anew, presets=records.preset_digests(planned.cells))
    done = done_of(planned)
    todo = [cell for cell in planned.cells if cell.out not in done]
    factor = machine_factor() if todo else 1.0
    if len(todo) < len(planned.cells):
        say(f"{len(planned.cells) - len(todo)} of {len(planned.cells)} cells are done")
    told = cost_lines(todo, planned.workers, factor) if todo else []
    for line in told:
        say(line)
    if confirm is not None and wall_seconds(todo, planned.workers, factor) > LONG_SECONDS:
        confirm(told[-1])
    (out / records.LOGS).mkdir(parents=True, exist_ok=True)
    for folder in (out, out / records.LOGS):
        sweep_up(folder)
    if lost and unsure:  # said to who asked for quiet, too
        _say(f"{lost}, and is written anew: what is complete is kept where its command makes it")
        if old := [cell.name for cell in unsure if records.read_record(out, cell).code != 0]:
            _say(f"kept, though 'run --force' may have been about to make them again: {', '.join(old)}")
    _check(unsure, planned, out, say)
    if force:
        for cell in planned.cells:  # before the plan: what an attempt of now began is known by its record
            (out / records.LOGS / f"{cell.name}.json").unlink(missing_ok=True)
    if todo:
        records.excuse(out, todo)
        (out / records.FINISHED).unlink(missing_ok=True)
    records.write_plan(out, planned, factor)
    return planned


def _check(cells: Sequence[Cell], planned: Plan, out: Path, say: Callable[[str], None]) -> None:
    """Refuse (``UserError``) what is there and not, as each cell's stage says, what its command makes."""
    alone = [replace(cell, needs=()) for cell in cells]
    outcome = run_cells(replace(planned, cells=alone, anew=frozenset(), workers=cores()), out, say=say, check=True)
    for name, why in outcome.failed.items():
        do = "Move it out of the run to have it made, or choose another --out."
        raise UserError(f"what is there is not what the command of {name} makes: {why}", None, do)


def gather(out: Path) -> Path:
    """Write ``results.csv`` of what is done, which it returns, and where that is all, ``run.json``; or UserError."""
    from hypogoal.experiments.results import write_results  # with SciPy, which a plan needs not

    planned, _ = records.read_plan(out)
    results = write_results(planned, out)
    if len(done_of(planned)) == len(planned.cells):
        seconds = sum(records.read_record(out, cell).seconds for cell in planned.cells)
        about = {"cells": [cell.text for cell in planned.cells], "seconds": round(seconds, 1)}
        replace_text(out / records.FINISHED, json.dumps(about, indent=1) + "\n")
    return results
