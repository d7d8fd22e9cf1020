"""Spec A6: chain all stages of a named experiment. Every cell is one ordinary command with its own output."""

from __future__ import annotations

import importlib
import json
import os
import subprocess
import sys
import time
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

from hypogoal.core.config import parse_assignments, resolve
from hypogoal.core.drafts import GO_ON, sole_writer
from hypogoal.core.errors import UserError
from hypogoal.core.workers import die_with_parent
from hypogoal.domains.base import defaults_of, load_domain
from hypogoal.experiments import doorkey, montezuma_ladders
from hypogoal.experiments.cells import Cell, Plan

EXPERIMENTS: Mapping[str, Any] = {"doorkey": doorkey, "montezuma-ladders": montezuma_ladders}
CONFIGS = {
    "train-ensemble": "hypogoal.stages.train_ensemble:TrainEnsembleConfig",
    "train-options": "hypogoal.stages.train_options:TrainOptionsConfig",
    "train-meta": "hypogoal.stages.train_meta:TrainMetaConfig",
    "train-baseline": "hypogoal.stages.train_baseline:BaselineConfig",
}
STAGES = ("collect", *CONFIGS, "run")
POLL_SECONDS = 0.2
REPORT_SECONDS = 15.0


def config_class_of(stage: str, domain: str = "doorkey") -> type:
    """The settings of a stage, by its command's name; of ``run``, those of the domain's experiment.

    Raises:
        UserError: no such stage or domain, or no experiment is on that domain.
    """
    if stage == "collect":
        return load_domain(domain, given=True).config_class
    if stage == "run":
        for experiment in EXPERIMENTS.values():
            if domain == experiment.DOMAIN:
                return experiment.RunConfig
        raise UserError("no experiment is on this domain", domain, f"Experiments: {', '.join(EXPERIMENTS)}.")
    if stage not in CONFIGS:
        raise UserError("no such stage", stage, f"Choose one of {', '.join(STAGES)}.")
    module, _, name = CONFIGS[stage].partition(":")
    return getattr(importlib.import_module(module), name)


def plan(experiment: str, out: Path, *, preset: str | None = None, assignments: Iterable[str] = ()) -> Plan:
    """The cells of an experiment.

    Raises:
        UserError: unknown experiment or preset, or a setting that no stage has.
    """
    if experiment not in EXPERIMENTS:
        raise UserError("unknown experiment", experiment, f"Choose one of {', '.join(EXPERIMENTS)}.")
    found = EXPERIMENTS[experiment]
    own, by_stage = _split(assignments)
    config = resolve(found.RunConfig, stage="run", preset=preset, assignments=own, domain=found.DOMAIN)
    for stage in by_stage:
        if stage not in found.STAGES:
            raise UserError("no such stage in --set", stage, f"Choose one of {', '.join(found.STAGES)}.")
    resolved: dict[str, Any] = {
        stage: resolve(
            config_class_of(stage, found.DOMAIN),
            stage=stage,
            preset=preset,
            assignments=by_stage.get(stage, ()),
            domain=found.DOMAIN,
            defaults=defaults_of(found.DOMAIN, stage),
        )
        for stage in found.STAGES
    }
    common = {
        stage: (
            *(("--preset", preset) if preset else ()),
            *(x for pair in by_stage.get(stage, ()) for x in ("--set", pair)),
        )
        for stage in found.STAGES
    }
    return Plan(found.cells(out, config, resolved, common), config.workers or os.cpu_count() or 1)


def _split(assignments: Iterable[str]) -> tuple[list[str], dict[str, list[str]]]:
    own: list[str] = []
    by_stage: dict[str, list[str]] = {}
    for assignment in assignments:
        (key,) = parse_assignments([assignment])
        stage, dot, rest = key.partition(".")
        if dot:
            value = assignment.partition("=")[2]
            by_stage.setdefault(stage.replace("_", "-"), []).append(f"{rest}={value}")
        else:
            own.append(assignment)
    return own, by_stage


