"""Experiments: generators of (name, command) whose keyword arguments are settings, or TOML files (Spec A6, G4).

::

    @experiment("doorkey", stages=("collect", "train-ensemble"))
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
from dataclasses import dataclass
from itertools import chain, product
from pathlib import Path
from typing import Annotated, Any, Literal, NamedTuple, TypeAlias, get_args, get_origin, get_type_hints

from pydantic import BaseModel, ConfigDict, ValidationError, create_model

from hypogoal.core.config import Config, integers, setting
from hypogoal.core.errors import UserError
from hypogoal.core.own_code import load, names_in, require_trust

MEND = "Mend the experiment or its settings, see docs/formats.md."
COMMON = ("workers", "evaluate")  # settings of every experiment

Value = str | int | float
Names: TypeAlias = tuple[str, ...]
Integers: TypeAlias = tuple[int, ...]


class Command(NamedTuple):
    """One command of an experiment."""

    name: str  # its place in the run's folder: ensemble/seed-0
    command: str  # as one would type it
    columns: Mapping[str, Value] = {}  # of results.csv: seed, method, ...


@dataclass(frozen=True)
class Experiment:
    """A named experiment, or one of a user."""

    name: str
    function: Callable[..., Iterable[Any]]  # of the settings, by keyword; yields Command or its fields
    config_class: type[Config]  # the settings of ``hypogoal run``: the function's, then those of all experiments
    domain: str | None = None  # whose presets and settings its stages take; None: each command says all itself
    stages: tuple[str, ...] = ()  # whose settings can be changed for all commands

    @property
    def settings(self) -> tuple[str, ...]:
        """The names of the function's settings."""
        return tuple(name for name in self.config_class.model_fields if name not in COMMON)

    def commands(self, settings: Mapping[str, Any], stage: Callable[[str], Any]) -> list[Command]:
        """What the function yields; ``stage`` gives a stage's settings. What is no command is a ``UserError``."""
        takes_stage = "stage" in inspect.signature(self.function).parameters
        rows = self.function(stage, **settings) if takes_stage else self.function(**settings)
        commands = []
        for row in rows:
            if (
                not isinstance(row, tuple)
                or not 2 <= len(row) <= 3
                or not all(isinstance(part, str) for part in row[:2])
            ):
                raise UserError("an experiment yields (name, command) or (name, command, columns)", self.name, MEND)
            commands.append(Command(*row))
        if not commands:
            raise UserError("no cells in this experiment", self.name, "Give its axes values.")
        return commands


def explained(meaning: str, **limits: Any) -> Mapping[str, Any]:
    """What a setting means, for its annotation; ``limits`` are those of :func:`hypogoal.core.config.setting`."""
    return {"meaning": meaning, **limits}


Layouts = Annotated[Integers, explained("layouts, each with an agent of its own", source="paper, Figure 6", low=0)]
Seeds = Annotated[Integers, explained("run seeds, each with ensembles of its own", low=0)]
Paired = Annotated[bool, explained("each layout with the seed at its place in the list, instead of all with all")]


def experiment(domain: str, *, stages: Sequence[str]) -> Callable[[Callable[..., Iterable[Any]]], Experiment]:
    """Makes a function an experiment on ``domain``.

    Presets, ``--device`` and settings of ``stages`` then apply to all its commands, and it may ask for the settings of
    a stage: ``def mine(stage, *, ...)`` has ``stage("train-meta").steps``.
    """

    def decorated(function: Callable[..., Iterable[Any]]) -> Experiment:
        return _experiment_of(function, domain, stages)

    return decorated


def load_experiment(name: str) -> Experiment:
    """The experiment ``module:function``; the user must have given the name or allowed it, else a ``UserError``."""
    target = load(name, "experiment", "hypogoal.experiments", {})
    if isinstance(target, Experiment):
        return target
    if not inspect.isgeneratorfunction(target):
        raise UserError("the object is not an experiment", name, "Give a generator of (name, command).")
    return _experiment_of(target)


