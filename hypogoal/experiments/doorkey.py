"""Figure 6: agents on layouts of three-key DoorKey, with their controls and baselines.

``hypogoal run doorkey --out runs/demo --preset demo``
"""

from collections.abc import Callable, Iterator
from dataclasses import replace
from typing import Any

from hypogoal.core.config import setting
from hypogoal.experiments.experiment import LAYOUTS, SEEDS, Columns, Command, Integers, Names, agents_of, experiment

CONTROLS = {"random": "--set chooser=random", "oracle": "--set termination=oracle"}
BASELINES = {
    "ppo-paper": "--agent ppo --set setting=paper",
    "ppo-tuned": "--agent ppo --set setting=tuned",
    "dqn-paper": "--agent dqn --set setting=paper",
    "dqn-tuned": "--agent dqn --set setting=tuned",
}
COMPARED = "agents on primitive actions"
PRETRAIN = "train-options before train-meta; false is the paper's D5"


@experiment("doorkey")
def doorkey(
    stage: Callable[[str], Any],
    *,
    layout_seeds: Integers = setting((100,), LAYOUTS, source="paper, Figure 6", low=0),
    seeds: Integers = setting((0,), SEEDS, low=0),
    pretrain: bool = setting(True, PRETRAIN),
    controls: Names = setting(tuple(CONTROLS), "controls beside the agent", source="ours: controls", choices=CONTROLS),
    baselines: Names = setting(tuple(BASELINES), COMPARED, source="paper, Figure 6", choices=BASELINES),
) -> Iterator[Command]:
    """The ensembles of all seeds, then all of a layout and seed: options, agent, controls, baselines."""
    agents = agents_of(layout_seeds, seeds)
    is_one = len(agents) == 1  # then names are short: runs/demo/ensemble
    # What is compared with the agent plays as many steps as its options and it together.
    steps = stage("train-meta").steps + (stage("train-options").steps if pretrain else 0)
    yield Command("data", "collect doorkey")
    ensembles = {seed: "ensemble" if is_one else f"ensemble/seed-{seed}" for seed in seeds}
    for seed, ensemble in ensembles.items():
        yield Command(ensemble, f"train-ensemble @data --seed {seed}", {"agent": "ensemble", "seed": seed})
    for layout, seed in agents:
        at = "" if is_one else f"/layout-{layout}-seed-{seed}"
        meta = f"train-meta @{ensembles[seed]}"
        commands = {"meta": meta}
        if pretrain:
            commands = {"options": f"train-options @{ensembles[seed]}", "meta": f"{meta} --options @options{at}"}
        for control in controls:
            commands[f"meta-{control}"] = f"{meta} {CONTROLS[control]} --set steps={steps}"
        for baseline in baselines:
            commands[baseline] = f"train-baseline doorkey --data @data {BASELINES[baseline]} --set steps={steps}"
        for agent, words in commands.items():
            columns: Columns = {"agent": agent, "seed": seed, "layout_seed": layout}
            after = (
                [ensembles[seed]] if agent in baselines else []
            )  # the rest waits for an ensemble, which uses all cores
            yield Command(f"{agent}{at}", f"{words} --seed {seed} --layout-seed {layout}", columns, after)


figure6 = replace(doorkey, preset="figure6")  # at a laptop's size
