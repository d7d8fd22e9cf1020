"""Spec A6, G4: run an experiment's cells here or by Slurm. Every cell is one ordinary command with its own output.

``hypogoal run`` is the sweep of a named experiment on this machine.
"""

import contextlib
import json
from collections.abc import Callable, Iterable, Iterator, Sequence, Set
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

from hypogoal.core.artefacts import check_parent
from hypogoal.core.compute import check_name
from hypogoal.core.drafts import GO_ON, sole_writer, sweep_up
from hypogoal.core.errors import UserError
from hypogoal.core.files import replace_text
from hypogoal.core.terminal import amount, say
from hypogoal.core.workers import cores
from hypogoal.domains.base import load_domain
from hypogoal.experiments import records
from hypogoal.experiments.cells import DERIVED, Cell, Plan
from hypogoal.experiments.experiment import Experiment, load_experiment
from hypogoal.experiments.named import CELLS, EXPERIMENTS, FIGURES, NAMES
from hypogoal.experiments.planning import make_plan
from hypogoal.experiments.runners import slurm
from hypogoal.experiments.runners.local import run_cells
from hypogoal.experiments.status import done_of, is_finished, stamp_of, to_remake
from hypogoal.experiments.toml_file import read_toml
from hypogoal.settings import CONFIGS, TABLES

AGAIN = "give the same command again to go on"


def config_class_of(stage: str, domain: str = "doorkey") -> type:
    """The settings of a stage, by its command's name; of ``run``, the domain's experiment's. Else a ``UserError``."""
    if stage == "collect":
        return load_domain(domain).config_class
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
    one, of a figure its own or ``paper``; ``seeds`` are the run seeds, ``0-9``; ``device`` is of the training stages.
    ``short``: leave seed and layout out of names if there is a single agent; a folder that was begun with other names
    keeps those. What is unknown is a ``UserError``.
    """
    check_name(device)
    assignments = [*assignments]
    experiment = CELLS.get((experiment, preset or ""), experiment)
    figure = FIGURES.get(experiment)
    name = figure.experiment if figure else experiment
    if figure and preset == "paper" and figure.paper is not None:
        assignments[:0] = figure.paper
    elif figure and preset in (None, figure.preset):
        preset = figure.preset
    elif figure:
        others = "" if figure.paper is None else f" or paper, or {name} with --preset"
        raise UserError(f"{experiment} has a preset of its own", preset, f"Give {figure.preset}{others}.")
    source = _experiment(name)
    if seeds:
        assignments.insert(0, f"{'seeds' if 'seeds' in source.settings else 'seed'}={seeds}")  # before --set's own
    short = _has_short_names(out, otherwise=short)
    return make_plan(source, out, assignments, preset=preset, device=device, short=short)


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
        return out / "ensemble" in {cell.out for cell in records.read_plan(out).cells}
    except UserError:  # none, or a damaged one: refused when the run is to be continued
        return otherwise


def run(
    planned: Plan,
    out: Path,
    *,
    force: bool = False,
    resume: bool = False,
    quiet: bool = False,
    only: Set[str] = frozenset(),
) -> None:
    """Spec A6: :func:`sweep`, but an existing run is refused (``UserError``) unless resumed, forced or made in part."""
    if out.exists() and not (force or resume or planned.anew):
        do = "Give --resume to finish it, --from STAGE to make a part anew, --force to make all anew."
        raise UserError("the run exists already", out, do)
    if resume and (force or planned.anew) and _is_begun(out, planned, only):
        planned, force = replace(planned, anew=frozenset()), False
    sweep(planned, out, force=force and not planned.anew, quiet=quiet, go_on=GO_ON, only=only)


def _is_begun(out: Path, planned: Plan, only: Set[str]) -> bool:
    """Whether what is to be made anew was begun and is not done: then ``--resume`` continues, whatever else is given.

    Without ``--from`` and ``--only`` all cells are meant.
    """
    try:
        before = records.read_plan(out)
        records.check_same(out, planned.cells)
    except records.LostPlan:
        raise
    except UserError:
        return False
    if planned.anew:
        return any(to_remake(before, out, cell) for cell in before.cells if cell.name in (only or planned.anew))
    return len(done_of(replace(planned, anew=before.anew), out)) < len(planned.cells)


def to_run(planned: Plan, out: Path, only: Set[str] = frozenset()) -> list[Cell]:
    """The cells that :func:`sweep` would run now; another sweep's folder is a ``UserError``."""
    before, _ = _before(planned, out)
    done = done_of(replace(planned, anew=planned.anew | before.anew), out)
    todo = [cell for cell in planned.cells if cell.name in planned.anew or cell.out not in done]
    chosen = [cell for cell in todo if not only or cell.name in only]
    for cell in chosen if only else ():
        if missing := {*cell.needs} - done - {other.out for other in chosen}:
            raise UserError(f"{cell.name} needs what is not made yet", min(missing), "Leave out --only to make it.")
    return chosen


