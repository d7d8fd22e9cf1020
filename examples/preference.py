"""Which members does reward prefer, where wrong choices only cost time? Plain DoorKey, 34 layouts, each with a seed of
its own; options are planned (exact), so nothing here is a matter of option learning.

    hypogoal run examples.preference:preference --out runs/preference
    python -m studies.choosing runs/preference docs/results/preference-doorkey.csv
"""

from collections.abc import Iterator
from itertools import product
from typing import Annotated

from hypogoal.experiments.experiment import (
    Command,
    Layouts,
    Names,
    Paired,
    Seeds,
    agents_of,
    experiment,
    explained,
)

METHODS = {"dbat-k3": "--diversity dbat --members 3", "none-k3": "--diversity none --members 3"}


@experiment("doorkey")
def preference(
    *,
    layouts: Layouts = tuple(range(300, 334)),
    seeds: Seeds = tuple(range(3000, 3034)),
    paired: Paired = True,
    methods: Annotated[Names, explained("ensembles", choices=METHODS)] = tuple(METHODS),
) -> Iterator[Command]:
    """For each method and seed its ensemble, then its agents."""
    agents = agents_of(layouts, seeds, paired=paired)
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
