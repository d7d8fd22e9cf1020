"""Experiments, by name: one that comes with hypogoal, a TOML file, a function of one's own.

They are generators of (name, command) whose keyword arguments are settings.

::

    @experiment("doorkey")
    def members(*, seeds: tuple[int, ...] = setting((0, 1), "run seeds", low=0)):
        yield "data", "collect doorkey"
        for seed in seeds:
            yield f"ensemble/seed-{seed}", f"train-ensemble @data --seed {seed}", {"seed": seed}

A command is what one would type, without ``--out``; ``@data`` stands for the output of the command of that name.
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
from hypogoal.domains.base import load_domain

STAGE = "stage"  # an argument that is no setting: gives a stage's settings, as in stage("train-meta").steps
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
Function = Callable[..., Iterable[Any]]  # of settings, by keyword; yields Command or its fields
Columns = Mapping[str, Value]  # of results.csv: seed, method, ...


class Command(NamedTuple):
    """One command of an experiment."""

    name: str  # its place in the run's folder: ensemble/seed-0
    command: str  # as one would type it
    columns: Mapping[str, Value] = {}
    after: Sequence[str] = ()  # names of commands that have this machine's cores before it


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
    domain: str | None = None  # whose presets have settings of this experiment
    preset: str | None = None  # if no other is given
    given: Values = field(default_factory=dict)  # settings, unless others are given


def experiment(domain: str | None = None, preset: str | None = None) -> Callable[[Function], Experiment]:
    """Makes a function an experiment on ``domain``, whose presets then may have settings of it."""

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
    """The settings of all experiments and these: (type, default) by name."""
    return create_model("RunConfig", __base__=RunConfig, __doc__=RunConfig.__doc__, **fields)


def agents_of(layouts: Sequence[int], seeds: Sequence[int]) -> list[tuple[int, int]]:
    """Layouts with seeds: each with the one at its place; a single one goes with all of the others."""
    try:
        pairs = np.broadcast_arrays(layouts, seeds)
    except ValueError:
        problem = f"{len(layouts)} layouts cannot be paired with {len(seeds)} seeds"
        raise UserError(problem, None, "Give as many of both, or one for all.") from None
    return [*map(tuple, np.transpose(pairs).tolist())]


def find_experiment(name: str) -> Experiment:
    """One of ``EXPERIMENTS``, a TOML file, or ``module:function``; an unknown one is a ``UserError``."""
    if name.endswith(".toml"):
        return read_toml(Path(name))
    target = own_code.load(name, "experiment", "hypogoal.experiments", EXPERIMENTS)
    if isinstance(target, Experiment):
        return target
    if not inspect.isfunction(target):
        raise UserError("the object is not an experiment", name, "Give a generator of (name, command).")
    return experiment()(target)


def config_class_of(stage: str, domain: str = DOMAIN) -> Any:
    """The settings of a stage, by its command's name; of ``run`` those of the domain's experiment, if there is one."""
    if stage == "collect":
        return load_domain(domain).config_class
    if stage in MODELS:
        return model_of(stage)
    if stage != "run":
        raise UserError("no such stage", stage, f"Choose one of {', '.join(STAGES)}, run.")
    models = {experiment.domain: experiment.model for experiment in map(find_experiment, reversed(EXPERIMENTS))}
    return models.get(domain, RunConfig)


class Row(Config):
    """Of a TOML file: a command for each point of its axes."""

    name: str
    command: str
    axes: tuple[str, ...] = ()

    def at(self, point: Mapping[str, Value]) -> str:
        """The cell's name: NAME, or NAME/AXIS-VALUE-AXIS-VALUE."""
        values = "-".join(f"{axis}-{point[axis]}" for axis in self.axes)
        return f"{self.name}/{values}" if values else self.name


class File(RunConfig):
    """A user's experiment in TOML."""

    format: Literal[1]
    axes: dict[str, list[Value] | str] = Field(default_factory=dict)
    cells: list[Row]

    def commands(self, axes: Mapping[str, Sequence[Value]]) -> Iterator[Command]:
        """In a command ``{AXIS}`` is its value, ``{NAME}`` the output of the cells of that name for the same values."""
        for row in self.cells:
            for values in product(*(axes[axis] for axis in row.axes)):
                point = dict(zip(row.axes, values, strict=True))
                others = [other for other in self.cells if point.keys() >= {*other.axes}]
                places = {other.name: f"@{other.at(point)}" for other in others}
                command = row.command.format_map(places | point)
                for name in own_code.names_in(command):
                    own_code.require_trust(name, "setting")
                yield Command(row.at(point), command, {"group": row.name, **point})


def read_toml(path: Path) -> Experiment:
    """The experiment in a TOML file; a ``UserError`` where there is none."""
    readable = partial(reading, path, "Mend the file, see docs/formats.md.", "the experiment")
    with readable():
        text = path.read_text(encoding="utf-8-sig")
        file = File.model_validate(tomllib.loads(text))
        fields = {}
        for name, axis in file.axes.items():
            kind: Any = int if isinstance(axis, str) else type(axis[0])
            fields[name] = (tuple[kind, ...], ())
        model = run_config(fields)

    @readable()
    def commands(**axes: Any) -> list[Command]:
        return [*file.commands(axes)]

    defaults = {"workers": file.workers, "evaluate": file.evaluate, **file.axes}
    return Experiment(commands, [*fields], model, given=defaults)
