"""Is an ensemble needed? In rooms labels cannot tell shape from place, the reward asks for one of them.

``hypogoal run rooms --out runs/rooms``. The evaluation's 'What choosing is worth' compares the agent with
uniform-random choice among its own options.
"""

from collections.abc import Iterator
from itertools import product

from hypogoal.core.config import setting
from hypogoal.experiments.experiment import Command, Integers, Names, experiment

METHODS = {  # one member more than features, and two for joint
    "dbat": "--diversity dbat --members 3",
    "divdis": "--diversity divdis --members 3",
    "none": "--diversity none --members 3",
    "one": "--diversity none --members 1",
    "joint": "--diversity none --members 2 --set teacher=joint:independent",
}
ROOMS = "seeds: each has states, ensembles, rooms and agents of its own"


@experiment("rooms")
def rooms(
    *,
    seeds: Integers = setting(tuple(range(990, 1000)), ROOMS),
    methods: Names = setting(("dbat", "none", "one"), "ensembles", choices=METHODS),
    truths: Names = setting(("shape", "place"), "what the reward asks for", choices=("shape", "place")),
) -> Iterator[Command]:
    """The states of each seed, its ensembles, then an agent for each of them and each truth."""
    for seed in seeds:
        yield Command(f"data/seed-{seed}", f"collect rooms --seed {seed}", {"group": "data", "seed": seed})
    for method, seed in product(methods, seeds):
        words = f"train-ensemble @data/seed-{seed} {METHODS[method]} --seed {seed}"
        yield Command(f"ensemble/method-{method}-seed-{seed}", words, {"method": method, "seed": seed})
    for method, truth, seed in product(methods, truths, seeds):
        words = f"train-meta @ensemble/method-{method}-seed-{seed} --seed {seed} --layout-seed {seed}"
        words = f"{words} --set world=truth={truth} --set steps=5000"
        place = f"agent/method-{method}-truth-{truth}-seed-{seed}"
        yield Command(place, words, {"method": method, "truth": truth, "seed": seed})
