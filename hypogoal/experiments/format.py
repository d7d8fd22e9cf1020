"""Experiments in TOML: which commands there are, over which axes (Spec G4; docs/formats.md).

The file is data. Its commands are stages of hypogoal and nothing else, and write into the sweep's folder only. Those
that come with hypogoal lie in ``presets/``.
"""

import contextlib
import re
import shlex
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, make_dataclass
from itertools import groupby, product
from math import prod
from pathlib import Path
from typing import Any, NamedTuple

from hypogoal.core.config import DOMAIN, MAX_PRESET_BYTES, parse_assignments, parse_integers, resolve, setting
from hypogoal.core.errors import UserError
from hypogoal.core.files import parse_toml, path_part, plain_name, read_text
from hypogoal.core.workers import cores
from hypogoal.domains.base import load_domain
from hypogoal.experiments.cells import COLUMNS, RESERVED, Cell, Cost, Plan, closing_cells, stage_cell
from hypogoal.experiments.costs import Estimates
from hypogoal.settings import CONFIGS, STAGES, TABLES, configuration

FORMAT_VERSION = 1
NUMBER = (int, float)
KEYS = {
    "format": int, "domain": str, "short": bool, "evaluate": bool, "workers": int, "axes": dict, "settings": dict,
    "pairs": dict, "cells": list, "estimate": dict,
}  # fmt: skip
SETTING_KEYS = {
    "value": (list, bool, str), "meaning": str, "source": str, "choices": list, "low": NUMBER, "high": NUMBER,
    "words": dict, "changes": bool,
}  # fmt: skip
CELL_KEYS = {
    "name": str, "command": str, "axes": (list, dict), "for": list, "first": list, "if": str, "out": str,
    "columns": dict, "evaluated": bool, "minutes": NUMBER, "memory_gb": NUMBER,
}  # fmt: skip
TAKEN = ("run", "workers", "evaluate", "cell", "stage", "group", *COLUMNS)  # axes become columns
TAKEN_NAMES = ("evaluation", "report", "logs", "slurm")  # what else is in a run's folder
MAX_CELLS = 20_000
MOST = 1e7  # minutes, gigabytes
MEMORY = 1e9  # bytes of a process, where the file does not say
MEND = "Mend the file, see docs/formats.md."
REFERENCE = re.compile(r"\{([^{}]*)\}")

Value = str | int | float
Point = dict[str, Value]


class _Setting(NamedTuple):
    """An axis, its values a tuple, or a switch."""

    value: tuple[Value, ...] | bool
    about: Mapping[str, Any]


@dataclass(frozen=True)
class _Group:
    """The cells of one table: a command for each combination of its axes' values; ``lists`` says whose each takes."""

    name: str
    row: Mapping[str, Any]
    words: tuple[str, ...]
    lists: Mapping[str, str]
    cost: Cost

    @property
    def stage(self) -> str:
        return self.words[0]

    @property
    def out(self) -> str:
        return str(self.row.get("out", self.name))

    @property
    def named(self) -> list[str]:
        """The axes that its place ends with: those that its ``out`` does not name."""
        return [axis for axis in self.lists if axis not in (*self.row.get("first", ()), *REFERENCE.findall(self.out))]


@dataclass(frozen=True)
class Experiment:
    """What a file says. Its settings are those of ``hypogoal run``: each a list of values, or a switch."""

    name: str
    table: Mapping[str, Any]
    settings: Mapping[str, _Setting]
    groups: Mapping[str, _Group]

    @property
    def domain(self) -> str | None:
        """The domain whose presets and settings its stages take; None: each command says all itself."""
        return self.table.get("domain")

    @property
    def stages(self) -> tuple[str, ...]:
        """Of its commands."""
        return tuple(dict.fromkeys(group.stage for group in self.groups.values()))

    @property
    def config_class(self) -> type:
        """What it can be told."""
        fields: list[tuple[str, Any, Any]] = []
        for name, (value, about) in self.settings.items():
            kinds = {type(item) for item in value} if isinstance(value, tuple) else set()
            kind: Any = bool if isinstance(value, bool) else tuple[str, ...]
            kind = tuple[int, ...] if kinds == {int} else tuple[float, ...] if kinds == {float} else kind
            told = {key: about[key] for key in ("source", "low", "high") if key in about}
            choices = about.get("choices") or about.get("words") or None
            described = setting(value, about.get("meaning", ""), choices=choices, **told)
            fields.append((name, kind, described))
        workers = setting(self.table.get("workers", 0), "cells at once; 0 for one per core", low=0, high=1024)
        fields.append(("workers", int, workers))
        if self.domain is None:
            closing = setting(self.table.get("evaluate", True), "evaluation and report at the end")
            fields.append(("evaluate", bool, closing))
        return make_dataclass("RunConfig", fields, namespace={"__doc__": "Which cells there are."}, frozen=True)


