"""Experiments by name: one that comes with hypogoal, a TOML file, or a user's own function.

An experiment is a generator of (name, command). Its keyword arguments are settings.

::

    @experiment("doorkey")
    def members(*, seeds: tuple[int, ...] = setting((0, 1), "run seeds", low=0)):
        yield "data", "collect doorkey"
        for seed in seeds:
            yield f"ensemble/seed-{seed}", f"train-ensemble @data --seed {seed}", {"seed": seed}

A command is what one would type, without ``--out``. ``@data`` stands for the output of the command named ``data``.
"""

import inspect
import tomllib
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from itertools import product
from pathlib import Path
from typing import Any, Literal, NamedTuple, get_type_hints

import numpy as np
from pydantic import Field, create_model

from hypogoal.cells import Value
from hypogoal.core import own_code
from hypogoal.core.config import DOMAIN, MODELS, STAGES, Config, Values, model_of, setting
from hypogoal.core.errors import UserError
from hypogoal.core.files import reading
from hypogoal.domains.find import load_domain

STAGE = "stage"  # an argument that gives a stage's settings, as in stage("train-meta").steps, and is none itself
LAYOUTS = "layouts, each with an agent of its own"
SEEDS = "run seeds, each with ensembles of its own"
EXPERIMENTS = {
    "doorkey": "hypogoal.experiments.built_in:doorkey",
    "choosing": "hypogoal.experiments.built_in:choosing",
    "montezuma-ladders": "hypogoal.experiments.built_in:montezuma_ladders",
    "rooms": "hypogoal.experiments.built_in:rooms",
    "figure3": "hypogoal.experiments.built_in:figure3",
    "figure4": "hypogoal.experiments.built_in:figure4",
    "figure6": "hypogoal.experiments.built_in:figure6",
}
Names = tuple[str, ...]
Integers = tuple[int, ...]
Function = Callable[..., Iterable[Any]]  # takes settings by keyword, and yields Command or its fields
Columns = Mapping[str, Value]  # columns of results.csv: seed, method, ...


class Command(NamedTuple):
    """One command of an experiment."""

    name: str  # the output's place in the run's folder, such as ensemble/seed-0
    command: str  # as one would type it
    columns: Mapping[str, Value] = {}
    after: Sequence[str] = ()  # names of commands that get this machine's cores first


class RunConfig(Config):
    """Which cells there are."""

    workers: int = setting(0, "cells at once; 0 for one per core", low=0, high=1024)
    evaluate: bool = setting(True, "evaluation and report at the end")


@dataclass(frozen=True)
class Experiment:
    """An experiment that comes with hypogoal, or one of a user."""

    function: Function
    arguments: Sequence[str]
    model: type[RunConfig]  # the settings of ``hypogoal run``: those of all experiments, and the function's
    domain: str | None = None  # the domain whose presets have settings of this experiment
    preset: str | None = None  # the preset, unless another is given
    given: Values = field(default_factory=dict)  # settings, unless others are given


def experiment(domain: str | None = None, preset: str | None = None) -> Callable[[Function], Experiment]:
    """Return a decorator that makes a function an experiment.

    The presets of ``domain`` may then have settings of the experiment.
    """

    def decorated(function: Function) -> Experiment:
        hints = get_type_hints(function)
        parameters = inspect.signature(function).parameters
        fields = {}
        for name, parameter in parameters.items():
            if name == STAGE:
                continue
            is_required = parameter.default is parameter.empty
            fields[name] = (hints.get(name, Any), ... if is_required else parameter.default)
        return Experiment(function, [*parameters], run_config(fields), domain, preset)

    return decorated


def run_config(fields: Mapping[str, Any]) -> type[RunConfig]:
    """Return a class of the settings of all experiments and of ``fields``, (type, default) by name."""
    return create_model("RunConfig", __base__=RunConfig, __doc__=RunConfig.__doc__, **fields)


