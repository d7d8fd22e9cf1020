"""A user's sweep in TOML: axes, and commands with ``{axis}`` (Spec G4; docs/formats.md).

The file is data. Its commands are stages of hypogoal and nothing else, and write into the sweep's folder only.
"""

import re
import shlex
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import product
from pathlib import Path
from typing import Any

from hypogoal.core.config import MAX_PRESET_BYTES, parse_integers, setting
from hypogoal.core.errors import UserError
from hypogoal.core.files import parse_toml, path_part, plain_name, read_text
from hypogoal.experiments.cells import COLUMNS, Cost
from hypogoal.experiments.experiment import UNKNOWN, Command, Experiment, Value, run_config
from hypogoal.settings import STAGES

FORMAT_VERSION = 1
NUMBER = (int, float)
KEYS = {"format": int, "evaluate": bool, "workers": int, "axes": dict, "cells": list}
CELL_KEYS = {"name": str, "command": str, "axes": list, "minutes": NUMBER, "memory_gb": NUMBER}
FORMER = ("domain", "settings", "pairs", "short", "estimate", "for", "first", "if", "out", "columns", "evaluated")
TAKEN = ("run", "workers", "evaluate", "cell", "stage", "group", *COLUMNS)  # axes become columns
MOST = 1e7  # minutes, gigabytes
MEND = "Mend the file, see docs/formats.md."
REFERENCE = re.compile(r"\{([^{}]*)\}")

Point = Mapping[str, Value]


@dataclass(frozen=True)
class _Group:
    """A command for each combination of its axes' values."""

    name: str
    words: tuple[str, ...]
    axes: tuple[str, ...]
    cost: Cost

    def cell_name(self, point: Point) -> str:
        """NAME, or NAME/AXIS-VALUE-AXIS-VALUE."""
        values = "-".join(f"{axis}-{point[axis]}" for axis in self.axes)
        return f"{self.name}/{values}" if values else self.name


def read_toml(path: Path) -> Experiment:
    """The experiment in a TOML file; a ``UserError`` where there is none."""
    text = read_text(path, "the experiment is", "Give a .toml file.", MAX_PRESET_BYTES)
    table = parse_toml(text, path, "the experiment is", MEND)
    _check_keys(table, KEYS, path)
    if table.get("format") != FORMAT_VERSION:
        raise UserError(f"format must be {FORMAT_VERSION}", path, MEND)
    axes = {name: _values(name, values, path) for name, values in table.get("axes", {}).items()}
    groups: dict[str, _Group] = {}
    for row in table.get("cells", []):
        group = _group(row, axes, groups, path)
        groups[group.name] = group

    def commands(**values: tuple[Value, ...]) -> Iterator[Command]:
        for name, chosen in values.items():
            _values(name, list(chosen), "--set")
        for group in groups.values():
            for combination in product(*(values[axis] for axis in group.axes)):
                yield _command(group, groups, dict(zip(group.axes, combination, strict=True)))

    fields = [(name, _kind(values), setting(values, "")) for name, values in axes.items()]
    given = {key: table[key] for key in ("workers", "evaluate") if key in table}
    return Experiment(path.stem, commands, run_config(fields, closing=True, **given))


def _check_keys(table: Any, kinds: Mapping[str, Any], path: Path) -> None:
    if not isinstance(table, dict):
        raise UserError("cells must be tables", path, MEND)
    for key, value in table.items():
        if key in FORMER or (key == "axes" and kinds is CELL_KEYS and isinstance(value, dict)):
            do = "Write it as a Python function and give module:function, see docs/formats.md."
            raise UserError(f"an experiment in TOML can no longer say {key!r}", path, do)
        if key not in kinds:
            raise UserError("no such key in an experiment", key, f"{path} may have {', '.join(kinds)}.")
        allowed = kinds[key] if isinstance(kinds[key], tuple) else (kinds[key],)
        if not isinstance(value, allowed) or (isinstance(value, bool) and bool not in allowed):
            raise UserError("wrong kind of value in an experiment", f"{key} in {path}", MEND)


def _values(name: str, values: Any, where: object) -> tuple[Value, ...]:
    """An axis: its values make names of folders, so they must be fit for that."""
    if not name.isidentifier() or name in TAKEN:
        raise UserError("an axis cannot have this name", repr(name), MEND)
    if isinstance(values, str):
        values = list(parse_integers(values))
    fits = isinstance(values, list) and values and len({str(value) for value in values}) == len(values)
    if not fits or not all(isinstance(value, Value) and path_part(str(value)) for value in values):
        raise UserError("an axis needs values that differ and can be parts of names", f"{name} in {where}", MEND)
    return tuple(values)


def _kind(values: Sequence[Value]) -> Any:
    kinds = {type(value) for value in values}
    return tuple[int, ...] if kinds == {int} else tuple[float, ...] if kinds == {float} else tuple[str, ...]


def _group(row: Any, axes: Mapping[str, Any], known: Mapping[str, _Group], path: Path) -> _Group:
    _check_keys(row, CELL_KEYS, path)
    name, command, named = row.get("name", ""), row.get("command", ""), row.get("axes", [])
    where = f"cells {name!r} in {path}"
    if not plain_name(name) or name in (*known, *axes):
        raise UserError("cells need a name of their own, of letters, digits, - and _", where, MEND)
    if not all(isinstance(axis, str) and axis in axes for axis in named) or len({*named}) != len(named):
        raise UserError("cells over an axis that does not exist", where, MEND)
    try:
        words = tuple(shlex.split(command))
    except ValueError as error:
        raise UserError(f"the command cannot be read ({error})", where, MEND) from None
    if not words or words[0] not in STAGES:
        raise UserError("the command must be a stage", where, f"Choose one of {', '.join(STAGES)}.")
    minutes, memory = float(row.get("minutes", 0)), float(row.get("memory_gb", UNKNOWN.memory / 1e9))
    if not (0 <= minutes < MOST and 0 <= memory < MOST):
        raise UserError("minutes and memory_gb cannot have these values", where, MEND)
    return _Group(name, words, tuple(named), Cost(60 * minutes, 1e9 * memory))


def _command(group: _Group, groups: Mapping[str, _Group], point: Point) -> Command:
    """``{axis}`` is its value, ``{name}`` the output of the cells of that name for the same values."""

    def filled(match: re.Match[str]) -> str:
        key = match[1]
        if key in point:
            return str(point[key])
        other = groups.get(key)
        if other is None or other is group or not point.keys() >= {*other.axes}:
            what = f"{{{key}}} is neither an axis of these cells nor the name of cells above over some of their axes"
            raise UserError(what, f"cells {group.name!r}", MEND)
        return f"@{other.cell_name(point)}"

    words = [REFERENCE.sub(filled, word) for word in group.words]
    return Command(group.cell_name(point), words, {"group": group.name, **point}, group.cost)
