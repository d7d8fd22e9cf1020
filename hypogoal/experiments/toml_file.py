"""A user's sweep in TOML: axes, and commands with ``{axis}`` (Spec G4; docs/formats.md).

The file is data. Its commands are stages of hypogoal and nothing else, and write into the sweep's folder only.
"""

import re
from collections.abc import Iterator, Mapping, Sequence
from itertools import chain, product
from pathlib import Path
from typing import Any

from hypogoal.core.config import parse_integers, setting
from hypogoal.core.errors import UserError
from hypogoal.core.files import parse_toml, path_part, read_text
from hypogoal.core.own_code import names_in, require_trust
from hypogoal.experiments.cells import COLUMNS
from hypogoal.experiments.experiment import COMMON, Command, Experiment, Value, run_config

FORMAT_VERSION = 1
KEYS: Mapping[str, Any] = {"format": int, "evaluate": bool, "workers": int, "axes": dict, "cells": list}
CELL_KEYS: Mapping[str, Any] = {"name": str, "command": str, "axes": list}
TAKEN = ("run", *COMMON, "cell", "stage", "group", *COLUMNS)  # axes become columns
MEND = "Mend the file, or write a Python function, see docs/formats.md."
REFERENCE = re.compile(r"\{([^{}]*)\}")

Point = Mapping[str, Value]


def read_toml(path: Path) -> Experiment:
    """The experiment in a TOML file; a ``UserError`` where there is none."""
    text = read_text(path, "the experiment is", "Give a .toml file.")
    table = parse_toml(text, path, "the experiment is", MEND)
    _check_keys(table, KEYS, path)
    if table.get("format") != FORMAT_VERSION:
        raise UserError(f"format must be {FORMAT_VERSION}", path, MEND)
    axes = {name: _values(name, values, path) for name, values in table.get("axes", {}).items()}
    rows: dict[str, Mapping[str, Any]] = {}
    for row in table.get("cells", []):
        _check_keys(row, CELL_KEYS, path)
        name, names = row.get("name", ""), row.get("axes", [])
        where = f"cells {name!r} in {path}"
        if name in (*rows, *axes):
            raise UserError("cells need a name of their own", where, MEND)
        if not all(isinstance(axis, str) and axis in axes for axis in names) or len({*names}) < len(names):
            raise UserError("cells over an axis that does not exist", where, MEND)
        rows[name] = row

    def commands(**values: tuple[Value, ...]) -> Iterator[Command]:
        for name, chosen in values.items():
            _values(name, list(chosen), "--set")
        for row in rows.values():
            names = row.get("axes", [])
            for combination in product(*(values[name] for name in names)):
                yield _command(row, rows, dict(zip(names, combination, strict=True)))

    settings = [(name, _kind(values), setting(values, "")) for name, values in axes.items()]
    defaults = {key: table[key] for key in COMMON if key in table}
    return Experiment(path.stem, commands, run_config(settings, **defaults))


def _check_keys(table: Any, kinds: Mapping[str, Any], path: Path) -> None:
    if not isinstance(table, dict):
        raise UserError("cells must be tables", path, MEND)
    for key, value in table.items():
        if key not in kinds:
            raise UserError(f"no such key in an experiment: it may have {', '.join(kinds)}", f"{key} in {path}", MEND)
        if not isinstance(value, kinds[key]) or (isinstance(value, bool) and kinds[key] is not bool):
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


def _command(row: Mapping[str, Any], rows: Mapping[str, Mapping[str, Any]], point: Point) -> Command:
    """``{axis}`` is its value, ``{name}`` the output of the cells of that name for the same values."""

    def filled(match: re.Match[str]) -> str:
        key = match[1]
        if key in point:
            return str(point[key])
        if key not in rows or rows[key] is row or not point.keys() >= {*rows[key].get("axes", [])}:
            problem = f"{{{key}}} is neither an axis of these cells nor the name of cells above over some of their axes"
            raise UserError(problem, f"cells {row.get('name', '')!r}", MEND)
        return f"@{_name(rows[key], point)}"

    words = Command(row.get("name", ""), row.get("command", "")).words
    words = [REFERENCE.sub(filled, word) for word in words]
    for own in chain.from_iterable(map(names_in, [*words, *point.values()])):
        require_trust(own, "setting")
    return Command(_name(row, point), words, {"group": row.get("name", ""), **point})


def _name(row: Mapping[str, Any], point: Point) -> str:
    """NAME, or NAME/AXIS-VALUE-AXIS-VALUE."""
    values = "-".join(f"{axis}-{point[axis]}" for axis in row.get("axes", []))
    return f"{row.get('name', '')}/{values}" if values else row.get("name", "")
