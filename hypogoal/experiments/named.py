"""The experiments that come with hypogoal, by name."""

from collections.abc import Mapping

from hypogoal.experiments.choosing import choosing
from hypogoal.experiments.doorkey import doorkey
from hypogoal.experiments.experiment import Experiment
from hypogoal.experiments.montezuma_ladders import montezuma_ladders
from hypogoal.experiments.which_feature import which_feature

EXPERIMENTS: Mapping[str, Experiment] = {
    experiment.name: experiment for experiment in (choosing, doorkey, montezuma_ladders, which_feature)
}
FIGURES = {  # of the paper, and others that have one preset: the experiment and the preset
    "choosing": ("choosing", "choosing"),
    "figure3": ("montezuma-ladders", "figure3"),
    "figure4": ("montezuma-ladders", "figure4"),
    "figure6": ("doorkey", "figure6"),
}
CELLS = {("doorkey", "choosing"): "choosing"}  # presets with cells of their own: the experiment that has them
NAMES = tuple(dict.fromkeys([*EXPERIMENTS, *FIGURES]))
