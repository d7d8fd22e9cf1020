"""Own experiments: a TOML file that says which commands there are, over which axes (Spec G4; docs/formats.md).

The file is data. Its commands are stages of hypogoal and nothing else, and write into the sweep's folder only.
"""

from __future__ import annotations

import contextlib
import re
import shlex
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import product
from math import prod
from pathlib import Path
from typing import Any

from hypogoal.core.config import MAX_PRESET_BYTES, STAGES, parse_assignments, parse_integers
from hypogoal.core.errors import UserError
from hypogoal.core.files import parse_toml, path_part, plain_name, read_text
from hypogoal.core.workers import cores
from hypogoal.domains.base import load_domain
from hypogoal.experiments.cells import Cell, Cost, Plan, closing_cells, stage_cell
from hypogoal.experiments.results import COLUMNS

FORMAT_VERSION = 1
KEYS = {"format": int, "evaluate": bool, "workers": int, "axes": dict, "cells": list}
CELL_KEYS = {"name": str, "command": str, "axes": list, "minutes": (int, float), "memory_gb": (int, float)}
RESERVED = ("--out", "--force", "--resume")
TAKEN = ("run", "workers", "evaluate", "cell", "stage", "group", *COLUMNS)  # axes become columns
TAKEN_NAMES = ("evaluation", "report", "logs", "slurm")  # what else is in a run's folder
MAX_CELLS = 20_000
MOST = 1e7  # minutes, gigabytes
MEMORY = 1e9  # bytes of a process, where the file does not say
MEND = "Mend the file, see docs/formats.md."

Value = str | int | float


@dataclass(frozen=True)
class _Group:
    """The cells of one table: a command for each combination of its axes' values."""

    name: str
    words: tuple[str, ...]
    axes: tuple[str, ...]
    minutes: float
    memory: float
    cores: int


def own_plan(path: Path, out: Path, assignments: Sequence[str] = ()) -> Plan:
    """The cells of an experiment in a TOML file.

    Args:
        path: the file.
        out: the run's folder.
        assignments: ``AXIS=VALUES``, with commas between, in place of the file's; ``workers=N``, ``evaluate=false``.

    Raises:
        UserError: not such a file, or it asks for what cannot be.
    """
    table = _read(path)
    axes = {name: _values(name, values, path) for name, values in table.get("axes", {}).items()}
    evaluate, workers = table.get("evaluate", True), table.get("workers", 0)
    for key, text in parse_assignments(assignments).items():
        if key in axes:
            axes[key] = _given(axes[key], key, text)
        elif key == "workers" and text.isdigit():
            workers = int(text)
        elif key == "evaluate" and text in ("true", "false"):
            evaluate = text == "true"
        else:
            known = ", ".join([*axes, "workers", "evaluate"])
            raise UserError("no such axis or setting in this experiment", f"{key}={text}", f"It has {known}.")
    groups: dict[str, _Group] = {}
    planned: list[Cell] = []
    for row in table.get("cells", []):
        group = _group(row, axes, groups, path)
        groups[group.name] = group
        if len(planned) + prod(len(axes[axis]) for axis in group.axes) > MAX_CELLS:
            raise UserError(f"more than {MAX_CELLS} cells", path, "Take fewer values.")
        for values in product(*(axes[axis] for axis in group.axes)):
            planned.append(_cell(group, dict(zip(group.axes, values, strict=True)), groups, out))
    names = [cell.name for cell in planned]
    if len({*names, "evaluate", "report"}) != len(names) + 2:
        twice = next(name for name in (*names, "evaluate", "report") if [*names, "evaluate", "report"].count(name) > 1)
        raise UserError("two cells would have the same name", twice, MEND)
    if not planned:
        raise UserError("no cells in this experiment", path, MEND)
    if evaluate:
        planned += closing_cells(out, [cell.out for cell in planned])
    return Plan(path.stem, planned, workers or cores())


def _read(path: Path) -> dict[str, Any]:
    text = read_text(path, "the experiment is", "Give a .toml file.", MAX_PRESET_BYTES)
    table = parse_toml(text, path, "the experiment is", MEND)
    _check_keys(table, KEYS, path)
    if table.get("format") != FORMAT_VERSION:
        raise UserError(f"format must be {FORMAT_VERSION}", path, MEND)
    return table


def _check_keys(table: Mapping[str, Any], kinds: Mapping[str, Any], path: Path) -> None:
    for key, value in table.items():
        if key not in kinds:
            raise UserError("no such key in an experiment", key, f"{path} may have {', '.join(kinds)}.")
        if not isinstance(value, kinds[key]) or (isinstance(value, bool) and kinds[key] is not bool):
            raise UserError("wrong kind of value in an experiment", f"{key} in {path}", MEND)


