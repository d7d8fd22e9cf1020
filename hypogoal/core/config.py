"""Settings: each default in one place, with unit, meaning and source; presets and ``--set`` are resolved here.

A stage's configuration is a frozen dataclass of :func:`setting` fields; ``hypogoal config STAGE`` and the manifests
use them too. Precedence: ``--set`` > option > preset > the domain's default > default.
"""

import dataclasses
import difflib
import inspect
import math
import os
import re
import typing
from collections.abc import Collection, Iterable, Mapping
from importlib import resources
from pathlib import Path
from typing import Any, TypeVar

from hypogoal.core.errors import UserError
from hypogoal.core.files import MOST_INTEGER, parse_toml, read_text
from hypogoal.core.own_code import command

T = TypeVar("T")
MAX_RANGE = 10_000  # integers that one range may stand for
DOMAIN = "doorkey"  # its presets and defaults hold if no domain is named


def setting(
    default: Any,
    meaning: str,
    *,
    unit: str = "",
    source: str = "",
    choices: Iterable[Any] | None = None,
    own: bool = False,
    low: float | None = None,
    high: float | None = None,
) -> Any:
    """A dataclass field with its unit, meaning, source and allowed values; ``own``: also a name with a colon."""
    allowed = {"choices": None if choices is None else tuple(choices), "own": own, "low": low, "high": high}
    return dataclasses.field(default=default, metadata={"meaning": meaning, "unit": unit, "source": source, **allowed})


def fixed(value: Any) -> Any:
    """A field in place of a setting that a stage has taken from another one and does not heed: it cannot be set."""
    return dataclasses.field(default=value, init=False)


def load_preset(name: str | None, stage: str, domain: str = DOMAIN, tables: Collection[str] = ()) -> dict[str, Any]:
    """The settings that preset ``name`` changes in ``stage``, a command: its table ``[stage]``.

    The name is a preset of the package (``demo``, ``paper``), of ``domain`` or, if it has none, of DoorKey, or the path
    of the user's TOML file. An unknown preset, invalid TOML, and tables not in ``tables`` (empty: any) are a
    ``UserError``.
    """
    if name is None:
        return {}
    every = resources.files("hypogoal") / "presets"
    folder = every / domain if domain.replace("-", "_").isidentifier() and (every / domain).is_dir() else every / DOMAIN
    available = sorted(entry.name[:-5] for entry in folder.iterdir() if entry.name.endswith(".toml"))
    if name.endswith(".toml"):
        if not Path(name).exists():
            raise UserError("no such preset file", name, f"Presets that come with hypogoal: {', '.join(available)}.")
        text = read_text(Path(name), "the preset is", "Give a .toml file.")
    elif name in available:
        text = (folder / f"{name}.toml").read_text(encoding="utf-8")
    else:
        raise UserError("unknown preset", name, f"Choose one of {', '.join(available)}, or give a .toml file.")
    table = parse_toml(text, name, "the preset is", "Mend the file.")
    for key in table:
        if tables and key not in (*tables, stage):
            do = f"{meant(key, tables)}A preset has tables for {', '.join(tables)}."
            raise UserError("no such table in a preset", f"{key} in {name}", do)
    values = table.get(stage, {})
    if not isinstance(values, dict):
        raise UserError(f"[{stage}] must be a table", name, "Write it as [stage] with key = value lines.")
    return values


def parse_assignments(assignments: Iterable[str]) -> dict[str, str]:
    """``["steps=300", ...]`` -> ``{"steps": "300", ...}``."""
    values = {}
    for assignment in assignments:
        key, equals, value = assignment.partition("=")
        if not equals or not key.strip():
            raise UserError("--set needs key=value", repr(assignment), "For example --set steps=300.")
        values[key.strip().replace("-", "_")] = value.strip()
    return values


