"""Settings: a pydantic model for each stage, whose fields have default, meaning, unit, source and limits.

Precedence: ``--set`` > option > preset > the domain's default > default. The settings that only one learner or chooser
has are a part of the stage's model: a model of their own, which is there where a setting chooses it.
"""

import dataclasses
import difflib
import inspect
import json
import re
import tomllib
from collections.abc import Iterable, Mapping
from functools import cache
from importlib import import_module, resources
from pathlib import Path
from typing import Any, ClassVar, TypeVar, get_args, get_origin

from pydantic import BaseModel, ConfigDict, Field, ValidationError, ValidationInfo, create_model, field_validator
from pydantic.fields import FieldInfo

from hypogoal.core.errors import UserError

C = TypeVar("C", bound="Config")
DOMAIN = "doorkey"  # its presets and defaults hold if no domain is named
MODELS = {  # by stage; collect's are its domain's, those of run its experiment's
    "train-ensemble": "hypogoal.hypotheses.config:TrainEnsembleConfig",
    "train-options": "hypogoal.meta.config:TrainOptionsConfig",
    "train-meta": "hypogoal.meta.config:TrainMetaConfig",
    "train-baseline": "hypogoal.learners.baselines.settings:BaselineConfig",
    "audit": "hypogoal.meta.config:AuditConfig",
}
STAGES = ("collect", *MODELS)
TABLES = (*STAGES, "run")  # of presets
OWN = "module:object"  # any name of one's own, among choices and parts
MOST = 10_000  # integers that one range may stand for


class Config(BaseModel):
    """The settings of a stage or of a part of it; names that it lacks and values that it does not allow are refused.

    Attributes:
        PARTS: by setting and its value, the model of the settings that this value brings. Values of one's own, ``OWN``,
            bring all of them.
    """

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)
    PARTS: ClassVar[dict[str, dict[str, type["Config"]]]] = {}

    @classmethod
    def of(cls, **values: Any) -> Any:
        """The settings with these values, of the parts that they choose; those of other parts have no effect."""
        return resolve(cls, values, {}, stage=cls.__name__)

    @field_validator("*", mode="before")
    @classmethod
    def _read(cls, value: Any, info: ValidationInfo) -> Any:
        """What was typed, or stands in a file, so that pydantic can make it a value of the field's type."""
        kind = cls.model_fields[str(info.field_name)].annotation
        if get_origin(kind) is tuple:
            kind = get_args(kind)[0]
            value = _items(value, kind) if isinstance(value, str) else value
        if isinstance(value, list | tuple):
            return [_number(item, kind) for item in value]
        return _number(value, kind)

    @field_validator("*")
    @classmethod
    def _check(cls, value: Any, info: ValidationInfo) -> Any:
        details = _details(cls.model_fields[str(info.field_name)])
        for item in value if isinstance(value, tuple) else (value,):
            choices, low, high = details.get("choices"), details.get("low"), details.get("high")
            if choices and item not in choices and not (details["own"] and ":" in item):
                raise ValueError("value not allowed")
            if (low is not None and item < low) or (high is not None and item > high):
                raise ValueError("value out of range")
        return value


def setting(
    default: Any,
    meaning: str,
    *,
    unit: str = "",
    source: str = "",
    low: float | None = None,
    high: float | None = None,
    choices: Iterable[Any] | None = None,
    own: bool = False,
) -> Any:
    """A field of a ``Config`` with its meaning, unit and source.

    Its value, or each item of a tuple, is ``low`` to ``high``, or among ``choices``; ``own``: or ``module:object``.
    """
    chosen_from = None if choices is None else tuple(choices)
    details: Any = {"unit": unit, "source": source, "low": low, "high": high, "choices": chosen_from, "own": own}
    return Field(default, description=meaning, json_schema_extra=details)


def model_of(stage: str) -> type[Config]:
    """The model of the settings of one of ``MODELS``."""
    module, _, name = MODELS[stage].partition(":")
    model: type[Config] = getattr(import_module(module), name)
    return model


def assigned(assignments: Iterable[str]) -> dict[str, str]:
    """``["steps=300", ...]`` -> ``{"steps": "300", ...}``."""
    values = {}
    for assignment in assignments:
        key, equals, value = assignment.partition("=")
        if not equals or not key.strip():
            raise UserError("--set needs key=value", repr(assignment), "For example --set steps=300.")
        values[key.strip().replace("-", "_")] = value.strip()
    return values


