"""The experiments that come with hypogoal, by name."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from hypogoal.core.config import DOMAIN, MODELS, STAGES, model_of
from hypogoal.core.errors import UserError
from hypogoal.domains.base import load_domain
from hypogoal.experiments.choosing import choosing
from hypogoal.experiments.doorkey import doorkey
from hypogoal.experiments.experiment import Experiment, load_experiment, read_toml
from hypogoal.experiments.ladders import montezuma_ladders
from hypogoal.experiments.rooms import rooms

EXPERIMENTS: Mapping[str, Experiment] = {each.name: each for each in (choosing, doorkey, montezuma_ladders, rooms)}
FIGURES: Mapping[str, tuple[str, str, dict[str, str]]] = {  # experiments at a laptop's size: its preset, and settings
    "choosing": ("choosing", "choosing", {}),
    "figure3": ("montezuma-ladders", "figure3", {"ladders": ""}),  # classifiers, without options
    "figure4": ("montezuma-ladders", "figure4", {}),
    "figure6": ("doorkey", "figure6", {}),
}
NAMES = tuple(dict.fromkeys([*EXPERIMENTS, *FIGURES]))


def find_experiment(name: str, preset: str | None) -> tuple[Experiment, str | None, dict[str, str]]:
    """The experiment called ``name``, its preset and settings; an unknown one is a ``UserError``.

    It is named, one of the paper's figures, a TOML file, or ``module:function``, which the user must have given.
    """
    if (name, preset) == ("doorkey", "choosing"):  # a preset with cells of its own
        name = "choosing"
    if name in FIGURES:
        experiment, size, settings = FIGURES[name]
        return EXPERIMENTS[experiment], preset or size, settings
    if name in EXPERIMENTS:
        return EXPERIMENTS[name], preset, {}
    if name.endswith(".toml"):
        return read_toml(Path(name)), preset, {}
    if ":" in name:
        return load_experiment(name), preset, {}
    do = f"Choose one of {', '.join(NAMES)}, or give a .toml file or module:function."
    raise UserError("unknown experiment", name, do)


def config_class_of(stage: str, domain: str = DOMAIN) -> Any:
    """The settings of a stage, by its command's name; of ``run``, the domain's experiment's. Else a ``UserError``."""
    if stage == "collect":
        return load_domain(domain).config_class
    if stage == "run":
        for name, experiment in EXPERIMENTS.items():
            if domain == experiment.domain and name != "choosing":
                return experiment.model
        raise UserError("no experiment uses this domain", domain, f"Experiments: {', '.join(EXPERIMENTS)}.")
    if stage not in MODELS:
        raise UserError("no such stage", stage, f"Choose one of {', '.join(STAGES)}, run.")
    return model_of(stage)
