"""The experiments that come with hypogoal, by name."""

from dataclasses import replace
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

EXPERIMENTS = {
    "doorkey": doorkey,
    "choosing": choosing,
    "montezuma-ladders": montezuma_ladders,
    "rooms": rooms,
    # At a laptop's size.
    "figure3": replace(montezuma_ladders, preset="figure3", given={"ladders": ""}),  # classifiers, without options
    "figure4": replace(montezuma_ladders, preset="figure4"),
    "figure6": replace(doorkey, preset="figure6"),
}


def find_experiment(name: str, preset: str | None) -> Experiment:
    """The experiment called ``name``, a TOML file, or ``module:function``; an unknown one is a ``UserError``."""
    if (name, preset) == ("doorkey", "choosing"):  # a preset with cells of its own
        return choosing
    if name in EXPERIMENTS:
        return EXPERIMENTS[name]
    if name.endswith(".toml"):
        return read_toml(Path(name))
    if ":" in name:
        return load_experiment(name)
    do = f"Choose one of {', '.join(EXPERIMENTS)}, or give a .toml file or module:function."
    raise UserError("unknown experiment", name, do)


def config_class_of(stage: str, domain: str = DOMAIN) -> Any:
    """The settings of a stage, by its command's name; of ``run``, the domain's experiment's. Else a ``UserError``."""
    if stage == "collect":
        return load_domain(domain).config_class
    if stage in MODELS:
        return model_of(stage)
    if stage != "run":
        raise UserError("no such stage", stage, f"Choose one of {', '.join(STAGES)}, run.")
    for experiment in EXPERIMENTS.values():
        if experiment.domain == domain:
            return experiment.model
    raise UserError("no experiment uses this domain", domain, f"Experiments: {', '.join(EXPERIMENTS)}.")