def read_experiment(path: Path) -> Experiment:
    """An experiment in a TOML file; a ``UserError`` where it is none."""
    text = read_text(path, "the experiment is", "Give a .toml file.", MAX_PRESET_BYTES)
    table = parse_toml(text, path, "the experiment is", MEND)
    _check_keys(table, KEYS, path)
    if table.get("format") != FORMAT_VERSION:
        raise UserError(f"format must be {FORMAT_VERSION}", path, MEND)
    settings = {name: _Setting(_values(name, values, path), {}) for name, values in table.get("axes", {}).items()}
    for name, row in table.get("settings", {}).items():
        settings[name] = _setting(name, row, path)
    for switch, names in table.get("pairs", {}).items():
        lists = isinstance(names, list) and all(isinstance(settings.get(str(name), (0,))[0], tuple) for name in names)
        if not lists or getattr(settings.get(switch), "value", None) not in (True, False):
            raise UserError("pairs must be named after a switch and list axes", f"{switch} in {path}", MEND)
    groups: dict[str, _Group] = {}
    for row in table.get("cells", []):
        group = _group(row, settings, groups, path)
        groups[group.name] = group
    return Experiment(path.stem, table, settings, groups)


def _check_keys(table: Any, kinds: Mapping[str, Any], path: Path) -> None:
    if not isinstance(table, dict):
        raise UserError("cells and settings must be tables", path, MEND)
    for key, value in table.items():
        if key not in kinds:
            raise UserError("no such key in an experiment", key, f"{path} may have {', '.join(kinds)}.")
        allowed = kinds[key] if isinstance(kinds[key], tuple) else (kinds[key],)
        if not isinstance(value, allowed) or (isinstance(value, bool) and bool not in allowed):
            raise UserError("wrong kind of value in an experiment", f"{key} in {path}", MEND)


def _values(name: str, values: Any, path: Path) -> tuple[Value, ...]:
    """An axis: its values make names of folders, so they must be fit for that."""
    if not name.isidentifier() or name in TAKEN:
        raise UserError("an axis cannot have this name", repr(name), MEND)
    if isinstance(values, str):
        values = list(parse_integers(values))
    fits = isinstance(values, list) and values and len({str(value) for value in values}) == len(values)
    if not fits or not all(isinstance(value, str | int | float) and path_part(str(value)) for value in values):
        raise UserError("an axis needs values that differ and can be parts of names", f"{name} in {path}", MEND)
    return tuple(values)


def _setting(name: str, row: Any, path: Path) -> _Setting:
    _check_keys(row, SETTING_KEYS, path)
    words, choices = row.get("words", {}), row.get("choices", [])
    if not all(isinstance(text, str) for text in words.values()) or not all(map(path_part, map(str, choices))):
        raise UserError("words must be texts, choices parts of names", f"{name} in {path}", MEND)
    for text in words.values():
        _words(text, f"{name} in {path}")
    value = row.get("value")
    numbers = isinstance(value, list) and bool(value) and all(type(item) in NUMBER for item in value)
    if ("low" in row or "high" in row) and not numbers:
        raise UserError("low and high are for numbers", f"{name} in {path}", MEND)
    if isinstance(value, bool) or value == []:
        _values(name, [0], path)  # its name
        return _Setting(value if isinstance(value, bool) else (), row)
    return _Setting(_values(name, value, path), row)


