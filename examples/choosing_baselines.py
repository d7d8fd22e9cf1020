"""PPO and DQN on primitive actions, in the worlds of the preset choosing: a wrong key ends the episode, as do 1.5
shortest paths.

    hypogoal run examples.choosing_baselines:choosing_baselines --out runs/choosing-baselines
"""

from collections.abc import Iterator
from itertools import product

from hypogoal.core.config import setting
from hypogoal.experiments.built_in import SOLVABLE
from hypogoal.experiments.experiment import LAYOUTS, SEEDS, Command, Integers, Names, agents_of, experiment


@experiment("doorkey")
def choosing_baselines(
    *,
    layouts: Integers = setting(SOLVABLE, LAYOUTS, low=0),
    seeds: Integers = setting(tuple(range(920, 930)), SEEDS, low=0),
    agents: Names = setting(("ppo", "dqn"), "agents"),
) -> Iterator[Command]:
    """Every agent on every layout."""
    yield Command("data", "collect doorkey --set heldout_layouts=1", {"group": "data"})
    for agent, (layout, seed) in product(agents, agents_of(layouts, seeds)):
        command = f"train-baseline doorkey --data @data --agent {agent} --seed {seed} --layout-seed {layout}"
        yield Command(
            f"baseline/agent-{agent}-layout-{layout}-seed-{seed}",
            f"{command} --set world=wrong_key=ends --set cap=1.5 --set steps=50000",
            {"agent": agent, "layout_seed": layout, "seed": seed},
        )
