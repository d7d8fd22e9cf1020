"""Experiments: generators of (name, command) whose keyword arguments are settings, or TOML files (Spec A6, G4).

::

    @experiment("doorkey")
    def members(*, seeds: Annotated[tuple[int, ...], explained("run seeds", low=0)] = (0, 1)):
        yield "data", "collect doorkey"
        for seed in seeds:
            yield f"ensemble/seed-{seed}", f"train-ensemble @data --seed {seed}", {"seed": seed}

A command is what one would type, without ``--out``; ``@data`` stands for the output of the command of that name.
"""

import inspect
import shlex
import tomllib
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from itertools import product
from pathlib import Path
from typing import Annotated, Any, Literal, NamedTuple, TypeAlias, get_type_hints

from pydantic import BaseModel, ConfigDict, Field, TypeAdapter, ValidationError, create_model

from hypogoal.cells import Value, reason
from hypogoal.core import own_code
from hypogoal.core.config import Config, setting
from hypogoal.core.errors import UserError

MEND = "Mend the experiment, see docs/formats.md."

Names: TypeAlias = tuple[str, ...]
Integers: TypeAlias = tuple[int, ...]


class Command(NamedTuple):
    """One command of an experiment."""

    name: str  # its place in the run's folder: ensemble/seed-0
    command: str  # as one would type it
    columns: Mapping[str, Value] = {}  # of results.csv: seed, method, ...


COMMANDS = TypeAdapter(list[Command])


class RunConfig(Config):
    """Which cells there are."""

    workers: int = setting(0, "cells at once; 0 for one per core", low=0, high=1024)
    evaluate: bool = setting(True, "evaluation and report at the end")


@dataclass(frozen=True)
class Experiment:
    """A named experiment, or one of a user."""

    name: str
    function: Callable[..., Iterable[Any]]  # of the settings, by keyword; yields Command or its fields
    model: type[RunConfig]  # the settings of ``hypogoal run``: those of all experiments, and the function's
    domain: str | None = None  # whose presets have settings of this experiment
    preset: str | None = None  # if no other is given
    given: Mapping[str, Any] = field(default_factory=dict)  # settings, unless others are given

    def commands(self, config: RunConfig, stage: Callable[[str], Any]) -> list[Command]:
        """What the function yields; ``stage`` gives a stage's settings. What is no command is a ``UserError``."""
        settings = config.model_dump(exclude={*RunConfig.model_fields})
        if "stage" in inspect.signature(self.function).parameters:
            settings["stage"] = stage
        try:
            return COMMANDS.validate_python([*self.function(**settings)])
        except ValidationError as error:
            problem = f"an experiment yields (name, command) or (name, command, columns) ({reason(error)})"
            raise UserError(
                problem,
                self.name,
                MEND,
            ) from None


def explained(meaning: str, **limits: Any) -> Any:
    """What a setting means, for its annotation; ``limits`` are those of :func:`hypogoal.core.config.setting`."""
    return setting(None, meaning, **limits)


Layouts = Annotated[Integers, explained("layouts, each with an agent of its own", source="paper, Figure 6", low=0)]
Seeds = Annotated[Integers, explained("run seeds, each with ensembles of its own", low=0)]
Paired = Annotated[bool, explained("each layout with the seed at its place in the list, instead of all with all")]


def experiment(domain: str | None = None, **more: Any) -> Callable[[Callable[..., Iterable[Any]]], Experiment]:
    """Makes a function an experiment on ``domain``, whose presets then may have settings of it; ``more``: a preset.

    It may ask for the settings of a stage: ``def mine(stage, *, ...)`` has ``stage("train-meta").steps``.
    """

    def decorated(function: Callable[..., Iterable[Any]]) -> Experiment:
        hints = get_type_hints(function, include_extras=True)
        fields: dict[str, Any] = {}
        for name, parameter in inspect.signature(function).parameters.items():
            if name == "stage":
                continue
            if name not in hints or parameter.default is parameter.empty or name in RunConfig.model_fields:
                where = f"{function.__name__}: {name}"
                raise UserError(
                    "this argument cannot be a setting",
                    where,
                    "Give it a type and a default.",
                )
            fields[name] = (hints[name], parameter.default)
        return Experiment(function.__name__.replace("_", "-"), function, _model_of(fields), domain, **more)

    return decorated