def sweep(
    planned: Plan,
    out: Path,
    *,
    force: bool = False,
    quiet: bool = False,
    go_on: str = AGAIN,
    only: Set[str] = frozenset(),
) -> Path:
    """Run unfinished cells on this machine and gather all numbers; returns ``results.csv``.

    It may be killed and started again at any time: finished cells are recognised and never run again, others continue
    at their checkpoints. ``force``: make finished ones anew; without it those that the plan names. ``only``: run none
    but these. A user who interrupts
    the sweep reads ``go_on``. Another process that runs it, another sweep's folder, or a cell that failed is a
    ``UserError``.
    """
    say = _speaker(quiet)
    with _begun(planned, out, force, say, only) as (planned, todo):
        try:
            outcome = run_cells(_alone(planned, todo) if only else planned, out, say=say)
        except KeyboardInterrupt as error:
            error.add_note(f"what is done is kept: {go_on}")
            raise
        with contextlib.suppress(*([UserError] if outcome.failed else [])):  # the failed cell is reported below
            gather(out)
    if outcome.failed:
        name, reason = next(iter(outcome.failed.items()))
        rest = f", {len(outcome.waiting)} wait for them" if outcome.waiting else ""
        problem = (
            f"{len(outcome.failed)} of {amount(len(planned.cells), 'cell')} failed{rest}; the first is {name}: {reason}"
        )
        raise UserError(problem, None, f"Fix it, then {go_on}: what is done is kept.")
    if only and (left := len(planned.cells) - len(done_of(planned, out))):
        say(f"{amount(len(todo), 'cell')} made anew; {left} out of date, which are made without --only")
    else:
        say(f"{amount(len(planned.cells), 'cell')} done")
    return out / records.RESULTS


def submit(
    planned: Plan,
    out: Path,
    options: slurm.Options,
    *,
    quiet: bool = False,
    only: Set[str] = frozenset(),
) -> list[dict[str, Any]]:
    """Submit unfinished cells to Slurm; arguments and errors as of :func:`sweep`, returns the jobs."""
    slurm.check(out, options)
    at_once = options.cap or len(planned.cells)  # an upper bound: who else is in the queue is not known
    with _begun(replace(planned, workers=at_once), out, False, _speaker(quiet), only) as (planned, todo):
        if not only:
            done = done_of(planned, out)
            todo = [cell for cell in planned.cells if cell.out not in done or not is_finished(cell)]
        return slurm.submit(planned, out, todo, options) if todo else []


def _speaker(quiet: bool) -> Callable[[str], None]:
    return (lambda text: None) if quiet else partial(say, err=True)


def _alone(planned: Plan, cells: Sequence[Cell]) -> Plan:
    """These cells, which wait for none but each other."""
    outs = {cell.out for cell in cells}
    alone = [replace(cell, needs=tuple(need for need in cell.needs if need in outs)) for cell in cells]
    return replace(planned, cells=alone)