def agents_of(layouts: Sequence[int], seeds: Sequence[int], *, paired: bool) -> list[tuple[int, int]]:
    """Layouts with seeds: the first with the first and so on if ``paired``, else all with all."""
    if not paired:
        return list(product(layouts, seeds))
    if len(layouts) != len(seeds):
        problem = f"{len(layouts)} layouts cannot be paired with {len(seeds)} seeds"
        raise UserError(problem, None, "Give as many of both, or paired=false for every layout with every seed.")
    return list(zip(layouts, seeds, strict=True))


def _experiment_of(
    function: Callable[..., Iterable[Any]], domain: str | None = None, stages: Sequence[str] = ()
) -> Experiment:
    """A function as an experiment whose settings are those that the function's signature describes."""
    fields = {}
    hints = get_type_hints(function, include_extras=True)
    for name, parameter in inspect.signature(function).parameters.items():
        if name == "stage" and domain:
            continue
        if parameter.kind is not parameter.KEYWORD_ONLY or parameter.default is parameter.empty or name in COMMON:
            do = "Make it keyword-only, a bool, int, float, str or a tuple of one of them, with a default."
            raise UserError("this argument of an experiment cannot be a setting", f"{function.__name__}: {name}", do)
        kind, metadata = hints[name], explained("")
        if get_origin(kind) is Annotated:
            kind, metadata = get_args(kind)
        fields[name] = (kind, setting(parameter.default, **metadata))
    return Experiment(function.__name__.replace("_", "-"), function, _run_config(fields), domain, (*stages,))


def _run_config(fields: Mapping[str, Any], workers: int = 0, evaluate: bool = True) -> type[Config]:
    """The settings of ``hypogoal run``: an experiment's own, by name (type, setting), then those of all experiments."""
    common = {
        "workers": (int, setting(workers, "cells at once; 0 for one per core", low=0, high=1024)),
        "evaluate": (bool, setting(evaluate, "evaluation and report at the end")),
    }
    return create_model("RunConfig", __base__=Config, __doc__="Which cells there are.", **{**fields, **common})


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


class _File(BaseModel):
    """A user's experiment in TOML."""

    model_config = ConfigDict(extra="forbid")

    format: Literal[1]
    axes: dict[str, list[Value] | str] = {}
    cells: list[_Cells]
    workers: int = 0
    evaluate: bool = True

    def commands(self, **axes: Sequence[Value]) -> Iterator[Command]:
        """In a command ``{AXIS}`` is its value, ``{NAME}`` the output of the cells of that name for the same values."""
        for row in self.cells:
            for values in product(*(axes[axis] for axis in row.axes)):
                point = dict(zip(row.axes, values, strict=True))
                others = [other for other in self.cells if point.keys() >= {*other.axes}]
                known = {**{other.name: f"@{other.at(point)}" for other in others}, **point}
                words = [word.format_map(known) for word in shlex.split(row.command)]
                for own in chain.from_iterable(map(names_in, [*words, *point.values()])):
                    require_trust(own, "setting")
                yield Command(row.at(point), shlex.join(words), {"group": row.name, **point})


def read_toml(path: Path) -> Experiment:
    """The experiment in a TOML file; a ``UserError`` where there is none."""
    try:
        file = _File.model_validate(tomllib.loads(path.read_text(encoding="utf-8-sig")))
    except (OSError, ValueError) as error:
        fault = error.errors()[0] if isinstance(error, ValidationError) else None
        reason = f"{'.'.join(map(str, fault['loc']))}: {fault['msg']}" if fault else str(error)
        raise UserError(f"the experiment cannot be read ({reason})", path, MEND) from None

    def commands(**axes: Any) -> list[Command]:
        try:
            return [*file.commands(**axes)]
        except (LookupError, ValueError, AttributeError) as error:
            problem = f"a command cannot be read, or names neither an axis of its cells nor cells over those ({error})"
            raise UserError(problem, path, MEND) from None

    axes = {
        name: tuple(integers(values)) if isinstance(values, str) else tuple(values)
        for name, values in file.axes.items()
    }
    settings = {name: (_kind(values), setting(values, "an axis")) for name, values in axes.items()}
    return Experiment(path.stem, commands, _run_config(settings, file.workers, file.evaluate))


def _kind(values: Sequence[Value]) -> Any:
    """What a setting of these values must be."""
    kinds = {type(value) for value in values}
    if kinds == {int}:
        return tuple[int, ...]
    return tuple[float, ...] if kinds == {float} else tuple[str, ...]
