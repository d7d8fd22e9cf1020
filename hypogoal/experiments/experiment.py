"""Experiments as Python functions: generators of (name, command) whose keyword arguments are settings (Spec A6, G4).

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
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, make_dataclass
from itertools import islice, product
from typing import Annotated, Any, TypeAlias, get_args, get_origin, get_type_hints

from hypogoal.core.config import setting
from hypogoal.core.errors import UserError
from hypogoal.core.own_code import load

MAX_CELLS = 20_000
MEND = "Mend the experiment or its settings, see docs/formats.md."
KINDS = (bool, int, float, str, tuple[int, ...], tuple[float, ...], tuple[str, ...])
COMMON = ("workers", "evaluate")  # settings of every experiment

Value = str | int | float
Names: TypeAlias = tuple[str, ...]
Integers: TypeAlias = tuple[int, ...]


@dataclass(frozen=True)
class Command:
    """One command of an experiment."""

    name: str  # its place in the run's folder: ensemble/seed-0
    command: str | Sequence[str]  # as one would type it, or its words
    columns: Mapping[str, Value] = field(default_factory=dict)  # of results.csv: seed, method, ...

    @property
    def words(self) -> list[str]:
        """The command, split as a shell does."""
        try:
            return shlex.split(self.command) if isinstance(self.command, str) else [*self.command]
        except (ValueError, TypeError) as error:
            raise UserError(f"the command cannot be read ({error})", f"cell {self.name!r}", MEND) from None


@dataclass(frozen=True)
class Experiment:
    """A named experiment, or one of a user."""

    name: str
    function: Callable[..., Iterable[Any]]  # of the settings, by keyword; yields Command or its fields
    config_class: type  # the settings of ``hypogoal run``: the function's, then those of all experiments
    domain: str | None = None  # whose presets and settings its stages take; None: each command says all itself
    stages: tuple[str, ...] = ()  # whose settings can be changed for all commands

    @property
    def settings(self) -> tuple[str, ...]:
        """The names of the function's settings."""
        return tuple(name for name in inspect.get_annotations(self.config_class) if name not in COMMON)

    def commands(self, settings: Mapping[str, Any], stage: Callable[[str], Any]) -> Iterator[Command]:
        """What the function yields; ``stage`` gives a stage's settings. What is no command is a ``UserError``."""
        takes_stage = "stage" in inspect.signature(self.function).parameters
        rows = list(islice(self.function(*[stage][:takes_stage], **settings), MAX_CELLS + 1))
        if len(rows) > MAX_CELLS:
            raise UserError(f"more than {MAX_CELLS} cells", self.name, "Take fewer values.")
        for row in rows:
            command = Command(*row) if isinstance(row, tuple) and 2 <= len(row) <= 3 else row
            parts = (command.name, *command.words) if isinstance(command, Command) else (None,)
            if not all(isinstance(part, str) for part in parts):
                raise UserError("an experiment yields (name, command) or (name, command, columns)", self.name, MEND)
            yield command


def explained(meaning: str, **limits: Any) -> Mapping[str, Any]:
    """What a setting means, for its annotation; ``limits`` are those of :func:`hypogoal.core.config.setting`."""
    metadata: Mapping[str, Any] = setting(None, meaning, **limits).metadata
    return metadata


Layouts = Annotated[Integers, explained("layouts, each with an agent of its own", source="paper, Figure 6", low=0)]
Seeds = Annotated[Integers, explained("run seeds, each with ensembles of its own", low=0)]
Paired = Annotated[bool, explained("each layout with the seed at its place in the list, instead of all with all")]


def experiment(domain: str, *, stages: Sequence[str]) -> Callable[[Callable[..., Iterable[Any]]], Experiment]:
    """Makes a function an experiment on ``domain``; the arguments are those of :class:`Experiment`.

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


def run_config(fields: Sequence[tuple[str, Any, Any]], workers: int = 0, evaluate: bool = True) -> type:
    """The settings of ``hypogoal run``: an experiment's own, then those of all experiments."""
    common: list[tuple[str, Any, Any]] = [
        ("workers", int, setting(workers, "cells at once; 0 for one per core", low=0, high=1024)),
        ("evaluate", bool, setting(evaluate, "evaluation and report at the end")),
    ]
    namespace = {"__doc__": "Which cells there are."}
    return make_dataclass("RunConfig", [*fields, *common], namespace=namespace, frozen=True)


def _experiment_of(
    function: Callable[..., Iterable[Any]], domain: str | None = None, stages: Sequence[str] = ()
) -> Experiment:
    """A function as an experiment whose settings are those that the function's signature describes."""
    fields = []
    hints = get_type_hints(function, include_extras=True)
    for name, parameter in inspect.signature(function).parameters.items():
        if name == "stage" and domain:
            continue
        kind, metadata = hints.get(name), explained("")
        if get_origin(kind) is Annotated:
            kind, metadata = get_args(kind)
        is_setting = parameter.kind is parameter.KEYWORD_ONLY and parameter.default is not parameter.empty
        if kind not in KINDS or not is_setting or name in COMMON:
            do = "Make it keyword-only, a bool, int, float, str or a tuple of one of them, with a default."
            raise UserError("this argument of an experiment cannot be a setting", f"{function.__name__}: {name}", do)
        fields.append((name, kind, setting(parameter.default, **metadata)))
    return Experiment(function.__name__.replace("_", "-"), function, run_config(fields), domain, (*stages,))
