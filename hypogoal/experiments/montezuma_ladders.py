"""Figures 3, 4 and 5: sub-goals and options on the ladders of Montezuma's Revenge (Spec B5, D4, F1, F3, F4)."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from itertools import product
from pathlib import Path
from typing import Any

from hypogoal.core.config import as_dict, from_values, parse_assignments, setting
from hypogoal.core.errors import UserError
from hypogoal.domains.base import load_domain
from hypogoal.domains.montezuma_ladders import ladder_named
from hypogoal.experiments.cells import Cell, Cost, closing_cells, stage_cell, with_common
from hypogoal.hypotheses.config import EnsembleConfig
from hypogoal.needs import BASE, LOGS, ensemble_disk, ensemble_process, play_needs

DOMAIN = "montezuma"
STAGES = ("collect", "train-ensemble", "train-options")
DECIDED: dict[str, str] = {}  # as of experiments.doorkey

# What things cost on one core of the machine of docs/performance.md: seconds per collection, per gradient step of a
# member, per localiser learned, per environment step of an option, per member that is evaluated.
PER_COLLECTION = 30.0
PLAYING = 6  # rooms that a collection plays in at once, at the most
PER_MEMBER_STEP = {"montezuma": 0.08, "montezuma-crop": 0.01}
PER_LOCALISER = 90.0
PER_STEP = {"light": 2.5e-3, "paper": 4.0}
PER_EVALUATED_MEMBER = 3.0
EVALUATING = 6  # ensembles that an evaluation judges at once, at the most

METHODS: dict[str, tuple[str, ...]] = {
    "dbat": ("--set", "diversity=dbat"),
    "none": ("--set", "diversity=none"),
    "cnn": ("--set", "diversity=none", "--set", "members=1"),
}


@dataclass(frozen=True)
class RunConfig:
    """Which cells the experiment has."""

    groups: tuple[int, ...] = setting((1, 2, 3, 7), "labelled ladder groups (N)", source="Figure 3", low=1, high=7)
    seeds: tuple[int, ...] = setting((0,), "run seeds, each with ensembles of its own", low=0)
    methods: tuple[str, ...] = setting(
        tuple(METHODS),
        "ensembles: D-BAT, the same without diversity, a single CNN",
        source="Figure 3",
        choices=METHODS,
    )
    variants: tuple[str, ...] = setting(
        (),
        "changes to compare: settings of train-ensemble as key=value, several with spaces between; each gives one more "
        "ensemble per method",
    )
    ladders: tuple[str, ...] = setting((), "ladders to learn options on; empty for none", source="Figure 4")
    option_groups: tuple[int, ...] = setting(
        (2,), "the N whose ensembles get options; they must be among 'groups'", low=1, high=7
    )
    option_methods: tuple[str, ...] = setting(
        tuple(METHODS), "the ensembles that get options; they must be among 'methods'", choices=METHODS
    )
    oracle: bool = setting(
        True, "options that end at the true sub-goal beside them, on each ladder", source="ours: a control"
    )
    workers: int = setting(0, "cells at once; 0 for one per core", low=0, high=1024)


def _check(config: RunConfig) -> None:
    for ladder in config.ladders:
        ladder_named(ladder)
    if not config.ladders:
        return
    for name, wanted, there in (
        ("option_groups", config.option_groups, config.groups),
        ("option_methods", config.option_methods, config.methods),
    ):
        if not set(wanted) <= set(there):
            missing = ",".join(str(item) for item in wanted if item not in there)
            whole = name.removeprefix("option_")
            raise UserError(f"no ensembles of {missing} to learn options for", name, f"Add it to {whole}.")


def _changed(ensemble: EnsembleConfig, variant: str) -> EnsembleConfig:
    """The settings of a variant."""
    values = {**as_dict(ensemble), **parse_assignments(variant.split())}
    return from_values(type(ensemble), values, "train-ensemble")


def _training(ensemble: EnsembleConfig, members: int) -> float:
    """Seconds that an ensemble takes."""
    learned = ensemble.view == "agent-crop" and ensemble.localiser == "learned"
    per_step = PER_MEMBER_STEP.get(ensemble.network, max(PER_MEMBER_STEP.values()))
    return per_step * ensemble.steps * members + PER_LOCALISER * learned


def cells(
    out: Path,
    config: RunConfig,
    resolved: Mapping[str, Any],
    common: Mapping[str, tuple[str, ...]],
    *,
    short: bool = False,
) -> list[Cell]:
    """The cells of a run; arguments as of ``experiments.doorkey.cells``, but that no names are ``short``.

    Raises:
        UserError: an unknown ladder, or options of ensembles that the run does not have.
    """
    _check(config)
    planned: list[Cell] = []
    made: list[Path] = []

    ensemble, play = resolved["train-ensemble"], resolved["train-options"]
    variants: dict[str, Any] = {variant: _changed(ensemble, variant) for variant in ("", *config.variants)}
    members = {method: 1 if method == "cnn" else ensemble.members for method in METHODS}
    option = play.steps * PER_STEP[play.network]
    evaluated = judged = 0

    domain = load_domain(DOMAIN)
    states: int = domain.collected_bytes(resolved["collect"])
    taught: int = domain.collected_bytes(replace(resolved["collect"], heldout_per_room=0))
    goals = len(ensemble.sub_goals or domain.sub_goals)
    collecting = Cost(PER_COLLECTION, BASE + 2 * states / PLAYING, states, resolved["collect"].workers or PLAYING)

    def add(
        place: str, arguments: tuple[str, ...], axes: dict[str, Any], cost: Cost, needs: tuple[Path, ...] = ()
    ) -> Path:
        planned.append(stage_cell(out / place, out, with_common(arguments, common), needs, cost, axes))
        return out / place

    def training(method: str, variant: str) -> Cost:
        settings, count = variants[variant], members[method]
        cores = min(settings.workers or goals, goals)
        return Cost(_training(settings, count), ensemble_process(taught, count), ensemble_disk(goals, count), cores)

    def learning(method: str, seconds: float) -> Cost:
        about = {"sub_goals": domain.sub_goals, "members": members[method]}
        return Cost(seconds, *play_needs(domain, about, play))

    for groups in config.groups:
        collect = ("collect", DOMAIN, "--set", f"groups={groups}")
        data = add(f"data/groups-{groups}.h5", collect, {"groups": groups}, collecting)
        for method, variant, seed in product(config.methods, ("", *config.variants), config.seeds):
            named = ",".join([method, *variant.split()])
            place = f"ensemble/{named}/groups-{groups}-seed-{seed}"
            settings = (part for change in variant.split() for part in ("--set", change))
            arguments = ("train-ensemble", str(data), *METHODS[method], *settings, "--seed", str(seed))
            evaluated += members[method]
            judged += 1
            axes = {"method": method, "variant": variant, "groups": groups, "seed": seed}
            made.append(add(place, arguments, axes, training(method, variant), (data,)))
    for ladder in config.ladders:
        for seed in config.seeds:
            for groups in config.option_groups:
                for method in config.option_methods:
                    source = out / f"ensemble/{method}/groups-{groups}-seed-{seed}"
                    place = f"options/{method}/groups-{groups}-ladder-{ladder}-seed-{seed}"
                    arguments = ("train-options", str(source), "--set", f"start={ladder}", "--seed", str(seed))
                    options = members[method] if play.steps_for == "each" else 1
                    axes = {"method": method, "groups": groups, "ladder": ladder, "seed": seed}
                    made.append(add(place, arguments, axes, learning(method, option * options), (source,)))
            if config.oracle and config.option_groups and config.option_methods:
                first = f"{config.option_methods[0]}/groups-{config.option_groups[0]}-seed-{seed}"
                source = out / f"ensemble/{first}"
                changes = ("--set", f"start={ladder}", "--set", "termination=oracle")
                place = f"options/oracle/ladder-{ladder}-seed-{seed}"
                arguments = ("train-options", str(source), *changes, "--seed", str(seed))
                axes = {"method": "oracle", "ladder": ladder, "seed": seed}
                made.append(add(place, arguments, axes, learning("cnn", option), (source,)))
    evaluating = Cost(PER_EVALUATED_MEMBER * evaluated, BASE + 300e6 + 2 * states, 2 * LOGS, min(EVALUATING, judged))
    return planned + closing_cells(out, made, evaluating)