@contextlib.contextmanager
def _begun(
    planned: Plan,
    out: Path,
    force: bool,
    say: Callable[[str], None],
    only: Set[str],
) -> Iterator[tuple[Plan, list[Cell]]]:
    """Before the first cell: check the folder and write the plan; returns it and the cells to run."""
    if out.exists() and not out.is_dir():
        raise UserError("a run needs a folder, this is a file", out, "Choose another --out.")
    check_parent(out)
    with sole_writer(out):
        if alive := slurm.queued(out):
            raise UserError(f"this sweep is in Slurm's queue (job {alive[0]})", out, "End it with --cancel first.")
        unplanned, lost = [], ""
        if force:
            planned = replace(planned, anew=frozenset(cell.name for cell in planned.cells))
            anew, todo = planned.anew, planned.cells
        else:
            before, lost = _before(planned, out)
            anew, todo = planned.anew, to_run(planned, out, only)
            names = {cell.name for cell in before.cells} | anew
            unplanned = [cell for cell in planned.cells if cell.name not in names and stamp_of(cell)]
            planned = replace(planned, anew=before.anew | anew)
        if not only and len(todo) < len(planned.cells):
            say(f"{len(planned.cells) - len(todo)} of {len(planned.cells)} cells are done")
        (out / records.LOGS).mkdir(parents=True, exist_ok=True)
        for folder in (out, out / records.LOGS):
            sweep_up(folder)
        _check_unplanned([cell for cell in unplanned if cell.stage not in DERIVED], lost, planned, out, say)
        # Before the plan is written: from now on a record means an attempt of this start.
        for cell in (cell for cell in planned.cells if cell in todo or cell.name in anew):
            record = records.read_record(out, cell)
            if cell.name in anew:
                (out / records.LOGS / f"{cell.name}.json").unlink(missing_ok=True)
            elif record.code:  # it is tried again
                records.write_record(out, cell, replace(record, code=None))
            (out / records.FINISHED).unlink(missing_ok=True)
        records.write_plan(out, planned)
        yield planned, todo


def _before(planned: Plan, out: Path) -> tuple[Plan, str]:
    """The folder's plan, an empty one if there is none, and how it was lost; another sweep's is a ``UserError``."""
    empty = replace(planned, cells=[])
    if not (out / records.PLAN).exists():
        return empty, "the sweep's plan is gone" if (out / records.LOGS).is_dir() else ""
    try:
        records.check_same(out, planned.cells, planned.anew)
        return records.read_plan(out), ""
    except records.LostPlan as error:
        return empty, error.what


def _check_unplanned(unplanned: list[Cell], lost: str, planned: Plan, out: Path, say: Callable[[str], None]) -> None:
    """Refuse (``UserError``) complete outputs in no plan that, as their stages say, their commands would not make.

    They are older than the sweep, or the plan was ``lost``.
    """
    if lost and unplanned:  # said even with --quiet
        warn = _speaker(quiet=False)
        warn(f"{lost}, and is written anew: what is complete is kept where its command makes it")
        if old := [cell.name for cell in unplanned if records.read_record(out, cell).code != 0]:
            warn(f"kept, though 'run --force' may have been about to make them again: {', '.join(old)}")
    alone = replace(planned, cells=[replace(cell, needs=()) for cell in unplanned], workers=cores())
    for name, reason in run_cells(alone, out, say=say, check=True).failed.items():
        do = "Move it out of the run to have it made, or choose another --out."
        raise UserError(f"what is there is not what the command of {name} makes: {reason}", None, do)


def gather(out: Path) -> Path:
    """Write ``results.csv`` of the cells done and, if all are, ``run.json``; returns the former."""
    from hypogoal.experiments.results import write_results  # loads SciPy, which a plan does without

    planned = records.read_plan(out)
    results = write_results(planned, out)
    if len(done_of(planned, out)) == len(planned.cells):
        seconds = sum(records.read_record(out, cell).seconds for cell in planned.cells)
        summary = {"cells": [cell.text for cell in planned.cells], "seconds": round(seconds, 1)}
        replace_text(out / records.FINISHED, json.dumps(summary, indent=1) + "\n")
        if planned.anew:  # all are made again
            records.write_plan(out, replace(planned, anew=frozenset()))
    return results
