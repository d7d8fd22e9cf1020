"""The paper's Figure 6 at its own budget: 1.5 million steps on ten layouts, practice of options included.

D-BAT beside no diversity, one classifier a sub-goal, and the true sub-goals; PPO and DQN tuned, and as the paper's
tables have them on the first five layouts. ``studies.bonus`` adds PPO that is paid where D-BAT's members
predict positive.

    hypogoal run examples.figure6:figure6 --out runs/figure6
    python -m studies.bonus runs/figure6 docs/results/figure6-doorkey.csv
    python -m studies.figure6 runs/figure6 docs/results/figure6-doorkey.csv
"""

from collections.abc import Iterator
from itertools import product

from hypogoal.core.config import setting
from hypogoal.experiments.experiment import LAYOUTS, SEEDS, Command, Integers, Names, agents_of, experiment

METHODS = {
    "dbat-k3": "--diversity dbat --members 3",
    "none-k3": "--diversity none --members 3",
    "one": "--diversity none --members 1",
}
PUBLISHED = "--set epsilon_steps=8000 --set update_interval=16"  # the page was run with these
BASELINES = {"ppo-tuned": "--agent ppo --set setting=tuned", "dqn-tuned": "--agent dqn --set setting=tuned"}
PLAYED, TRAINED = tuple(range(300, 310)), tuple(range(3000, 3010))  # layouts and seeds
STEPS, PRACTICE = 1_500_000, 40_000  # of an agent, of which its options practise so many
PAPERS = {"ppo-paper": "--agent ppo --set setting=paper", "dqn-paper": "--agent dqn --set setting=paper"}


@experiment("doorkey")
def figure6(
    *,
    layouts: Integers = setting(PLAYED, LAYOUTS, low=0),
    seeds: Integers = setting(TRAINED, SEEDS, low=0),
    methods: Names = setting(tuple(METHODS), "ensembles", choices=METHODS),
    told: Names = setting(("dbat-k3",), "ensembles whose options end at the true sub-goal instead: the control"),
    baselines: Names = setting(tuple(BASELINES), "agents on the primitive actions", choices=BASELINES),
    papers: Names = setting(tuple(PAPERS), "the same agents as the paper's tables have them", choices=PAPERS),
    paper_layouts: Integers = setting(PLAYED[:5], "layouts of these, which take five times as long", low=0),
    paper_seeds: Integers = setting(TRAINED[:5], "seeds of these", low=0),
) -> Iterator[Command]:
    """For each method and seed its ensemble, options and agents; then the control and the baselines."""
    agents = agents_of(layouts, seeds)
    paper_agents = agents_of(paper_layouts, paper_seeds)
    yield Command("data", "collect doorkey")
    for method, seed in product(methods, seeds):
        ensemble = f"ensemble/method-{method}-seed-{seed}"
        columns: dict[str, str | int] = {"method": method, "seed": seed}
        yield Command(ensemble, f"train-ensemble @data {METHODS[method]} --seed {seed}", columns)
        of_seed = [agent for agent in agents if agent[1] == seed]
        for agent in of_seed:
            command = f"train-options @{ensemble} {PUBLISHED}"
            yield on_layout(f"options/method-{method}", command, method, agent, PRACTICE)
        for layout, _ in of_seed:
            command = f"train-meta @{ensemble} --options @options/method-{method}-layout-{layout}-seed-{seed}"
            command = f"{command} {PUBLISHED}"
            yield on_layout(f"agent/method-{method}", command, method, (layout, seed), STEPS - PRACTICE)
    for method, agent in product(told, agents):
        command = f"train-meta @ensemble/method-{method}-seed-{agent[1]} --set termination=oracle {PUBLISHED}"
        yield on_layout(f"oracle/method-{method}", command, "oracle", agent)
    for baseline, agent in product(baselines, agents):
        command = f"train-baseline doorkey --data @data {BASELINES[baseline]}"
        yield on_layout(f"baseline/agent-{baseline}", command, baseline, agent)
    for paper, agent in product(papers, paper_agents):
        command = f"train-baseline doorkey --data @data {PAPERS[paper]}"
        yield on_layout(f"paper/agent-{paper}", command, paper, agent)


def on_layout(name: str, command: str, method: str, agent: tuple[int, int], steps: int = STEPS) -> Command:
    """A command for an agent's layout and seed."""
    layout, seed = agent
    return Command(
        f"{name}-layout-{layout}-seed-{seed}",
        f"{command} --seed {seed} --layout-seed {layout} --set steps={steps}",
        {"method": method, "layout_seed": layout, "seed": seed},
    )