def _values(name: str, values: Any, path: Path) -> tuple[Value, ...]:
    """An axis: its values make names of folders, so they must be fit for that."""
    if not name.isidentifier() or name in TAKEN:
        raise UserError("an axis cannot be called this", repr(name), MEND)
    if isinstance(values, str):
        values = list(parse_integers(values))
    fits = isinstance(values, list) and values and len({str(value) for value in values}) == len(values)
    if not fits or not all(isinstance(value, str | int | float) and path_part(str(value)) for value in values):
        raise UserError("an axis needs values that differ and can be parts of names", f"{name} in {path}", MEND)
    return tuple(values)


def _given(before: tuple[Value, ...], name: str, text: str) -> tuple[Value, ...]:
    """The values of an axis as the command line says, of the kind that the file's are."""
    items: list[Value] = []
    for item in text.split(","):
        if all(isinstance(value, int) for value in before):
            items += parse_integers(item)
        else:
            items.append(item.strip())
    return _values(name, items, Path("--set"))


def _group(row: Any, axes: Mapping[str, Any], known: Mapping[str, _Group], path: Path) -> _Group:
    if not isinstance(row, dict):
        raise UserError("cells are tables", path, MEND)
    _check_keys(row, CELL_KEYS, path)
    name, command, own = row.get("name", ""), row.get("command", ""), row.get("axes", [])
    where = f"cells {name!r} in {path}"
    if not plain_name(name) or not re.fullmatch(r"[\w-]+", name) or name in (*known, *axes, *TAKEN_NAMES):
        raise UserError("cells need a name of their own, of letters, digits, - and _", where, MEND)
    if not all(isinstance(axis, str) and axis in axes for axis in own) or len({*own}) != len(own):
        raise UserError("cells over an axis that is not there", where, MEND)
    try:
        words = tuple(shlex.split(command))
    except ValueError as error:
        raise UserError(f"the command cannot be read ({error})", where, MEND) from None
    if not words or words[0] not in STAGES:
        raise UserError("the command must be a stage", where, f"Choose one of {', '.join(STAGES)}.")
    minutes, memory = float(row.get("minutes", 0)), float(row.get("memory_gb", MEMORY / 1e9))
    if not (0 <= minutes < MOST and 0 <= memory < MOST):
        raise UserError("minutes and memory_gb cannot be this", where, MEND)
    return _Group(name, words, tuple(own), minutes, memory, _cores(words, known))


def _cores(words: Sequence[str], known: Mapping[str, _Group]) -> int:
    """Processes that a command can use: training ensembles one for each sub-goal, as far as those are simply seen.

    Of a domain that may not be loaded they are not: what it is, and whether it may run, is for its cell to say.
    """
    if words[0] != "train-ensemble":
        return 1
    text = " ".join(words)
    settings = dict(re.findall(r"--set[ =](\w+)=(\S+)", text))
    data = (known[name] for name in re.findall(r"\{([\w-]+)\}", text) if name in known)
    domain = next((group.words[1] for group in data if group.words[0] == "collect" and group.words[1:]), "")
    goals: Sequence[str] = settings.get("sub_goals", "").split(",")
    with contextlib.suppress(UserError):
        goals = goals if "sub_goals" in settings else load_domain(domain).sub_goals
    asked = settings.get("workers", "")
    return max(1, min(len(goals), int(asked) if asked.isdigit() and int(asked) else len(goals)))


def _cell(group: _Group, point: Mapping[str, Value], groups: Mapping[str, _Group], out: Path) -> Cell:
    """One command: ``{axis}`` is its value, ``{name}`` what the cells of that name wrote for the same values."""
    needs: list[Path] = []

    def filled(match: re.Match[str]) -> str:
        key = match[1]
        if key in point:
            return str(point[key])
        other = groups.get(key)
        if other is None or other is group or not set(other.axes) <= set(group.axes):
            raise UserError(
                f"{{{key}}} is no axis of these cells, nor the name of cells above over some of their axes",
                f"cells {group.name!r}",
                MEND,
            )
        needs.append(_place(other, point, out))
        return str(needs[-1])

    words = [re.sub(r"\{([^{}]*)\}", filled, word) for word in group.words]
    if any(word.split("=")[0] in RESERVED for word in words):  # and be it by an axis
        raise UserError(f"{', '.join(RESERVED)} are given by the sweep", f"cells {group.name!r}", MEND)
    cost = Cost(60 * group.minutes, 1e9 * group.memory, cores=group.cores)
    return stage_cell(_place(group, point, out), out, words, needs, cost, {"group": group.name, **point})


def _place(group: _Group, point: Mapping[str, Value], out: Path) -> Path:
    """What a cell writes: NAME, or NAME/AXIS-VALUE-..."""
    suffix = ".h5" if group.words[0] == "collect" else ""
    values = "-".join(f"{axis}-{point[axis]}" for axis in group.axes)
    return out / (f"{group.name}/{values}{suffix}" if values else f"{group.name}{suffix}")
