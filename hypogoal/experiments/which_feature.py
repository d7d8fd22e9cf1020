"""Is an ensemble needed? Rooms of WhichFeature: labels cannot tell shape from place, the reward asks for one of them.

With ``--preset four`` they cannot tell four features apart, and one ensemble is to serve whichever is rewarded.

``hypogoal run which-feature --out runs/which-feature``. The evaluation's 'What choosing is worth' compares the agent
with uniform-random choice among its own options.
"""

from collections.abc import Iterator
from itertools import product
from typing import Annotated

from hypogoal.core.errors import UserError
from hypogoal.experiments.experiment import Command, experiment, explained

RATES = {
    "heldout": "heldout_layouts",
    "collect": 1,
    "member_step": {"tiles": 0.01},
    "step": {"planned": 0.5e-3},
}
METHODS = {  # {more}: one member more than features
    "dbat": "--diversity dbat --members {more}",
    "divdis": "--diversity divdis --members {more}",
    "none": "--diversity none --members {more}",
    "one": "--diversity none --members 1",
    "joint": "--diversity none --members {features} --set proposals=joint --set agreement=0",
}
Rooms = Annotated[tuple[int, ...], explained("seeds: each has states, ensembles, rooms and agents of its own")]
Features = Annotated[tuple[str, ...], explained("planted features, which labels cannot tell apart")]


@experiment("which-feature", stages=("collect", "train-ensemble", "train-meta"), rates=RATES)
def which_feature(
    *,
    seeds: Rooms = tuple(range(990, 1000)),
    methods: Annotated[tuple[str, ...], explained("ensembles", choices=METHODS)] = ("dbat", "none", "one"),
    factors: Features = ("shape", "place"),
    truths: Annotated[tuple[str, ...], explained("what the reward asks for")] = ("shape", "place"),
) -> Iterator[Command]:
    """The states of each seed, its ensembles, then an agent for each of them and each truth."""
    if not factors or not set(truths) <= set(factors):
        fault, where = "a feature that is not planted cannot be rewarded", f"truths={','.join(truths)}"
        raise UserError(fault, where, f"Choose from factors={','.join(factors)}, or plant more.")
    planted = f"--set factors={','.join(factors)} --set truth={factors[0]}"
    for seed in seeds:
        words = f"collect which-feature --seed {seed} {planted}"
        yield Command(f"data/seed-{seed}", words, {"group": "data", "seed": seed})
    for method, seed in product(methods, seeds):
        ensemble = METHODS[method].format(features=len(factors), more=len(factors) + 1)
        words = f"train-ensemble @data/seed-{seed} {ensemble} --seed {seed}"
        yield Command(f"ensemble/method-{method}-seed-{seed}", words, {"method": method, "seed": seed})
    for method, truth, seed in product(methods, truths, seeds):
        words = f"train-meta @ensemble/method-{method}-seed-{seed} --seed {seed} --layout-seed {seed}"
        words = f"{words} --set world=truth={truth} --set steps=5000"
        place = f"agent/method-{method}-truth-{truth}-seed-{seed}"
        yield Command(place, words, {"method": method, "truth": truth, "seed": seed})
