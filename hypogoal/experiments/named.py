"""The experiments that come with hypogoal, by name."""

from collections.abc import Mapping
from typing import NamedTuple

from hypogoal.experiments.choosing import choosing
from hypogoal.experiments.doorkey import doorkey
from hypogoal.experiments.experiment import Experiment
from hypogoal.experiments.montezuma_ladders import montezuma_ladders
from hypogoal.experiments.rooms import rooms

EXPERIMENTS: Mapping[str, Experiment] = {
    experiment.name: experiment for experiment in (choosing, doorkey, montezuma_ladders, rooms)
}


class Figure(NamedTuple):
    """One of the paper's figures, or another experiment at one size of its own."""

    experiment: str
    preset: str  # a laptop's size
    paper: tuple[str, ...] | None = None  # with --preset paper: the paper's own size, with these assignments


FIGURES = {
    "choosing": Figure("choosing", "choosing"),
    "figure3": Figure("montezuma-ladders", "figure3", paper=("ladders=",)),  # classifiers, without options
    "figure4": Figure("montezuma-ladders", "figure4", paper=()),
    "figure6": Figure("doorkey", "figure6", paper=()),
}
CELLS = {("doorkey", "choosing"): "choosing"}  # presets with cells of their own: the experiment that has them
NAMES = tuple(dict.fromkeys([*EXPERIMENTS, *FIGURES]))