def resolve(
    config_class: type[T],
    *,
    stage: str,
    preset: str | None = None,
    options: Mapping[str, Any] | None = None,
    assignments: Iterable[str] = (),
    domain: str = DOMAIN,
    defaults: Mapping[str, Any] | None = None,
    tables: Collection[str] = (),
) -> T:
    """The configuration of a stage, a frozen dataclass of :func:`setting` fields.

    From the preset (see :func:`load_preset`), the ``options`` of the command line that are not None, its ``--set``
    ``assignments`` and the domain's ``defaults``, which override the class's. An unknown key, a wrong type, or a value
    out of range is a ``UserError``.
    """
    values: dict[str, Any] = {**(defaults or {}), **load_preset(preset, stage, domain, tables)}
    values.update({key: value for key, value in (options or {}).items() if value is not None})
    assigned = parse_assignments(assignments)
    config = from_values(config_class, {**values, **assigned}, stage, domain)
    if "HYPOGOAL_CORES" not in os.environ:  # an experiment sets its cells alike, controls among them
        refuse_idle(config, {*(key for key, value in (options or {}).items() if value is not None), *assigned})
    return config


def refuse_idle(config: Any, names: set[str]) -> None:
    """Refuse (``UserError``) changed settings of these names that do nothing: ``IDLE`` of a class says beside what."""
    defaults = type(config)()
    for beside, idle in [item for part in type(config).__mro__ for item in vars(part).get("IDLE", {}).items()]:
        other, _, value = beside.partition("=")
        for name in names & set(idle) if getattr(config, other) == value else ():
            if getattr(config, name) != getattr(defaults, name):
                setting = f"{name}={getattr(config, name)}"
                do = f"Leave it out, or change {other}."
                raise UserError(f"this setting does nothing with {beside}", setting, do)


def from_values(config_class: type[T], values: Mapping[str, Any], stage: str, domain: str = DOMAIN) -> T:
    """Build ``config_class`` from plain values (text, TOML or JSON), checking each; ``domain`` is for messages."""
    every = dataclasses.fields(config_class)  # type: ignore[arg-type]
    fields = {field.name: field for field in every if field.init}
    constant = {field.name: field.default for field in every if not field.init}
    kinds = typing.get_type_hints(config_class)
    checked: dict[str, Any] = {}
    for key, value in gathered(values).items():
        if key in constant and value == constant[key]:
            continue
        if key not in fields:
            listed = command("config", stage, *([] if domain == DOMAIN else ["--domain", domain]))
            raise UserError(f"{stage} has no setting", key, f"{meant(key, fields)}All of them: {listed}")
        checked[key] = _checked(fields[key], kinds[key], value, stage)
    return config_class(**checked)


def gathered(values: Mapping[str, Any]) -> dict[str, Any]:
    """Values with those of a part of one's own, ``view.KEY``, in one: ``view_settings``, a list of KEY=VALUE."""
    whole: dict[str, Any] = {}
    for key, value in values.items():
        part, dot, name = key.partition(".")
        if dot:
            whole.setdefault(f"{part}_settings", []).append(f"{name}={value}")
        else:
            whole[key] = value
    return whole


def meant(word: str, candidates: Iterable[str]) -> str:
    """'Did you mean ...?' if a candidate is like ``word``; else empty."""
    near = difflib.get_close_matches(word, [*candidates], n=1)
    return f"Did you mean {near[0]!r}? " if near else ""


def as_dict(config: Any) -> dict[str, Any]:
    """The configuration as JSON-ready values."""
    return {
        field.name: list(value) if isinstance(value := getattr(config, field.name), tuple) else value
        for field in dataclasses.fields(config)
    }


def describe(config_class: type, *instead: tuple[Mapping[str, Any], str]) -> list[dict[str, Any]]:
    """Every setting with default, meaning and so on; the last of ``instead``, (defaults, source), overrides."""
    kinds = typing.get_type_hints(config_class)
    rows = []
    for field in (field for field in dataclasses.fields(config_class) if field.init):
        kind, default, details = kinds[field.name], field.default, dict(field.metadata)
        for values, source in instead:
            if field.name in values:
                default, details["source"] = values[field.name], source
        row = {"name": field.name, "type": getattr(kind, "__name__", str(kind)), "default": default}
        rows.append(row | {key: details.get(key) for key in ("unit", "meaning", "source")})
        home = next(part for part in config_class.__mro__ if field.name in inspect.get_annotations(part))
        rows[-1] |= {"allowed": _allowed(details), "part": (home.__doc__ or "").partition(".")[0]}
    return rows


