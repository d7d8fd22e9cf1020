"""Figures 3, 4 and 5: sub-goals and options on the ladders of Montezuma's Revenge.

``hypogoal run montezuma-ladders --out runs/ladders --preset demo``
"""

import shlex
from collections.abc import Iterator
from itertools import product
from typing import Annotated

from hypogoal.experiments.experiment import Command, Integers, Names, Seeds, experiment, explained

METHODS = {
    "dbat": "--set diversity=dbat",
    "none": "--set diversity=none",
    "cnn": "--set diversity=none --set members=1",
}
ENSEMBLES = "ensembles: D-BAT, the same without diversity, a single CNN"
CHANGES = """changes to compare: settings of train-ensemble as key=value, several with spaces between; \
each gives one more ensemble per method"""
OPTION_GROUPS = "the N whose ensembles get options; they must be among 'groups'"
OPTION_METHODS = "the ensembles that get options; they must be among 'methods'"
SUB_GOAL = "what is labelled, a sub-goal of collect montezuma; empty: climb-down-ladder. 'ladders' are starts then"
ORACLE = "options that end at the true sub-goal beside them, on each ladder"


@experiment("montezuma")
def montezuma_ladders(
    *,
    groups: Annotated[Integers, explained("labelled ladder groups (N)", source="Figure 3", low=1, high=7)] = (
        1,
        2,
        3,
        7,
    ),
    seeds: Seeds = (0,),
    methods: Annotated[Names, explained(ENSEMBLES, source="Figure 3", choices=METHODS)] = tuple(METHODS),
    sub_goal: Annotated[str, explained(SUB_GOAL, source="authors' code")] = "",
    variants: Annotated[Names, explained(CHANGES)] = (),
    ladders: Annotated[Names, explained("ladders to learn options on; empty for none", source="Figure 4")] = (),
    option_groups: Annotated[Integers, explained(OPTION_GROUPS, low=1, high=7)] = (2,),
    option_methods: Annotated[Names, explained(OPTION_METHODS, choices=METHODS)] = tuple(METHODS),
    oracle: Annotated[bool, explained(ORACLE, source="ours: a control")] = True,
) -> Iterator[Command]:
    """The states and ensembles of each N, then the options of each ladder and seed with their oracle."""
    labelled = f" --set sub_goals={sub_goal}" if sub_goal else ""
    for count in groups:
        yield Command(f"data/groups-{count}", f"collect montezuma --set groups={count}{labelled}", {"groups": count})
        for method, variant, seed in product(methods, ("", *variants), seeds):
            changes = variant.split()
            sets = " ".join(f"--set {shlex.quote(change)}" for change in changes)
            yield Command(
                f"ensemble/{','.join([method, *changes])}/groups-{count}-seed-{seed}",
                f"train-ensemble @data/groups-{count} {METHODS[method]} {sets} --seed {seed}",
                {"method": method, "variant": variant, "groups": count, "seed": seed},
            )
    for ladder, seed in product(ladders, seeds):
        ensembles = list(product(option_groups, option_methods))
        for count, method in ensembles:
            yield Command(
                f"options/{method}/groups-{count}-ladder-{ladder}-seed-{seed}",
                f"train-options @ensemble/{method}/groups-{count}-seed-{seed} --set start={ladder} --seed {seed}",
                {"method": method, "groups": count, "ladder": ladder, "seed": seed},
            )
        for count, method in ensembles[:1] if oracle else ():  # any will do: what these options end at is not learned
            yield Command(
                f"options/oracle/ladder-{ladder}-seed-{seed}",
                f"train-options @ensemble/{method}/groups-{count}-seed-{seed} --set start={ladder}"
                f" --set termination=oracle --seed {seed}",
                {"method": "oracle", "ladder": ladder, "seed": seed},
            )
