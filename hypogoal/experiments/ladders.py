"""Figures 3, 4 and 5: sub-goals and options on the ladders of Montezuma's Revenge.

``hypogoal run montezuma-ladders --out runs/ladders --preset demo``
"""

from collections.abc import Iterator
from dataclasses import replace
from itertools import product

from hypogoal.core.config import setting
from hypogoal.experiments.experiment import SEEDS, Columns, Command, Integers, Names, experiment

METHODS = {
    "dbat": "--set diversity=dbat",
    "none": "--set diversity=none",
    "cnn": "--set diversity=none --set members=1",
}
ENSEMBLES = "ensembles: D-BAT, the same without diversity, a single CNN"
OPTION_GROUPS = "the N whose ensembles get options; they must be among 'groups'"


@experiment("montezuma")
def montezuma_ladders(
    *,
    groups: Integers = setting((1, 2, 3, 7), "labelled ladder groups (N)", source="Figure 3", low=1, high=7),
    seeds: Integers = setting((0,), SEEDS, low=0),
    methods: Names = setting(tuple(METHODS), ENSEMBLES, source="Figure 3", choices=METHODS),
    ladders: Names = setting((), "ladders to learn options on; empty for none", source="Figure 4"),
    option_groups: Integers = setting((2,), OPTION_GROUPS, low=1, high=7),
) -> Iterator[Command]:
    """The states and ensembles of each N, then the options of each ladder and seed with their oracle."""
    for count in groups:
        yield Command(f"data/groups-{count}", f"collect montezuma --set groups={count}", {"groups": count})
    for count, method, seed in product(groups, methods, seeds):
        words = f"train-ensemble @data/groups-{count} {METHODS[method]} --seed {seed}"
        columns: Columns = {"method": method, "groups": count, "seed": seed}
        yield Command(f"ensemble/{method}/groups-{count}-seed-{seed}", words, columns)
    for ladder, seed in product(ladders, seeds):
        for count, method in product(option_groups, methods):
            ensemble = f"@ensemble/{method}/groups-{count}-seed-{seed}"
            words = f"train-options {ensemble} --set start={ladder} --seed {seed}"
            place = f"options/{method}/groups-{count}-ladder-{ladder}-seed-{seed}"
            yield Command(place, words, {"method": method, "groups": count, "ladder": ladder, "seed": seed})
        if option_groups and methods:  # any ensemble will do: what these options end at is not learned
            place = f"options/oracle/ladder-{ladder}-seed-{seed}"
            words = f"{words} --set termination=oracle"
            yield Command(place, words, {"method": "oracle", "ladder": ladder, "seed": seed})


# At a laptop's size; the first without options.
figure3 = replace(montezuma_ladders, preset="figure3", given={"ladders": ""})
figure4 = replace(montezuma_ladders, preset="figure4")
