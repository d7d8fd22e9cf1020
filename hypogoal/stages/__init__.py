"""Stages with settings, by name: what commands and the functions of :mod:`hypogoal.api` share."""

from collections.abc import Mapping
from importlib import import_module
from pathlib import Path
from typing import Any

from hypogoal.core import own_code
from hypogoal.settings import configuration

PLACE = "layout_seed"  # options of many layouts may be played in any


def make(
    stage: str, source: str | Path, out: Path, settings: Mapping[str, Any], preset: str | None = None, **rest: Any
) -> Any:
    """Run ``stage`` with the user's ``settings`` on its ``source``; returns what the stage returns.

    The source is a domain's name, which the user typed, or a data file or ensemble, which names its domain.
    ``module:object`` may be loaded if it is among the settings, not if it is in a preset.
    """
    from hypogoal.domains.base import load_domain

    own_code.allow([source, *settings.values()])
    domain = source if isinstance(source, str) else domain_of(source, stage)
    inherited = inherited_of(stage, rest["options"]) if rest.get("options") else {}
    config = configuration(stage, domain, preset, (), settings, inherited=inherited)
    first: Any = source
    if stage == "collect":
        first, rest["name"] = load_domain(domain), domain
    return named(stage)(first, config, out, **rest)


def inherited_of(stage: str, options: Path) -> dict[str, Any]:
    """The settings of trained options that hold for a stage which continues them, unless others are given."""
    from hypogoal.core.artefacts import open_artefact

    trained = open_artefact(options, "options").config
    fixed = import_module(named(stage).__module__).FIXED
    return {name: trained[name] for name in fixed if name != PLACE or not trained["layouts"]}


def named(stage: str) -> Any:
    """The function of a stage, imported when needed."""
    name = stage.replace("-", "_")
    return getattr(import_module(f"hypogoal.stages.{name}"), name)


def domain_of(source: Path, stage: str) -> str:
    """The domain of a stage's source, a data file or an ensemble."""
    from hypogoal.core.artefacts import open_artefact
    from hypogoal.data import open_dataset

    data = stage == "train-ensemble"
    return open_dataset(source).domain if data else str(open_artefact(source, "ensemble").config["domain"])
