"""Spec A6: chain all stages of a named experiment. Every cell is one ordinary command with its own output."""

from __future__ import annotations

import importlib
import json
import os
import shlex
import subprocess
import sys
import time
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from hypogoal.core.artefacts import MANIFEST
from hypogoal.core.config import parse_assignments, resolve, setting
from hypogoal.core.errors import UserError
from hypogoal.domains.base import load_domain

EXPERIMENTS = ("doorkey",)
CONFIGS = {
    "train-ensemble": "hypogoal.stages.train_ensemble:TrainEnsembleConfig",
    "train-options": "hypogoal.stages.train_options:TrainOptionsConfig",
    "train-meta": "hypogoal.stages.train_meta:TrainMetaConfig",
    "train-baseline": "hypogoal.stages.train_baseline:BaselineConfig",
    "run": "hypogoal.stages.run:RunConfig",
}
POLL_SECONDS = 0.2
REPORT_SECONDS = 15.0


@dataclass(frozen=True)
class RunConfig:
    """Which cells an experiment has."""

    layout_seeds: tuple[int, ...] = setting((100,), "layouts, each with an agent of its own", source="Spec E4", low=0)
    seeds: tuple[int, ...] = setting((0,), "run seeds, each with an ensemble of its own", low=0)
    pretrain: bool = setting(True, "train-options before train-meta; false is the paper's D5")
    controls: tuple[str, ...] = setting(
        ("random", "oracle"), "controls beside the agent", source="Spec E6", choices=("random", "oracle")
    )
    baselines: tuple[str, ...] = setting(
        ("ppo-paper", "ppo-tuned", "dqn-paper", "dqn-tuned"),
        "agents on the primitive actions",
        source="Spec E7",
        choices=("ppo-paper", "ppo-tuned", "dqn-paper", "dqn-tuned"),
    )
    workers: int = setting(0, "cells at once; 0 for one per core", low=0, high=1024)


@dataclass(frozen=True)
class Cell:
    """One command of an experiment.

    Attributes:
        name: for messages and its log.
        arguments: of ``hypogoal``, without ``--force``.
        out: what it writes.
        needs: outputs of other cells that must be complete first.
    """

    name: str
    arguments: tuple[str, ...]
    out: Path
    needs: tuple[Path, ...]

    @property
    def text(self) -> str:
        """The command as one would type it."""
        return shlex.join(("hypogoal", *self.arguments))

    def complete(self) -> bool:
        """Whether its output is there; what has a manifest, and a data file under its name, is whole."""
        return (self.out / MANIFEST).is_file() if self.out.suffix != ".h5" else self.out.is_file()


def config_class_of(stage: str, domain: str = "doorkey") -> type:
    """The settings of a stage, by its command's name."""
    if stage == "collect":
        return load_domain(domain).config_class
    if stage not in CONFIGS:
        raise UserError("no such stage", stage, f"Choose one of collect, {', '.join(CONFIGS)}.")
    module, _, name = CONFIGS[stage].partition(":")
    return getattr(importlib.import_module(module), name)


@dataclass(frozen=True)
class Plan:
    """An experiment's cells, in an order in which they can run, and how many run at once."""

    cells: list[Cell]
    workers: int


def plan(experiment: str, out: Path, *, preset: str | None = None, assignments: Iterable[str] = ()) -> Plan:
    """The cells of an experiment.

    Raises:
        UserError: unknown experiment or preset, or a setting that no stage has.
    """
    if experiment not in EXPERIMENTS:
        raise UserError("unknown experiment", experiment, f"Choose one of {', '.join(EXPERIMENTS)}.")
    own, by_stage = _split(assignments)
    config: RunConfig = resolve(RunConfig, stage="run", preset=preset, assignments=own)
    stages = ("collect", *(stage for stage in CONFIGS if stage != "run"))
    for stage in by_stage:
        if stage not in stages:
            raise UserError("no such stage in --set", stage, f"Choose one of {', '.join(stages)}.")
    resolved: dict[str, Any] = {
        stage: resolve(
            config_class_of(stage, experiment),
            stage=stage,
            preset=preset,
            assignments=by_stage.get(stage, ()),
        )
        for stage in stages
    }
    common = {
        stage: (
            *(("--preset", preset) if preset else ()),
            *(x for pair in by_stage.get(stage, ()) for x in ("--set", pair)),
        )
        for stage in stages
    }
    return Plan(_cells(experiment, out, config, resolved, common), config.workers or os.cpu_count() or 1)


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


