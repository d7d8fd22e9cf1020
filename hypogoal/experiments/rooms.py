"""Is an ensemble needed? In rooms labels cannot tell shape from place, the reward asks for one of them.

``hypogoal run rooms --out runs/rooms``. The evaluation's 'What choosing is worth' compares the agent with
uniform-random choice among its own options.
"""

from collections.abc import Iterator
from itertools import product
from typing import Annotated

from hypogoal.experiments.experiment import Command, experiment, explained

METHODS = {  # one member more than features, and two for joint
    "dbat": "--diversity dbat --members 3",
    "divdis": "--diversity divdis --members 3",
    "none": "--diversity none --members 3",
    "one": "--diversity none --members 1",
    "joint": "--diversity none --members 2 --set teacher=joint:independent",
}
Rooms = Annotated[tuple[int, ...], explained("seeds: each has states, ensembles, rooms and agents of its own")]
Truths = Annotated[tuple[str, ...], explained("what the reward asks for", choices=("shape", "place"))]


@experiment("rooms")
def rooms(
    *,
    seeds: Rooms = tuple(range(990, 1000)),
    methods: Annotated[tuple[str, ...], explained("ensembles", choices=METHODS)] = ("dbat", "none", "one"),
    truths: Truths = ("shape", "place"),
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
