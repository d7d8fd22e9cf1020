"""Spec F5, F6: what the page says and draws of agents, from episodes as they are recorded."""

import numpy as np
import pytest

from hypogoal.evaluation.agents import Run, agent_curves, agent_metrics, common_grid, group_runs
from hypogoal.evaluation.curves import Episodes
from hypogoal.evaluation.page.agents import curves_section, summary_section
from hypogoal.evaluation.page.blocks import Material
from hypogoal.evaluation.quantities import plain


def made(seed=0, *, chooser="ppo", episodes=120, reward=1.0, length=20, shortest=10, **config):
    """A run whose episodes are all alike: the last of them came to its end where there is a reward."""
    end = np.arange(1, episodes + 1) * length
    rewards = np.full(episodes, reward, dtype=np.float64)
    found = Episodes(end, np.full(episodes, length), rewards, rewards > 0)
    layout = {"layout_seed": 200, "shortest_path": shortest, "random_success": 0.25, "random_episodes": 10}
    about = {"termination": "learned", "chooser": chooser, "steps": episodes * length, **config}
    return Run("meta", f"meta-{chooser}-{seed}", seed, about, found, layout)


def material_of(*runs):
    """What an evaluation of these runs holds of agents."""
    groups = group_runs(runs)
    grid = common_grid(runs)
    arrays = {"curves/grid": grid}
    for index, same in enumerate(groups.values()):
        arrays |= {f"curves/{index}/{key}": values for key, values in agent_curves(same, grid).items()}
    agents = [agent_metrics(name, same) for name, same in groups.items()]
    metrics = {"agents": agents, "layouts": [runs[0].layout], "settings": {"window": 100}, "missing": []}
    return Material(plain(metrics), arrays)


def answer(*runs):
    """What the summary says of the option agent."""
    material = material_of(*runs)
    return summary_section(material)["paragraphs"][1]


@pytest.mark.parametrize("reward", [20.0, -3.0])
def test_figure_6_shows_rewards_of_any_size(reward):
    """Spec F5: limits that fit the rewards; no share of successes drawn or told of on an axis of other rewards."""
    material = material_of(made(reward=reward))
    section = curves_section(material)
    axes = material.figures["reward"].axes[0]
    low, high = axes.get_ylim()
    assert low < reward < high
    assert [line.get_label() for line in axes.get_lines()] == ["options (learned members)"]
    caption = next(block["caption"] for block in section["blocks"] if block.get("id") == "figure-reward")
    assert "random play" not in caption


def test_figure_6_of_rewards_that_are_shares_is_the_same_for_all_tasks():
    """Spec F5: limits a little beyond 0 and 1, and what random play comes to."""
    material = material_of(made())
    section = curves_section(material)
    axes = material.figures["reward"].axes[0]
    assert axes.get_ylim() == (-0.02, 1.04)
    assert axes.get_lines()[1].get_ydata()[0] == 0.25
    caption = next(block["caption"] for block in section["blocks"] if block.get("id") == "figure-reward")
    assert caption.endswith("Dotted: mean over layouts of uniformly random play.")


def test_the_summary_leaves_out_a_shortest_path_that_is_not_known():
    """Spec F5: no dash in the sentence."""
    assert "took 20 steps, 2.0 times the shortest path (1 run: layout seed 200" in answer(made())
    assert "took 20 steps (1 run: layout seed 200" in answer(made(shortest=None))


@pytest.mark.parametrize(
    ("counts", "said"),
    [
        ((120, 100), "last 100 training episodes,"),
        ((40,), "last 40 training episodes,"),
        ((1,), "last 1 training episode,"),
        ((0, 40, 120), "last 40 to 100 training episodes,"),
    ],
)
def test_the_summary_says_of_how_many_episodes_it_speaks(counts, said):
    """Spec F5: fewer than the window where a run had fewer; runs without an episode have no share in it."""
    budget = {"steps": 3_000}
    assert said in answer(*(made(seed, episodes=count, **budget) for seed, count in enumerate(counts)))
