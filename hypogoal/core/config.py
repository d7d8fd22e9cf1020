"""Settings: a pydantic model for each stage, whose fields have a default, a meaning, a unit, a source and limits.

Precedence: ``--set`` > option > preset > the domain's default > default. Settings that only one learner or chooser has
are in a model of their own, which is a field of the stage's model, see :func:`part`. The names of such settings are
flat all the same: on the command line, in presets, in manifests.
"""

import difflib
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from math import inf
from pkgutil import resolve_name
from typing import Any, Self, TypeVar, get_args, get_origin

from pydantic import (
    BaseModel,
    ConfigDict,
    Field,
    ValidationError,
    ValidationInfo,
    field_validator,
)
from pydantic.fields import FieldInfo

from hypogoal.core.errors import UserError

C = TypeVar("C", bound="Config")
Values = Mapping[str, Any]  # values of settings, by name
DOMAIN = "doorkey"  # the domain whose presets and defaults hold if no domain is named
MODELS = {  # by stage, except collect, whose model is its domain's, and run, whose model is its experiment's
    "train-ensemble": "hypogoal.hypotheses.config:TrainEnsembleConfig",
    "train-options": "hypogoal.meta.config:TrainOptionsConfig",
    "train-meta": "hypogoal.meta.config:TrainMetaConfig",
    "train-baseline": "hypogoal.baselines.settings:BaselineConfig",
    "audit": "hypogoal.meta.config:AuditConfig",
}
STAGES = ("collect", *MODELS)
OWN = "module:object"  # stands for any name of a user's own code, among choices and parts
MOST = 10_000  # the largest number of integers that one range may stand for


class Config(BaseModel):
    """The settings of a stage or of a part of it. Unknown names and values that are not allowed are refused."""

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)

    @classmethod
    def of(cls, **values: Any) -> Self:
        """Return the settings with these values, and with the parts that the values choose.

        Values of parts that are not chosen have no effect.
        """
        return resolve(cls, values, {}, stage=cls.__name__)

    def part(self, kind: type[C]) -> C:
        """Return the part that is a ``kind``. Raises ``TypeError`` if the settings have chosen no such part."""
        for name in parts_of(type(self)):
            chosen = getattr(self, name)
            if isinstance(chosen, kind):
                return chosen
        raise TypeError(f"these settings have no {kind.__name__}")

    def flat(self) -> dict[str, Any]:
        """Return all settings by name, also those of parts, as JSON has them."""
        parts = parts_of(type(self))
        values = self.model_dump(mode="json", exclude={*parts})
        for name in parts:
            chosen = getattr(self, name)
            values |= chosen.flat() if chosen else {}
        return values

    @field_validator("*", mode="wrap")
    @classmethod
    def _read(cls, raw: Any, as_field: Callable[[Any], Any], info: ValidationInfo) -> Any:
        field = cls.model_fields[str(info.field_name)]
        if info.field_name in parts_of(cls):
            return as_field(raw)
        value = as_field(_typed(raw, field.annotation))
        for item in value if isinstance(value, tuple) else (value,):
            if not details_of(field).allow(item):
                raise ValueError("value not allowed")
        return value


@dataclass(frozen=True)
class Details:
    """What is said of a setting, and which values are allowed.

    If there are ``choices``, the value must be among them, or be a ``module:object`` if ``own`` is true. Otherwise the
    value must be within ``low`` to ``high``, or be one of ``words``. For a tuple, each item must be allowed.
    """

    unit: str = ""
    source: str = ""
    low: float = -inf
    high: float = inf
    words: Sequence[str] = ()
    choices: Sequence[Any] | Mapping[Any, Any] = ()
    own: bool = False

    def allow(self, value: Any) -> bool:
        """Return whether the setting may have this value."""
        if self.choices:
            return value in self.choices or (self.own and ":" in value)
        if value in self.words:
            return True
        return not self.is_bounded or self.low <= value <= self.high

    @property
    def is_bounded(self) -> bool:
        """Whether there is a lowest or a highest value."""
        return self.low > -inf or self.high < inf

    def __str__(self) -> str:
        """Return the allowed values in a few words.

        The text is empty if all values of the setting's type are allowed.
        """
        if self.choices:
            choices = [str(choice) for choice in self.choices]
            if self.own:
                choices.append(OWN)
            return "|".join(choices)
        numbers = [f"{self.low} .. {self.high}"] if self.is_bounded else []
        return "|".join([*self.words, *numbers])