def integers(text: str) -> list[int]:
    """``0-3,7`` -> ``[0, 1, 2, 3, 7]``; anything else is a ``UserError``."""
    try:
        return _items(text, int)
    except ValueError:
        raise UserError("not integers", repr(text[:200]), "Write them as 0-3,7.") from None


def preset(name: str | None, stage: str, domain: str = DOMAIN) -> dict[str, Any]:
    """The table ``[stage]`` of a preset: one of the package, for ``domain`` or else for DoorKey, or a TOML file."""
    if name is None:
        return {}
    presets = Path(str(resources.files("hypogoal"))) / "presets"
    folder = presets / (domain if (presets / domain).is_dir() else DOMAIN)
    path = Path(name) if name.endswith(".toml") else folder / f"{name}.toml"
    if not path.exists():
        names = ", ".join(sorted(file.stem for file in folder.iterdir()))
        raise UserError("no such preset", name, f"Choose one of {names}, or give a .toml file.")
    try:
        tables = tomllib.loads(path.read_text(encoding="utf-8-sig"))
    except (OSError, ValueError) as error:
        raise UserError(f"the preset cannot be read ({error})", name, "Mend the file.") from None
    for key, table in tables.items():
        if key not in TABLES or not isinstance(table, dict):
            do = f"{near(key, TABLES)}A preset has tables for {', '.join(TABLES)}."
            raise UserError("no such table in a preset", f"{key} in {name}", do)
    return dict(tables.get(stage, {}))


def resolve(model: type[C], *layers: Mapping[str, Any], stage: str) -> C:
    """The settings of ``stage``, of the model and of the parts that its settings choose; later layers win.

    None stands for a value that is not given. The last layer is what the user typed: there a setting of a part that is
    not chosen is refused; the others, a domain's defaults and a preset, may have some, without effect. What is refused
    is a ``UserError``.
    """
    if dataclasses.is_dataclass(model) or not issubclass(model, Config):
        do = f"Write 'class {model.__name__}(Config):', without @dataclass."
        raise UserError("settings are a class derived from hypogoal.core.config.Config", model.__name__, do)
    values: dict[str, Any] = {}
    typed: set[str] = set()
    for layer in layers:
        entries = {name: value for name, value in layer.items() if value is not None}
        typed = set(entries)
        values |= entries
    chosen = _with_parts(model, values)
    for name in [*values]:
        if name not in typed and name not in chosen.model_fields and _choices_with(model, name):
            del values[name]
    try:
        return chosen.model_validate(values)
    except ValidationError as error:
        raise _refusal(chosen, values, error, stage) from None


def known(model: type[Config], values: Mapping[str, Any]) -> dict[str, Any]:
    """The values of a manifest or data file that the model or a part of it has: earlier versions had others, too."""
    names = _with_parts(model).model_fields
    return {name: value for name, value in values.items() if name in names}


def described(model: type[Config], *layers: tuple[Mapping[str, Any], str]) -> list[dict[str, Any]]:
    """Every setting of the model, then of its parts; a layer has values that replace defaults, and their source."""
    every = _with_parts(model)
    defaults = resolve(every, *(values for values, _ in layers), {}, stage="").model_dump(mode="json")
    sources: dict[str, str] = {}
    for values, source in layers:
        sources |= dict.fromkeys(values, source)
    rows: dict[str, dict[str, Any]] = {}
    for home in (*model.__mro__, *every.__mro__):
        for name in inspect.get_annotations(home):
            if name not in every.model_fields or name in rows:
                continue
            field = every.model_fields[name]
            rows[name] = {
                "name": name,
                "type": getattr(field.annotation, "__name__", str(field.annotation)),
                "default": defaults[name],
                "unit": _details(field).get("unit", ""),
                "meaning": field.description or "",
                "source": sources.get(name, _details(field).get("source", "")),
                "allowed": _allowed(field),
                "part": (home.__doc__ or "").partition(".")[0],
            }
    return [*rows.values()]