def _model_of(fields: Mapping[str, Any]) -> type[RunConfig]:
    return create_model("RunConfig", __base__=RunConfig, __doc__=RunConfig.__doc__, **fields)


def load_experiment(name: str) -> Experiment:
    """The experiment ``module:function``; the user must have given the name or allowed it, else a ``UserError``."""
    target = own_code.load(name, "experiment", "hypogoal.experiments", {})
    if isinstance(target, Experiment):
        return target
    if not inspect.isgeneratorfunction(target):
        raise UserError(
            "the object is not an experiment",
            name,
            "Give a generator of (name, command).",
        )
    return experiment()(target)


def agents_of(layouts: Sequence[int], seeds: Sequence[int], *, paired: bool) -> list[tuple[int, int]]:
    """Layouts with seeds: the first with the first and so on if ``paired``, else all with all."""
    if not paired:
        return list(product(layouts, seeds))
    if len(layouts) != len(seeds):
        problem = f"{len(layouts)} layouts cannot be paired with {len(seeds)} seeds"
        raise UserError(
            problem,
            None,
            "Give as many of both, or paired=false for every layout with every seed.",
        )
    return list(zip(layouts, seeds, strict=True))


class _Cells(BaseModel):
    """Of a TOML file: a command for each point of its axes."""

    model_config = ConfigDict(extra="forbid")

    name: str
    command: str
    axes: list[str] = []

    def at(self, point: Mapping[str, Value]) -> str:
        """The cell's name: NAME, or NAME/AXIS-VALUE-AXIS-VALUE."""
        values = "-".join(f"{axis}-{point[axis]}" for axis in self.axes)
        return f"{self.name}/{values}" if values else self.name


class _File(RunConfig):
    """A user's experiment in TOML."""

    format: Literal[1]
    axes: dict[str, list[Value] | str] = Field(default_factory=dict)
    cells: list[_Cells]

    def commands(self, axes: Mapping[str, Sequence[Value]]) -> Iterator[Command]:
        """In a command ``{AXIS}`` is its value, ``{NAME}`` the output of the cells of that name for the same values."""
        for row in self.cells:
            for values in product(*(axes[axis] for axis in row.axes)):
                point = dict(zip(row.axes, values, strict=True))
                known: dict[str, Value] = {}
                for other in self.cells:
                    if point.keys() >= {*other.axes}:
                        known[other.name] = f"@{other.at(point)}"
                words = [word.format_map(known | point) for word in shlex.split(row.command)]
                for name in own_code.names_in(",".join(words)):
                    own_code.require_trust(name, "setting")
                yield Command(row.at(point), shlex.join(words), {"group": row.name, **point})


def read_toml(path: Path) -> Experiment:
    """The experiment in a TOML file; a ``UserError`` where there is none."""
    with _readable(path):
        file = _File.model_validate(tomllib.loads(path.read_text(encoding="utf-8-sig")))
        fields: dict[str, Any] = {}
        for name, axis in file.axes.items():
            kind: Any = int if isinstance(axis, str) else type(axis[0])
            fields[name] = (tuple[kind, ...], ())
        model = _model_of(fields)

    def commands(**axes: Any) -> list[Command]:
        with _readable(path):
            return [*file.commands(axes)]

    given = {"workers": file.workers, "evaluate": file.evaluate, **file.axes}
    return Experiment(path.stem, commands, model, given=given)


@contextmanager
def _readable(path: Path) -> Iterator[None]:
    try:
        yield
    except (OSError, ValueError, LookupError, NameError, AttributeError) as error:
        raise UserError(
            f"the experiment cannot be read ({reason(error)})",
            path,
            MEND,
        ) from None
