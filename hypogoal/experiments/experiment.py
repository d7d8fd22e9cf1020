"""Experiments: generators of (name, command) whose keyword arguments are settings (Spec A6, G4).

::

    @experiment("doorkey")
    def members(*, seeds: tuple[int, ...] = setting((0, 1), "run seeds", low=0)):
        yield "data", "collect doorkey"
        for seed in seeds:
            yield f"ensemble/seed-{seed}", f"train-ensemble @data --seed {seed}", {"seed": seed}

A command is what one would type, without ``--out``; ``@data`` stands for the output of the command of that name.
"""

import inspect
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, NamedTuple, TypeAlias, get_type_hints

import numpy as np
from pydantic import create_model

from hypogoal.cells import Value
from hypogoal.core.config import Config, setting
from hypogoal.core.errors import UserError

STAGE = "stage"  # an argument that is no setting: gives a stage's settings, as in stage("train-meta").steps
LAYOUTS = "layouts, each with an agent of its own"
SEEDS = "run seeds, each with ensembles of its own"

Names: TypeAlias = tuple[str, ...]
Integers: TypeAlias = tuple[int, ...]
Function: TypeAlias = Callable[..., Iterable[Any]]  # of settings, by keyword; yields Command or its fields


Columns: TypeAlias = Mapping[str, Value]  # of results.csv: seed, method, ...


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
    given: Mapping[str, Any] = field(default_factory=dict)  # settings, unless others are given


def experiment(domain: str | None = None, preset: str | None = None) -> Callable[[Function], Experiment]:
    """Makes a function an experiment on ``domain``, whose presets then may have settings of it."""

    def decorated(function: Function) -> Experiment:
        hints = get_type_hints(function)
        parameters = inspect.signature(function).parameters
        fields: dict[str, Any] = {}
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