def run(planned: Plan, out: Path, *, force: bool = False, resume: bool = False, quiet: bool = False) -> None:
    """Run the cells, several at once, each with a log in ``out/logs``.

    Args:
        planned: the cells.
        out: the run's folder.
        force: make finished ones anew.
        resume: do not run finished ones again, and go on with unfinished ones where they were.
        quiet: no progress.

    Raises:
        UserError: ``out`` exists and neither ``force`` nor ``resume`` was given, another process runs it, or a cell
            failed.
    """
    if out.exists() and not (force or resume):
        raise UserError("the run exists already", out, "Give --resume to finish it, --force to make it anew.")
    with sole_writer(out):
        try:
            _run(planned, out, force=force, resume=resume, quiet=quiet)
        except KeyboardInterrupt as error:
            error.add_note(f"what is done is kept: {GO_ON}")
            raise


def _run(planned: Plan, out: Path, *, force: bool, resume: bool, quiet: bool) -> None:
    logs = out / "logs"
    logs.mkdir(parents=True, exist_ok=True)
    cells, workers = planned.cells, planned.workers
    waiting = [cell for cell in cells if not (resume and cell.complete())]
    made = {cell.out for cell in cells if cell not in waiting}
    _say(planned.cost(waiting), quiet)
    running: dict[Cell, tuple[subprocess.Popen[bytes], float]] = {}
    begun = told = time.monotonic()
    total = len(cells)
    try:
        while waiting or running:
            for cell in [cell for cell in waiting if len(running) < workers and made.issuperset(cell.needs)]:
                if len(running) >= workers:
                    break
                waiting.remove(cell)
                running[cell] = (_start(cell, logs, force=force, resume=resume), time.monotonic())
                _say(f"[{len(made)}/{total}] {cell.name} ...", quiet)
            time.sleep(POLL_SECONDS)
            for cell, (process, since) in list(running.items()):
                code = process.poll()
                if code is None:
                    continue
                del running[cell]
                if code:
                    raise UserError(_failure(cell, logs), logs / f"{cell.name}.log", "Mend it, then run with --resume.")
                made.add(cell.out)
                _say(f"[{len(made)}/{total}] {cell.name} done in {time.monotonic() - since:.0f} s", quiet)
            if time.monotonic() - told > REPORT_SECONDS and running:
                told = time.monotonic()
                for cell in running:
                    _say(f"    {cell.name}: {_last_line(logs / f'{cell.name}.log')}", quiet)
    finally:
        for process, _since in running.values():
            process.terminate()
        for process, _since in running.values():
            process.wait()
    summary = {"cells": [cell.text for cell in cells], "seconds": round(time.monotonic() - begun, 1)}
    (out / "run.json").write_text(json.dumps(summary, indent=1) + "\n", encoding="utf-8")
    _say(f"all {total} cells done in {summary['seconds']:.0f} s", quiet)


def _start(cell: Cell, logs: Path, *, force: bool, resume: bool) -> subprocess.Popen[bytes]:
    """A cell's process, which ends when this one does: another run could not go on with what it still writes."""
    again = "--force" if force or cell.out.exists() else "--resume"  # what is there and was to be made is not whole
    command = [sys.executable, "-m", "hypogoal", *cell.arguments, *((again,) if force or resume else ())]
    with (logs / f"{cell.name}.log").open("ab" if resume else "wb", buffering=0) as log:
        log.write(b"started\n")  # not to take the last words of a stopped one for those of this one
        return subprocess.Popen(
            command,
            stdout=log,
            stderr=subprocess.STDOUT,
            stdin=subprocess.DEVNULL,
            preexec_fn=die_with_parent if os.name == "posix" else None,
        )


def _failure(cell: Cell, logs: Path) -> str:
    return f"{cell.name} failed ({_last_line(logs / f'{cell.name}.log')})"


def _last_line(log: Path) -> str:
    lines = log.read_text(encoding="utf-8", errors="replace").splitlines()
    return lines[-1] if lines else "started"


def _say(text: str, quiet: bool) -> None:
    if not quiet:
        print(text, file=sys.stderr, flush=True)