def _cells(
    experiment: str,
    out: Path,
    config: RunConfig,
    resolved: dict[str, Any],
    common: dict[str, tuple[str, ...]],
) -> list[Cell]:
    single = len(config.layout_seeds) * len(config.seeds) == 1
    data = out / "data.h5"
    cells = [_cell("collect", (experiment, *common["collect"]), data)]
    spent = resolved["train-options"].steps if config.pretrain else 0
    budget = str(spent + resolved["train-meta"].steps)
    agents: list[Path] = []

    def add(
        name: str,
        stage: str,
        arguments: Sequence[str],
        seed: int,
        layout: int | None,
        needs: tuple[Path, ...],
    ) -> Path:
        place = name if single else f"{name}/seed-{seed}" if layout is None else f"{name}/layout-{layout}-seed-{seed}"
        at = ("--seed", str(seed), *(("--layout-seed", str(layout)) if layout is not None else ()))
        cells.append(_cell(stage, (*arguments, *common[stage], *at), out / place, needs))
        return out / place

    ensembles = {seed: add("ensemble", "train-ensemble", (str(data),), seed, None, (data,)) for seed in config.seeds}
    cases = [(layout, seed) for layout in config.layout_seeds for seed in config.seeds]
    for layout, seed in cases:
        source = ensembles[seed]
        extra: tuple[str, ...] = ()
        needs: tuple[Path, ...] = (source,)
        if config.pretrain:
            options = add("options", "train-options", (str(source),), seed, layout, (source,))
            extra, needs = ("--options", str(options)), (source, options)
        agents.append(add("meta", "train-meta", (str(source), *extra), seed, layout, needs))
    for control in config.controls:
        change = "chooser=random" if control == "random" else "termination=oracle"
        for layout, seed in cases:
            arguments = (str(ensembles[seed]), "--set", change, "--set", f"steps={budget}")
            agents.append(add(f"meta-{control}", "train-meta", arguments, seed, layout, (ensembles[seed],)))
    for baseline in config.baselines:
        agent, _, kind = baseline.partition("-")
        for layout, seed in cases:
            options_of = (experiment, "--agent", agent, "--set", f"setting={kind}", "--set", f"steps={budget}")
            agents.append(add(baseline, "train-baseline", options_of, seed, layout, ()))
    evaluation = out / "evaluation"
    everything = (*ensembles.values(), *agents)
    cells.append(Cell("evaluate", ("evaluate", str(out), "--out", str(evaluation)), evaluation, everything))
    cells.append(Cell("report", ("report", str(out)), out / "report", (evaluation,)))
    return cells


def _cell(stage: str, arguments: Sequence[str], out: Path, needs: tuple[Path, ...] = ()) -> Cell:
    name = stage if stage == "collect" else f"{out.parent.name}-{out.name}" if "seed-" in out.name else out.name
    return Cell(name, (stage, *arguments, "--out", str(out)), out, needs)


def run(planned: Plan, out: Path, *, force: bool = False, resume: bool = False, quiet: bool = False) -> None:
    """Run the cells, several at once, each with a log in ``out/logs``; finished ones are not run again.

    Raises:
        UserError: ``out`` exists and neither ``force`` nor ``resume`` was given, or a cell failed.
    """
    if out.exists() and not (force or resume):
        raise UserError("the run exists already", out, "Give --resume to finish it, --force to make it anew.")
    logs = out / "logs"
    logs.mkdir(parents=True, exist_ok=True)
    cells, workers = planned.cells, planned.workers
    waiting = [cell for cell in cells if not (resume and cell.complete())]
    made = {cell.out for cell in cells if cell not in waiting}
    running: dict[Cell, tuple[subprocess.Popen[bytes], float]] = {}
    begun = told = time.monotonic()
    total = len(cells)
    try:
        while waiting or running:
            for cell in [cell for cell in waiting if len(running) < workers and made.issuperset(cell.needs)]:
                if len(running) >= workers:
                    break
                waiting.remove(cell)
                running[cell] = (_start(cell, logs, force or resume), time.monotonic())
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


def _start(cell: Cell, logs: Path, force: bool) -> subprocess.Popen[bytes]:
    command = [
        sys.executable,
        "-m",
        "hypogoal",
        *cell.arguments,
        *(("--force",) if force and cell.out.exists() else ()),
    ]
    with (logs / f"{cell.name}.log").open("wb") as log:
        return subprocess.Popen(command, stdout=log, stderr=subprocess.STDOUT, stdin=subprocess.DEVNULL)


def _failure(cell: Cell, logs: Path) -> str:
    return f"{cell.name} failed ({_last_line(logs / f'{cell.name}.log')})"


def _last_line(log: Path) -> str:
    lines = log.read_text(encoding="utf-8", errors="replace").splitlines()
    return lines[-1] if lines else "started"


def _say(text: str, quiet: bool) -> None:
    if not quiet:
        print(text, file=sys.stderr, flush=True)
