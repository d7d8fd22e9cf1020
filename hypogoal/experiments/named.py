"""The experiments that come with hypogoal, by name."""

from collections.abc import Mapping
from pathlib import Path
from typing import NamedTuple

from hypogoal.core.errors import UserError
from hypogoal.experiments.choosing import choosing
from hypogoal.experiments.doorkey import doorkey
from hypogoal.experiments.experiment import Experiment, load_experiment, read_toml
from hypogoal.experiments.ladders import montezuma_ladders
from hypogoal.experiments.rooms import rooms

EXPERIMENTS: Mapping[str, Experiment] = {
    experiment.name: experiment for experiment in (choosing, doorkey, montezuma_ladders, rooms)
}


class Figure(NamedTuple):
    """One of the paper's figures, or another experiment at one size of its own."""

    experiment: str
    preset: str  # a laptop's size, if no other is given
    settings: tuple[str, ...] = ()


FIGURES = {
    "choosing": Figure("choosing", "choosing"),
    "figure3": Figure("montezuma-ladders", "figure3", ("ladders=",)),  # classifiers, without options
    "figure4": Figure("montezuma-ladders", "figure4"),
    "figure6": Figure("doorkey", "figure6"),
}
NAMES = tuple(dict.fromkeys([*EXPERIMENTS, *FIGURES]))


def find_experiment(name: str, preset: str | None) -> tuple[Experiment, str | None, tuple[str, ...]]:
    """The experiment called ``name``, its preset and settings; an unknown one is a ``UserError``.

    It is named, one of the paper's figures, a TOML file, or ``module:function``, which the user must have given.
    """
    if (name, preset) == ("doorkey", "choosing"):  # a preset with cells of its own
        name = preset
    if name in FIGURES:
        figure = FIGURES[name]
        return EXPERIMENTS[figure.experiment], preset or figure.preset, figure.settings
    if name in EXPERIMENTS:
        return EXPERIMENTS[name], preset, ()
    if name.endswith(".toml"):
        return read_toml(Path(name)), preset, ()
    if ":" in name:
        return load_experiment(name), preset, ()
    do = f"Choose one of {', '.join(NAMES)}, or give a .toml file or module:function."
    raise UserError("unknown experiment", name, do)
