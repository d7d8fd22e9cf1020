"""Does choosing decide? Options learned in the plain world, chosen in one where a wrong key ends the episode.

``hypogoal run choosing --out runs/choosing``. The preset has the worlds. Planned options beside the
learned ones say what the hypotheses are worth, whatever learning makes of them. The evaluation's 'What choosing is
worth' compares the agent with uniform-random choice among its own options.
"""

from collections.abc import Iterator
from itertools import product
from typing import Annotated

from hypogoal.cells import Value
from hypogoal.experiments.experiment import Command, Layouts, Paired, Seeds, agents_of, experiment, explained

METHODS = {
    "dbat": "--diversity dbat --members 6",
    "none": "--diversity none --members 6",
    "one": "--diversity none --members 1",
}
LAYOUTS = (70100, 70101, 70102, 70103, 70105, 70107, 70109, 70110, 70111, 70112)  # solvable without a wrong key


@experiment("doorkey", preset="choosing")
def choosing(
    *,
    layouts: Layouts = LAYOUTS,
    seeds: Seeds = tuple(range(920, 930)),
    paired: Paired = True,
    methods: Annotated[tuple[str, ...], explained("ensembles", choices=METHODS)] = tuple(METHODS),
    learned: Annotated[bool, explained("agents whose options are learned")] = True,
    planned: Annotated[bool, explained("agents whose options are planned")] = True,
) -> Iterator[Command]:
    """All of a seed, then all of the next: its ensembles, agents of planned options, options, agents of these."""
    agents = agents_of(layouts, seeds, paired=paired)
    yield Command("data", "collect doorkey", {"group": "data"})
    for seed in seeds:
        for method in methods:
            words = f"train-ensemble @data {METHODS[method]} --seed {seed}"
            yield Command(f"ensemble/method-{method}-seed-{seed}", words, {"method": method, "seed": seed})
        for name, policy in (("planned", "planned"), ("options", "learned"), ("agent", "learned")):
            for method, (layout, _) in product(methods, [agent for agent in agents if agent[1] == seed]):
                place = f"method-{method}-layout-{layout}-seed-{seed}"
                ensemble, rest = f"@ensemble/method-{method}-seed-{seed}", f"--seed {seed} --layout-seed {layout}"
                words = {
                    "planned": f"train-meta {ensemble} {rest} --set network=planned",
                    "options": f"train-options {ensemble} {rest}",
                    "agent": f"train-meta {ensemble} --options @options/{place} {rest}",
                }[name]
                columns: dict[str, Value] = {"policy": policy, "method": method, "layout_seed": layout, "seed": seed}
                if planned if policy == "planned" else learned:
                    yield Command(f"{name}/{place}", words, columns)