def _words(command: str, where: str) -> list[str]:
    try:
        return shlex.split(command)
    except ValueError as error:
        raise UserError(f"the command cannot be read ({error})", where, MEND) from None


def _group(row: Any, settings: Mapping[str, _Setting], known: Mapping[str, _Group], path: Path) -> _Group:
    _check_keys(row, CELL_KEYS, path)
    name, command, axes = row.get("name", ""), row.get("command", ""), row.get("axes", [])
    where = f"cells {name!r} in {path}"
    lists = {key: own for key, own in settings.items() if isinstance(own.value, tuple)}
    if not plain_name(name) or not re.fullmatch(r"[\w-]+", name) or name in (*known, *lists, *TAKEN_NAMES):
        raise UserError("cells need a name of their own, of letters, digits, - and _", where, MEND)
    pairs = list(axes.items()) if isinstance(axes, dict) else [(axis, axis) for axis in axes]
    texts = [text for pair in pairs for text in pair]
    if not all(isinstance(text, str) for text in texts) or not all(own in lists for _, own in pairs):
        raise UserError("cells over an axis that does not exist", where, MEND)
    inner = [*row.get("for", []), *row.get("first", [])]
    if len(dict(pairs)) != len(pairs) or any(axis not in [name for name, _ in pairs] for axis in inner):
        raise UserError("cells over an axis that does not exist", where, MEND)
    if "if" in row and not isinstance(getattr(settings.get(row["if"]), "value", None), bool):
        raise UserError("no such switch", f"{row['if']} of {where}", MEND)
    if not all(isinstance(text, str) for text in row.get("columns", {}).values()):
        raise UserError("columns must be texts", where, MEND)
    for column in (*dict(pairs), *row.get("columns", {})):
        _values(column, [0], path)  # its name
    words = tuple(_words(command, where))
    if not words or words[0] not in STAGES:
        raise UserError("the command must be a stage", where, f"Choose one of {', '.join(STAGES)}.")
    minutes, memory = float(row.get("minutes", 0)), float(row.get("memory_gb", MEMORY / 1e9))
    if not (0 <= minutes < MOST and 0 <= memory < MOST):
        raise UserError("minutes and memory_gb cannot have these values", where, MEND)
    cost = Cost(60 * minutes, 1e9 * memory, cores=_cores(words, known))
    return _Group(name, row, words, dict(pairs), cost)


def _cores(words: Sequence[str], known: Mapping[str, _Group]) -> int:
    """Processes that a command can use: training ensembles one for each sub-goal, as far as those are simply seen.

    Of a domain that may not be loaded they are not: what it is, and whether it may run, is for its cell to say.
    """
    if words[0] != "train-ensemble":
        return 1
    text = " ".join(words)
    settings = dict(re.findall(r"--set[ =](\w+)=(\S+)", text))
    data = (known[name] for name in REFERENCE.findall(text) if name in known)
    domain = next((group.words[1] for group in data if group.stage == "collect" and group.words[1:]), "")
    goals: Sequence[str] = settings.get("sub_goals", "").split(",")
    with contextlib.suppress(UserError):
        goals = goals if "sub_goals" in settings else load_domain(domain).sub_goals
    asked = settings.get("workers", "")
    return max(1, min(len(goals), int(asked) if asked.isdigit() and int(asked) else len(goals)))


def make_plan(
    experiment: Experiment,
    out: Path,
    assignments: Iterable[str] = (),
    *,
    preset: str | None = None,
    device: str = "auto",
    short: bool = False,
) -> Plan:
    """The cells of an experiment in the folder ``out``; what cannot be, or is not there, is a ``UserError``.

    ``assignments`` are ``SETTING=VALUES``, with commas between, in place of the file's; ``workers=N``,
    ``evaluate=false``; where it has a domain also ``STAGE.KEY=VALUE``, and ``preset`` and ``device``. ``short``: for
    one that is to have one agent and no more, names without their axes.
    """
    return _Planner(experiment, out, [*assignments], preset, device).plan(short=short)