@dataclass(frozen=True)
class Choice:
    """The model of a part, by the value of a setting.

    ``by`` is the name of the setting, and ``models`` has the model that each of its values brings. A value that names a
    user's own code brings the model ``OWN``, which has the settings of all models.
    """

    by: str
    models: Mapping[str, type[Config]]

    def model(self, value: str) -> type[Config] | None:
        """Return the model that a value brings, or None if it brings none."""
        return self.models.get(OWN if ":" in value else value)

    @property
    def whole(self) -> type[Config]:
        """The model that has the settings of all models."""
        return self.models[OWN]


def part(by: str, models: Mapping[str, type[Config]]) -> Any:
    """Return a field of a ``Config`` that is a part, see :class:`Choice`.

    The field is None if the value of the setting ``by`` brings no model.
    """
    return Field(None, json_schema_extra={"part": Choice(by, models)})  # type: ignore[dict-item]


@cache
def parts_of(model: type[Config]) -> dict[str, Choice]:
    """Return the fields of a model that are parts, by name."""
    extras: dict[str, Any] = {name: field.json_schema_extra or {} for name, field in model.model_fields.items()}
    return {name: extra["part"] for name, extra in extras.items() if "part" in extra}


def setting(default: Any, meaning: str, **details: Any) -> Any:
    """Return a field of a ``Config``: a setting with its default, its meaning, and its unit, source and limits.

    ``details`` are the fields of :class:`Details`. ``unit`` and ``source`` are texts. ``low`` and ``high`` are the
    limits of a number, ``words`` are texts that are allowed beside numbers, and ``choices`` are all values that are
    allowed. With ``own``, a ``module:object`` is allowed, too.
    """
    return Field(default, description=meaning, json_schema_extra={"details": Details(**details)})  # type: ignore[dict-item]


def model_of(stage: str) -> type[Config]:
    """Return the model of the settings of a stage, one of ``MODELS``."""
    return resolve_name(MODELS[stage])


def assigned(assignments: Iterable[str]) -> dict[str, str]:
    """Parse texts: ``["steps=300", ...]`` becomes ``{"steps": "300", ...}``.

    Raises ``UserError`` if a text is not ``key=value``.
    """
    values = {}
    for assignment in assignments:
        key, equals, value = assignment.partition("=")
        if not equals or not key.strip():
            raise UserError("--set needs key=value", repr(assignment), "For example --set steps=300.")
        values[key.strip().replace("-", "_")] = value.strip()
    return values


def integers(text: str) -> list[int]:
    """Parse integers: ``0-3,7`` becomes ``[0, 1, 2, 3, 7]``. Raises ``UserError`` for anything else."""
    try:
        return _items(text, int)
    except ValueError as error:
        raise UserError(str(error), repr(text[:200]), "Write them as 0-3,7.") from None


def resolve(model: type[C], *layers: Values, stage: str) -> C:
    """Return the settings of ``stage``: the model, and the parts that its settings choose. Later layers win.

    None stands for a value that is not given. The last layer is what the user typed. In the last layer, a setting of a
    part that is not chosen is refused. The other layers, a domain's defaults and a preset, may have such settings,
    without effect. Raises ``UserError`` for what is refused.
    """
    values: dict[str, Any] = {}
    for layer in layers:
        values |= {name: value for name, value in layer.items() if value is not None}
    for field, choice in parts_of(model).items():
        part_values = {name: values.pop(name) for name in choice.whole.model_fields if name in values}
        chosen = choice.model(str(values.get(choice.by, model.model_fields[choice.by].default)))
        names = chosen.model_fields if chosen else {}
        for name in part_values:
            if name not in names and layers[-1].get(name) is not None:
                fault = f"{stage} has this setting only beside another choice"
                raise UserError(fault, name, f"See 'hypogoal config {stage}'.")
        if chosen:
            of_part = {name: value for name, value in part_values.items() if name in names}
            values[field] = validated(chosen, of_part, model, stage)
    return validated(model, values, model, stage)