def agents_of(layouts: Sequence[int], seeds: Sequence[int]) -> list[tuple[int, int]]:
    """Return pairs of layouts and seeds: each layout with the seed at its place. A single one goes with all others.

    Raises ``UserError`` if they cannot be paired.
    """
    try:
        pairs = np.broadcast_arrays(layouts, seeds)
    except ValueError:
        problem = f"{len(layouts)} layouts cannot be paired with {len(seeds)} seeds"
        raise UserError(problem, None, "Give as many of both, or one for all.") from None
    return [*map(tuple, np.transpose(pairs).tolist())]


def find_experiment(name: str) -> Experiment:
    """Return one of ``EXPERIMENTS``, the experiment in a TOML file, or ``module:function``.

    Raises ``UserError`` if there is no such experiment.
    """
    if name.endswith(".toml"):
        return read_toml(Path(name))
    target = own_code.load(name, "experiment", "hypogoal.experiments", EXPERIMENTS)
    if isinstance(target, Experiment):
        return target
    if not inspect.isfunction(target):
        raise UserError("the object is not an experiment", name, "Give a generator of (name, command).")
    return experiment()(target)


def config_class_of(stage: str, domain: str = DOMAIN) -> Any:
    """Return the class of a stage's settings, by the name of its command.

    The class of ``run`` is that of the domain's experiment, if there is one.
    """
    if stage == "collect":
        return load_domain(domain).config_class
    if stage in MODELS:
        return model_of(stage)
    if stage != "run":
        raise UserError("no such stage", stage, f"Choose one of {', '.join(STAGES)}, run.")
    models = {experiment.domain: experiment.model for experiment in map(find_experiment, reversed(EXPERIMENTS))}
    return models.get(domain, RunConfig)


class Row(Config):
    """Cells in a TOML file: a command for each point of its axes."""

    name: str
    command: str
    axes: tuple[str, ...] = ()

    def at(self, point: Mapping[str, Value]) -> str:
        """Return the name of the cell at a point: NAME, or NAME/AXIS-VALUE-AXIS-VALUE."""
        values = "-".join(f"{axis}-{point[axis]}" for axis in self.axes)
        return f"{self.name}/{values}" if values else self.name


class File(RunConfig):
    """A user's experiment in TOML."""

    format: Literal[1]
    axes: dict[str, list[Value] | str] = Field(default_factory=dict)
    cells: list[Row]

    def commands(self, axes: Mapping[str, Sequence[Value]]) -> Iterator[Command]:
        """Yield the commands. In a command, ``{AXIS}`` stands for the axis's value.

        ``{NAME}`` stands for the output of the cells of that name at these values.
        """
        for row in self.cells:
            for values in product(*(axes[axis] for axis in row.axes)):
                point = dict(zip(row.axes, values, strict=True))
                others = [other for other in self.cells if point.keys() >= {*other.axes}]
                places = {other.name: f"@{other.at(point)}" for other in others}
                command = row.command.format_map(places | point)
                for name in own_code.names_in(command):
                    own_code.require_trust(name, "setting")
                yield Command(row.at(point), command, {"group": row.name, **point})


def _kind_of(axis: Sequence[Value]) -> Any:
    """Return the type of an axis's values. Integers beside other numbers are such numbers, too."""
    if isinstance(axis, str):  # integers, such as 0-9
        return int
    kinds = {type(value) for value in axis}
    return float if kinds == {int, float} else type(axis[0])


def read_toml(path: Path) -> Experiment:
    """Return the experiment in a TOML file. Raises ``UserError`` if there is none."""
    readable = partial(reading, path, "Mend the file, see docs/formats.md.", "the experiment")
    with readable():
        text = path.read_text(encoding="utf-8-sig")
        file = File.model_validate(tomllib.loads(text))
        fields = {}
        for name, axis in file.axes.items():
            kind: Any = _kind_of(axis)
            fields[name] = (tuple[kind, ...], ())
        model = run_config(fields)

    @readable()
    def commands(**axes: Any) -> list[Command]:
        return [*file.commands(axes)]

    defaults = {"workers": file.workers, "evaluate": file.evaluate, **file.axes}
    return Experiment(commands, [*fields], model, given=defaults)