class _Planner:
    """An experiment as it is to be made: its settings, those of its tables that are switched on, and their cells."""

    def __init__(self, experiment: Experiment, out: Path, assignments: list[str], preset: str | None, device: str):
        self.experiment, self.out, self.domain = experiment, out, experiment.domain
        mine, by_stage = _split(assignments) if self.domain else (assignments, {})
        if self.domain is None:
            self._refuse(mine, preset, device)
        domain = self.domain or DOMAIN
        config: Any = resolve(
            experiment.config_class, stage="run", preset=preset, assignments=mine, domain=domain, tables=TABLES
        )
        self.config, self.settings = config, {}
        for name, (_, about) in experiment.settings.items():
            axis = self.settings[name] = _Setting(getattr(config, name), about)
            if self.domain is None and isinstance(axis.value, tuple):
                _values(name, list(axis.value), Path("--set"))
        chosen = experiment.groups.items()
        self.groups = {name: group for name, group in chosen if getattr(config, group.row.get("if", ""), True)}
        self._check_stages(by_stage)
        self.common: dict[str, list[str]] = {}
        self.resolved: dict[str, Any] = {}
        for stage in experiment.stages:
            pairs = by_stage.get(stage, [])
            common = [*(("--preset", preset) if preset else ()), *(x for pair in pairs for x in ("--set", pair))]
            self.common[stage] = common + (["--device", device] if device != "auto" and stage in CONFIGS else [])
            if self.domain:
                self.resolved[stage] = configuration(stage, self.domain, preset, pairs)

    def _refuse(self, assignments: Sequence[str], preset: str | None, device: str) -> None:
        if preset is not None:
            raise UserError("an experiment of your own takes no preset", preset, "Write --preset into its commands.")
        if device != "auto":
            raise UserError("an experiment of your own takes no device", device, "Write --device into its commands.")
        known = [*self.experiment.settings, "workers", "evaluate"]
        for key, text in parse_assignments(assignments).items():
            if key not in known:
                do = f"It has {', '.join(known)}."
                raise UserError("no such axis or setting in this experiment", f"{key}={text}", do)

    def _check_stages(self, by_stage: Mapping[str, Sequence[str]]) -> None:
        """Refuse settings of stages that it has not, and those that its commands give each cell as an option."""
        stages, decided = self.experiment.stages, self._decided()
        for stage, pairs in by_stage.items():
            if stage not in stages:
                raise UserError("no such stage in --set", stage, f"Choose one of {', '.join(stages)}.")
            for key in parse_assignments(pairs):
                if (stage, key) in decided:
                    do = f"Give --set {decided[stage, key]}=..."
                    raise UserError("the experiment sets this for each cell", f"{stage}.{key}", do)

    def _decided(self) -> dict[tuple[str, str], str]:
        """By stage and option of a command, the setting that it comes from: ``--set`` would go before it."""
        found: dict[tuple[str, str], str] = {}
        for group in self.experiment.groups.values():
            for axis, name in group.lists.items():
                options = re.findall(rf"--(\S+)\s+\{{{axis}\}}", group.row["command"])
                for words in self.settings[name].about.get("words", {}).values():
                    options += re.findall(r"--(\S+)", words)
                found.update(((group.stage, option.replace("-", "_")), name) for option in options)
        return found

    def plan(self, *, short: bool) -> Plan:
        experiment = self.experiment
        single = all(len(self._of(group, axis)) == 1 for group in self.groups.values() for axis in group.named)
        self.short = short and single and bool(experiment.table.get("short"))
        planned: list[Cell] = []
        read: list[Path] = []
        for _, rows in groupby(self.groups.values(), lambda group: group.row.get("for") or group.name):
            beside: list[tuple[tuple[int, ...], bool, Cell]] = []
            for group in rows:
                self._check_read(group)
                counts = (len(self._of(group, axis)) for axis in group.lists)
                if len(planned) + len(beside) + prod(counts) > MAX_CELLS:
                    raise UserError(f"more than {MAX_CELLS} cells", experiment.name, "Take fewer values.")
                evaluated = group.row.get("evaluated", True)
                beside += [(order, evaluated, self._cell(group, point)) for order, point in self._points(group)]
            for _, evaluated, cell in sorted(beside, key=lambda item: item[0]):
                planned.append(cell)
                read += [cell.out] if evaluated else []
        self._check_apart(planned)
        if not planned:
            raise UserError("no cells in this experiment", experiment.name, "Give its axes values.")
        closing = Cost()
        if self.domain and "estimate" in experiment.table:
            estimates = Estimates(experiment.table["estimate"], self.domain)
            planned, closing = estimates.priced(planned), estimates.closing(planned)
        if self.domain or self.config.evaluate:
            planned += closing_cells(self.out, read, closing)
        return Plan(experiment.name, planned, self.config.workers or cores())

    def _of(self, group: _Group, axis: str) -> tuple[Value, ...]:
        """The values of an axis."""
        own = self.settings[group.lists[axis]]
        values: Any = ("", *own.value) if own.about.get("changes") else own.value  # type: ignore[misc]
        return tuple(values[:1]) if axis in group.row.get("first", ()) else tuple(values)

    def _points(self, group: _Group) -> Iterable[tuple[tuple[int, ...], Point]]:
        """Each combination of values of a group's axes, behind the numbers of those of its outer ones."""
        pairs = [
            [axis for axis, name in group.lists.items() if name in names]
            for switch, names in self.experiment.table.get("pairs", {}).items()
            if getattr(self.config, switch)
        ]
        values = {axis: self._of(group, axis) for axis in group.lists}
        for axes in pairs:
            if len({len(values[axis]) for axis in axes}) > 1:
                one, other = axes[:2]
                what = f"{len(values[one])} {one}s cannot be paired with {len(values[other])} {other}s"
                switch = next(iter(self.experiment.table["pairs"]))
                do = f"Give as many of both, or {switch}=false for every {one} with every {other}."
                raise UserError(what, group.lists[one], do)
        for places in product(*(range(len(own)) for own in values.values())):
            at = dict(zip(values, places, strict=True))
            if all(len({at[axis] for axis in axes}) <= 1 for axes in pairs):
                outer = tuple(at[axis] for axis in group.row.get("for", ()))
                yield outer, {axis: values[axis][at[axis]] for axis in values}

    def _check_read(self, group: _Group) -> None:
        """Refuse values for which the cells that a group reads are not made."""
        if not all(self._of(group, axis) for axis in group.lists):
            return
        for other in (self.groups[name] for name in REFERENCE.findall(group.row["command"]) if name in self.groups):
            for axis in other.lists.keys() & group.lists.keys():
                there, mine = self._of(other, axis), self.settings[group.lists[axis]].value
                if missing := [value for value in mine if value not in there]:  # type: ignore[union-attr]
                    what = f"no {other.name}s of {','.join(map(str, missing))} to learn {group.name} for"
                    raise UserError(what, group.lists[axis], f"Add it to {other.lists[axis]}.")

    def _cell(self, group: _Group, point: Point) -> Cell:
        """One command: ``{axis}`` is its value, ``{name}`` what the cells of that name wrote for the same values."""
        needs: list[Path] = []

        def filled(match: re.Match[str]) -> str:
            key = match[1]
            if key in point:
                return str(point[key])
            if "." in key and (terms := self._terms(key)):
                return str(sum(terms))
            other = self.groups.get(key)
            missing = set() if other is None else other.lists.keys() - point.keys()
            if other is None or other is group or any(not self._is_changes(other, axis) for axis in missing):
                what = (
                    f"{{{key}}} is neither an axis of these cells nor the name of cells above over some of their axes"
                )
                raise UserError(what, f"cells {group.name!r}", MEND)
            needs.append(self._place(other, {**dict.fromkeys(missing, ""), **point}))
            return str(needs[-1])

        words: list[str] = []
        command = re.sub(r"\[([^\[\]]*)\]", self._if_there, group.row["command"])
        for word in _words(command, f"cells {group.name!r}"):
            axis = word[1:-1]
            own = self.settings[group.lists[axis]] if word == f"{{{axis}}}" and axis in point else None
            if own and own.about.get("changes"):
                words += (part for change in str(point[axis]).split() for part in ("--set", change))
            elif own and own.about.get("words"):
                words += shlex.split(own.about["words"].get(point[axis], str(point[axis])))
            else:
                words.append(REFERENCE.sub(filled, word))
        if any(word.split("=")[0] in RESERVED for word in words):  # and be it by an axis
            raise UserError(f"{', '.join(RESERVED)} are given by the sweep", f"cells {group.name!r}", MEND)
        columns: dict[str, Value] = {"group": group.name, **point}
        if "columns" in group.row:
            columns = {name: self._column(text, point) for name, text in group.row["columns"].items()}
        # What is common to a stage comes behind stage and input, so that the cell's own come last: of settings the last
        # one counts, and a method or a control is what it is called, whatever all cells were given.
        words[2:2] = self.common[group.stage]
        return stage_cell(self._place(group, point), self.out, words, needs, group.cost, columns)

    def _if_there(self, match: re.Match[str]) -> str:
        """What stands in brackets, unless it names cells that are switched off."""
        names = REFERENCE.findall(match[1])
        known = self.experiment.groups
        if not any(name in known and "if" in known[name].row for name in names):
            return match[0]
        return match[1] if all(name in self.groups for name in names) else ""

    def _is_changes(self, group: _Group, axis: str) -> bool:
        return bool(self.settings[group.lists[axis]].about.get("changes"))

    def _terms(self, key: str) -> list[int]:
        """``options.steps+meta.steps``: such settings of cells above, of those that are switched off 0."""
        found = []
        for term in key.split("+"):
            name, _, key = term.partition(".")
            group = self.experiment.groups.get(name)
            value = getattr(self.resolved.get(group.stage), key, None) if group else None
            if type(value) is not int:
                return []
            found.append(value if name in self.groups else 0)
        return found

    def _column(self, text: str, point: Point) -> Value:
        if text[1:-1] in point and text == f"{{{text[1:-1]}}}":
            return point[text[1:-1]]  # a number stays one
        return REFERENCE.sub(lambda match: str(point.get(match[1], match[0])), text)

    def _place(self, group: _Group, point: Point) -> Path:
        """What a cell writes: NAME, or NAME/AXIS-VALUE-..."""

        def filled(match: re.Match[str]) -> str:
            axis = match[1]
            if axis not in group.lists:
                raise UserError(f"{{{axis}}} in out is not an axis of these cells", f"cells {group.name!r}", MEND)
            changes = "".join(f",{change}" for change in str(point[axis]).split())
            return changes if self._is_changes(group, axis) else str(point[axis])

        place = REFERENCE.sub(filled, group.out)
        values = "-".join(f"{axis}-{point[axis]}" for axis in group.named)
        suffix = ".h5" if group.stage == "collect" else ""
        return self.out / (f"{place}/{values}{suffix}" if values and not self.short else f"{place}{suffix}")

    def _check_apart(self, cells: Sequence[Cell]) -> None:
        """Refuse cells of which two write the same, as those of a seed that is given twice do, or share a name.

        And those that read what is not made before.
        """
        outs = Counter(cell.out for cell in cells)
        if names := [cell.name for cell in cells if outs[cell.out] > 1]:
            lists = {name: own.value for name, own in self.settings.items() if isinstance(own.value, tuple)}
            twice = [f"{name}={value}" for name, values in lists.items() for value in values if values.count(value) > 1]
            where = ", ".join(dict.fromkeys(twice)) or names[0]
            raise UserError("two cells would be the same", where, "Give each value once.")
        name, count = Counter([*(cell.name for cell in cells), "evaluate", "report"]).most_common(1)[0]
        if count > 1:
            raise UserError("two cells would have the same name", name, MEND)
        made: set[Path] = set()
        for cell in cells:
            if missing := [need for need in cell.needs if need not in made]:
                raise UserError(f"{cell.name} would read what no cell before it makes", missing[0], MEND)
            made.add(cell.out)


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