def validated(kind: type[C], values: Values, model: type[Config], stage: str) -> C:
    """Return settings of this kind, which is ``model`` itself or a part of it.

    Raises ``UserError`` if a value is not allowed.
    """
    try:
        return kind.model_validate(values)
    except ValidationError as error:
        raise _refusal(kind, model, error, stage) from None


def homes_of(model: type[Config]) -> list[type[Config]]:
    """Return the model, followed by the models of all its parts."""
    return [model, *(choice.whole for choice in parts_of(model).values())]


def names_of(model: type[Config]) -> list[str]:
    """Return the names of all settings of the model and of its parts."""
    names: list[str] = []
    for home in homes_of(model):
        names += home.model_fields
    return [name for name in names if name not in parts_of(model)]


def known(model: type[Config], values: Values) -> dict[str, Any]:
    """Return the values of a manifest or data file whose names the model or a part of it has.

    Files of earlier versions may have other names, which are left out.
    """
    return {name: values[name] for name in names_of(model) if name in values}


def _typed(raw: Any, kind: Any) -> Any:
    """Return what the user typed in a form that pydantic takes.

    A tuple becomes a list of its items. ``3e5`` becomes a number if an integer is needed. True and False are refused
    where a number is needed.
    """
    if get_origin(kind) is tuple:
        kind, *_ = get_args(kind)
        items = _items(raw, kind) if isinstance(raw, str) else raw
        if not isinstance(items, list | tuple):
            return items
        return [_typed(item, kind) for item in items]
    kinds = get_args(kind) or (kind,)
    if (int in kinds or float in kinds) and isinstance(raw, bool):
        raise ValueError("this must be a number")
    if kind is int and isinstance(raw, str) and "e" in raw.lower():
        return float(raw)
    return raw


def _items(text: str, kind: Any) -> list[Any]:
    """Return the items between commas. Integers can also be given as a range, ``3-7``."""
    parts = [part.strip() for part in text.split(",") if part.strip()]
    if kind is not int:
        return parts
    numbers: list[int] = []
    for part in parts:
        start, dash, end = part.partition("-")
        try:
            first = int(start)
            last = int(end) if dash else first
        except ValueError:
            raise ValueError("not integers") from None
        if not first <= last < first + MOST:
            raise ValueError(f"a range goes up, over at most {MOST} integers")
        numbers += range(first, last + 1)
    return numbers


def details_of(field: FieldInfo) -> Details:
    """Return what :func:`setting` said of a field."""
    extra: Any = field.json_schema_extra or {}
    return extra.get("details", Details())


def _refusal(kind: type[Config], model: type[Config], error: ValidationError, stage: str) -> UserError:
    """Return the error that describes the first fault in settings of this kind.

    The kind is ``model`` itself or a part of it.
    """
    fault = error.errors()[0]
    name = str(fault["loc"][0])
    advice = f"See 'hypogoal config {stage}'."
    if name in kind.model_fields:
        allowed = str(details_of(kind.model_fields[name]))
        where = f"{name}={fault['input']!r:.200} in {stage}"
        do = f"Allowed: {allowed}." if allowed else advice
        return UserError(fault["msg"].removeprefix("Value error, "), where, do)
    if stage == "run":
        advice = f"Of a stage: --set STAGE.{name}=VALUE. {advice}"
    for close in difflib.get_close_matches(name, names_of(model), n=1):
        advice = f"Did you mean {close!r}? {advice}"
    return UserError(f"{stage} has no setting", name, advice)