def as_toml(stage: str, rows: Iterable[Mapping[str, Any]]) -> str:
    """Settings as :func:`described` has them, as a preset to edit."""
    lines = [f"[{stage}]"]
    for row in rows:
        allowed = f" ({row['allowed']})" if row["allowed"] else ""
        value = json.dumps(row["default"], ensure_ascii=False)
        lines += ["", f"# {row['meaning']}{allowed}", f"{row['name']} = {value}"]
    return "\n".join(lines) + "\n"


def near(word: str, candidates: Iterable[str]) -> str:
    """'Did you mean ...?' if a candidate is like ``word``; else empty."""
    close = difflib.get_close_matches(word, [*candidates], n=1)
    return f"Did you mean {close[0]!r}? " if close else ""


def _items(text: str, kind: Any) -> list[Any]:
    """The items between commas; of integers also ``3-7``."""
    items: list[Any] = []
    for part in filter(None, map(str.strip, text.split(","))):
        ends = re.fullmatch(r"(\d{1,9})-(\d{1,9})", part) if kind is int else None
        if kind is not int:
            items.append(part)
        elif ends is None:
            items.append(int(part))
        elif int(ends[1]) <= int(ends[2]) < int(ends[1]) + MOST:
            items += range(int(ends[1]), int(ends[2]) + 1)
        else:
            raise ValueError(f"a range goes up, over at most {MOST} integers")
    return items


def _number(value: Any, kind: Any) -> Any:
    """``3e5`` for an integer; True is no number."""
    if kind in (int, float) and isinstance(value, bool):
        raise ValueError("this must be a number")
    if kind is int and isinstance(value, str) and "e" in value.lower():
        return float(value)
    return value


def _details(field: FieldInfo) -> Mapping[str, Any]:
    details: Any = field.json_schema_extra
    return details or {}


def _allowed(field: FieldInfo) -> str:
    """The values that a setting may have, in a few words; empty if all of its type."""
    details = _details(field)
    if details.get("choices") is not None:
        others = [OWN] if details["own"] else []
        return "|".join([*map(str, details["choices"]), *others])
    low, high = ("" if details.get(bound) is None else details[bound] for bound in ("low", "high"))
    return "" if low == high == "" else f"{low} .. {high}".strip()


def _with_parts(model: type[C], values: Mapping[str, Any] | None = None) -> type[C]:
    """The model with the parts that ``values`` choose; without ``values`` with all parts."""
    parts = []
    for name, models in model.PARTS.items():
        value = OWN if values is None else str(values.get(name, model.model_fields[name].default))
        part = models.get(OWN if ":" in value else value)
        parts += [part] if part else []
    return _joined(model, *parts)


@cache
def _joined(model: type[C], *parts: type[Config]) -> Any:
    bases: list[Any] = []
    for base in (model, *parts):
        others = {model, *parts} - {base}
        if not any(issubclass(other, base) for other in others):
            bases.append(base)
    return bases[0] if len(bases) == 1 else create_model(model.__name__, __base__=tuple(bases), __doc__=model.__doc__)


def _choices_with(model: type[Config], name: str) -> list[str]:
    """The choices, SETTING=VALUE, that bring the setting ``name``."""
    choices = []
    for setting_name, models in model.PARTS.items():
        choices += [f"{setting_name}={value}" for value, part in models.items() if name in part.model_fields]
    return choices


def _refusal(model: type[Config], values: Mapping[str, Any], error: ValidationError, stage: str) -> UserError:
    """What is said of the first fault."""
    fault = error.errors()[0]
    name = str(fault["loc"][0])
    advice = f"See 'hypogoal config {stage}'."
    if name in model.model_fields:
        limits = _allowed(model.model_fields[name])
        where = f"{name}={fault['input']!r:.200} in {stage}"
        return UserError(fault["msg"].removeprefix("Value error, "), where, f"Allowed: {limits}." if limits else advice)
    if choices := _choices_with(model, name):
        chooses = choices[0].partition("=")[0]
        value = values.get(chooses, model.model_fields[chooses].default)
        return UserError(f"{chooses}={value} has no setting", name, f"It belongs to {', '.join(choices)}.")
    return UserError(f"{stage} has no setting", name, f"{near(name, _with_parts(model).model_fields)}{advice}")
