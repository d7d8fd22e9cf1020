"""Which members does reward prefer, where wrong choices only cost time? Plain DoorKey, 34 layouts, each with a seed of
its own; options are planned (exact), so nothing here is a matter of option learning.

    hypogoal run examples.preference:preference --out runs/preference
    python -m studies.choosing runs/preference docs/results/preference-doorkey.csv
"""

from collections.abc import Iterator
from itertools import product

from hypogoal.core.config import setting
from hypogoal.experiments.experiment import LAYOUTS, SEEDS, Command, Integers, Names, agents_of, experiment

METHODS = {"dbat-k3": "--diversity dbat --members 3", "none-k3": "--diversity none --members 3"}


@experiment("doorkey")
def preference(
    *,
    layouts: Integers = setting(tuple(range(300, 334)), LAYOUTS, low=0),
    seeds: Integers = setting(tuple(range(3000, 3034)), SEEDS, low=0),
    methods: Names = setting(tuple(METHODS), "ensembles", choices=METHODS),
) -> Iterator[Command]:
    """For each method and seed its ensemble, then its agents."""
    agents = agents_of(layouts, seeds)
    yield Command("data", "collect doorkey --set heldout_layouts=1")
    for method, seed in product(methods, seeds):
        ensemble, columns = f"ensemble/method-{method}-seed-{seed}", {"method": method, "seed": seed}
        yield Command(ensemble, f"train-ensemble @data {METHODS[method]} --seed {seed}", columns)
        for layout in [layout for layout, other in agents if other == seed]:
            command = f"train-meta @{ensemble} --seed {seed} --layout-seed {layout}"
            yield Command(
                f"planned/method-{method}-layout-{layout}-seed-{seed}",
                f"{command} --set network=planned --set steps=100000",
                {"method": method, "layout_seed": layout, "seed": seed},
            )
