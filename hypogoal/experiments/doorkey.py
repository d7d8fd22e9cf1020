"""Figure 6: agents on layouts of three-key DoorKey, with their controls and baselines.

``hypogoal run doorkey --out runs/demo --preset demo``
"""

from collections.abc import Callable, Iterator
from itertools import product
from typing import Annotated, Any

from hypogoal.cells import Value
from hypogoal.experiments.experiment import Command, Layouts, Names, Paired, Seeds, agents_of, experiment, explained

CONTROLS = {"random": "--set chooser=random", "oracle": "--set termination=oracle"}
BASELINES = {
    f"{agent}-{tuning}": f"--agent {agent} --set setting={tuning}"
    for agent, tuning in product(("ppo", "dqn"), ("paper", "tuned"))
}
Pretrain = Annotated[bool, explained("train-options before train-meta; false is the paper's D5")]
Controls = Annotated[Names, explained("controls beside the agent", source="ours: controls", choices=CONTROLS)]
Baselines = Annotated[Names, explained("agents on primitive actions", source="paper, Figure 6", choices=BASELINES)]


@experiment("doorkey")
def doorkey(
    stage: Callable[[str], Any],
    *,
    layout_seeds: Layouts = (100,),
    seeds: Seeds = (0,),
    paired: Paired = False,
    pretrain: Pretrain = True,
    controls: Controls = tuple(CONTROLS),
    baselines: Baselines = tuple(BASELINES),
) -> Iterator[Command]:
    """The options and the agent of a layout and seed, then those of the next; controls and baselines last."""

    def command(agent: str, words: str, layout: int, seed: int) -> Command:
        words = f"{words} --seed {seed} --layout-seed {layout}"
        columns: dict[str, Value] = {"agent": agent, "seed": seed, "layout_seed": layout}
        return Command(f"{agent}/layout-{layout}-seed-{seed}", words, columns)

    agents = agents_of(layout_seeds, seeds, paired=paired)
    yield Command("data", "collect doorkey")
    for seed in seeds:
        columns: dict[str, Value] = {"agent": "ensemble", "seed": seed}
        yield Command(f"ensemble/seed-{seed}", f"train-ensemble @data --seed {seed}", columns)
    for layout, seed in agents:
        ensemble, options = f"@ensemble/seed-{seed}", ""
        if pretrain:
            yield command("options", f"train-options {ensemble}", layout, seed)
            options = f"--options @options/layout-{layout}-seed-{seed}"
        yield command("meta", f"train-meta {ensemble} {options}", layout, seed)
    # What is compared with the agent plays as many steps as its options and it together.
    steps = stage("train-meta").steps + (stage("train-options").steps if pretrain else 0)
    for control, (layout, seed) in product(controls, agents):
        words = f"train-meta @ensemble/seed-{seed} {CONTROLS[control]} --set steps={steps}"
        yield command(f"meta-{control}", words, layout, seed)
    for baseline, (layout, seed) in product(baselines, agents):
        words = f"train-baseline doorkey --data @data {BASELINES[baseline]} --set steps={steps}"
        yield command(baseline, words, layout, seed)
