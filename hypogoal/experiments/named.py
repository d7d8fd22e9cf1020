"""An experiment by its name: one that comes with hypogoal, a TOML file, a function of one's own."""

import inspect
import tomllib
from collections.abc import Iterator, Mapping, Sequence
from functools import partial
from itertools import product
from pathlib import Path
from typing import Any, Literal

from pydantic import Field

from hypogoal.cells import Value
from hypogoal.core import own_code
from hypogoal.core.config import DOMAIN, MODELS, STAGES, Config, model_of
from hypogoal.core.errors import UserError
from hypogoal.core.files import reading
from hypogoal.domains.base import load_domain
from hypogoal.experiments.experiment import Command, Experiment, RunConfig, experiment, run_config

EXPERIMENTS = {
    "doorkey": "hypogoal.experiments.doorkey:doorkey",
    "choosing": "hypogoal.experiments.choosing:choosing",
    "montezuma-ladders": "hypogoal.experiments.ladders:montezuma_ladders",
    "rooms": "hypogoal.experiments.rooms:rooms",
    "figure3": "hypogoal.experiments.ladders:figure3",
    "figure4": "hypogoal.experiments.ladders:figure4",
    "figure6": "hypogoal.experiments.doorkey:figure6",
}


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
                places: dict[str, Value] = {other.name: f"@{other.at(point)}" for other in others}
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
        fields: dict[str, Any] = {}
        for name, axis in file.axes.items():
            kind: Any = int if isinstance(axis, str) else type(axis[0])
            fields[name] = (tuple[kind, ...], ())
        model = run_config(fields)

    @readable()
    def commands(**axes: Any) -> list[Command]:
        return [*file.commands(axes)]

    defaults = {"workers": file.workers, "evaluate": file.evaluate, **file.axes}
    return Experiment(commands, [*fields], model, given=defaults)