def _allowed(meta: Mapping[str, Any]) -> str:
    if meta.get("choices"):
        return "|".join([*map(str, meta["choices"]), *(["module:Class"] if meta["own"] else [])])
    low, high = ("" if meta.get(bound) is None else meta[bound] for bound in ("low", "high"))
    return "" if low == high == "" else f"{low} .. {high}".strip()


def _checked(field: dataclasses.Field[Any], kind: Any, value: Any, stage: str) -> Any:
    shown = repr(value) if len(repr(value)) <= 200 else f"{repr(value)[:200]} ..."
    where = f"{field.name}={shown} in {stage}"
    try:
        parsed = _parse(kind, value)
    except (TypeError, ValueError, KeyError, OverflowError):
        name = "true or false" if kind is bool else getattr(kind, "__name__", str(kind))
        raise UserError("wrong type of value", where, f"It must be {name}.") from None
    meta = field.metadata
    for item in parsed if isinstance(parsed, tuple) else (parsed,):
        if isinstance(item, float) and not math.isfinite(item):
            raise UserError("value is not finite", where, "Give a finite number.")
        if isinstance(item, int) and abs(item) > MOST_INTEGER:
            raise UserError("value out of range", where, f"Integers go from -{MOST_INTEGER} to {MOST_INTEGER}.")
        if meta.get("choices") and item not in meta["choices"] and not (meta["own"] and ":" in item):
            raise UserError("value not allowed", where, f"Choose one of {_allowed(meta).replace('|', ', ')}.")
        for bound, outside in (("low", lambda a, b: a < b), ("high", lambda a, b: a > b)):
            if meta.get(bound) is not None and outside(item, meta[bound]):
                raise UserError("value out of range", where, f"Allowed: {_allowed(meta)}.")
    return parsed


def parse_integers(text: str) -> list[int]:
    """``0-3,7`` -> ``[0, 1, 2, 3, 7]``; anything else is a ``UserError``."""
    try:
        return [int(number) for item in text.split(",") for number in _range(item)]
    except ValueError:
        raise UserError("not integers", repr(text[:200]), "Write them as 0-3,7.") from None


def _range(item: Any) -> Iterable[Any]:
    """The integers of ``3-7``; anything else is itself."""
    match = re.fullmatch(r"\s*(\d{1,9})-(\d{1,9})\s*", item) if isinstance(item, str) else None
    if match is None:
        return (item,)
    first, last = int(match[1]), int(match[2])
    if not first <= last < first + MAX_RANGE:
        raise ValueError
    return range(first, last + 1)


def _parse(kind: Any, value: Any) -> Any:
    if typing.get_origin(kind) is tuple:
        (item_kind, *_rest) = typing.get_args(kind)
        items = value.split(",") if isinstance(value, str) else value
        if item_kind is int:
            items = [number for item in items for number in _range(item)]
        return tuple(_parse(item_kind, item.strip() if isinstance(item, str) else item) for item in items if item != "")
    if kind is bool:
        if isinstance(value, bool):
            return value
        return {"true": True, "1": True, "yes": True, "false": False, "0": False, "no": False}[str(value).lower()]
    if isinstance(value, bool):  # an int in Python
        raise TypeError
    if kind is int:
        if isinstance(value, str):
            value = value.replace("_", "")
        number = float(value)
        if number != int(number):
            raise ValueError
        return int(value) if isinstance(value, (int, str)) and str(value).lstrip("+-").isdigit() else int(number)
    if kind is float:
        return float(value)
    if kind is str and isinstance(value, str):
        return value
    raise TypeError(f"{value!r} is no {kind}")
