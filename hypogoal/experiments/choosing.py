"""Does choosing decide? Options learned in the plain world, chosen in one where a wrong key ends the episode.

``hypogoal run choosing --out runs/choosing``. The preset has the worlds. Planned options beside the
learned ones say what the hypotheses are worth, whatever learning makes of them. The evaluation's 'What choosing is
worth' compares the agent with uniform-random choice among its own options.
"""

from collections.abc import Iterator
from itertools import product

from hypogoal.core.config import setting
from hypogoal.experiments.experiment import LAYOUTS, SEEDS, Columns, Command, Integers, Names, agents_of, experiment

METHODS = {
    "dbat": "--diversity dbat --members 6",
    "none": "--diversity none --members 6",
    "one": "--diversity none --members 1",
}
SOLVABLE = (70100, 70101, 70102, 70103, 70105, 70107, 70109, 70110, 70111, 70112)  # without a wrong key


@experiment("doorkey", preset="choosing")
def choosing(
    *,
    layouts: Integers = setting(SOLVABLE, LAYOUTS, low=0),
    seeds: Integers = setting(tuple(range(920, 930)), SEEDS, low=0),
    methods: Names = setting(tuple(METHODS), "ensembles", choices=METHODS),
) -> Iterator[Command]:
    """The ensembles of all seeds, then of each agent the one of planned options, learned options, the one of these."""
    yield Command("data", "collect doorkey", {"group": "data"})
    for seed, method in product(seeds, methods):
        words = f"train-ensemble @data {METHODS[method]} --seed {seed}"
        yield Command(f"ensemble/method-{method}-seed-{seed}", words, {"method": method, "seed": seed})
    for (layout, seed), method in product(agents_of(layouts, seeds), methods):
        place = f"method-{method}-layout-{layout}-seed-{seed}"
        ensemble = f"@ensemble/method-{method}-seed-{seed}"
        of_agent = f"--seed {seed} --layout-seed {layout}"
        columns: Columns = {
            "policy": "learned",
            "method": method,
            "layout_seed": layout,
            "seed": seed,
        }
        words = f"train-meta {ensemble} {of_agent} --set network=planned"
        yield Command(f"planned/{place}", words, {**columns, "policy": "planned"})
        yield Command(f"options/{place}", f"train-options {ensemble} {of_agent}", columns)
        yield Command(f"agent/{place}", f"train-meta {ensemble} --options @options/{place} {of_agent}", columns)
