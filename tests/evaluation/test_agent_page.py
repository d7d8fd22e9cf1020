"""Spec F5, F6: what the page says and draws of agents, from episodes as they are recorded."""

import numpy as np
import pytest

from hypogoal.evaluation.curves import (
    Run,
    agent_curves,
    agents_table,
    common_grid,
    group_runs,
    rows_of_run,
    runs_section,
    summary_section,
)
from hypogoal.evaluation.explorer import _options
from hypogoal.evaluation.numbers import plain
from hypogoal.evaluation.page import Material
from hypogoal.evaluation.questions import meanings, paper_figures
from hypogoal.evaluation.selection import rows_of_choices, sections, selection_of
from hypogoal.options.tables import Choices, Episodes

SUB_GOALS = ["open-red-door"]


def made(seed=0, *, chooser="ppo", episodes=120, reward=1.0, length=20, shortest=10, **config):
    """A run whose episodes are all alike: the last of them came to its end where there is a reward."""
    end = np.arange(1, episodes + 1) * length
    rewards = np.full(episodes, reward, dtype=np.float64)
    found = Episodes(end, np.full(episodes, length), rewards, rewards > 0, rewards > 0)
    layout = {"layout_seed": 200, "shortest_path": shortest, "random_success": 0.25, "random_episodes": 10}
    about = {"termination": "learned", "chooser": chooser, "steps": episodes * length, **config}
    return Run("meta", f"meta-{chooser}-{config.get('ensemble', '')}-{seed}", seed, about, found, layout)


def material_of(*runs):
    """What an evaluation of these runs holds of agents."""
    groups = group_runs(runs)
    grid = common_grid(runs)
    arrays = {"curves/grid": grid}
    for index, same in enumerate(groups.values()):
        arrays |= {f"curves/{index}/{key}": values for key, values in agent_curves(same, grid).items()}
    agents = agents_table(
        [row for name, same in groups.items() for run in same for row in rows_of_run(run, name)], groups
    )
    metrics = {"agents": agents, "layouts": [runs[0].layout], "settings": {"window": 100}, "missing": []}
    metrics["selection"] = chosen(groups)
    nothing = {
        "hypotheses": [],
        "ensembles": [],
        "rooms": [],
        "saliency": None,
        "choosing": [],
        "comparisons": {"agents": []},
        "distance": {"options": [], "shown": []},
    }
    return Material(plain({**metrics, **nothing}), arrays)


def chosen(groups):
    """Two members of one sub-goal: the second is chosen more often, and an ensemble for each name of one."""
    columns = ([100, 100], [0, 1], [50, 50], [10, 40], [25.0, 25.0], [5, 30], [50, 60])
    choices = Choices(*(np.array(column) for column in columns))
    runs = {run.path: (name, run) for name, same in groups.items() for run in same}
    rows = []
    for path, (name, run) in runs.items():
        place = {"method": name, "layout": 200, "seed": run.seed, "artefact": path}
        rows += rows_of_choices(choices, SUB_GOALS, 2, {"match": np.array([0.6, 0.9])}, **place)
    selection = selection_of(rows)
    for entry in (entry for agent in selection for entry in agent["runs"]):
        entry["ensemble"] = runs[entry["path"]][1].config.get("ensemble")
    return selection


@pytest.mark.parametrize("reward", [20.0, -3.0])
def test_figure_6_shows_rewards_of_any_size(reward):
    """Spec F5: limits that fit the rewards; no share of successes drawn or told of on an axis of other rewards."""
    material = material_of(made(reward=reward))
    (row,) = (block for block in summary_section(material)["blocks"] if block["kind"] == "row")
    axes = material.figures["reward"].axes[0]
    low, high = axes.get_ylim()
    assert low < reward < high
    assert [text.get_text() for text in axes.texts] == ["option agent"]
    caption = next(block["caption"] for block in row["blocks"] if block.get("id") == "figure-reward")
    assert "random play" not in caption


def test_figure_6_of_rewards_that_are_shares_is_the_same_for_all_tasks():
    """Spec F5: limits a little beyond 0 and 1, and what random play comes to."""
    material = material_of(made())
    (row,) = (block for block in summary_section(material)["blocks"] if block["kind"] == "row")
    axes = material.figures["reward"].axes[0]
    assert axes.get_ylim() == (-0.02, 1.04)
    assert axes.get_lines()[1].get_ydata()[0] == 0.25
    caption = next(block["caption"] for block in row["blocks"] if block.get("id") == "figure-reward")
    assert caption.endswith("Dotted: mean over layouts of uniformly random play.")


def tables_of(material):
    """Of every table of agents the cell of the first agent in the column of those near the shortest path."""
    blocks = [*summary_section(material)["blocks"], *runs_section(material)["blocks"]]
    tables = [block for block in blocks if block["kind"] == "table" and block["columns"][0]["name"] == "agent"]
    names = [[column["name"] for column in block["columns"]] for block in tables]
    places = [name.index("within 1.5 shortest paths") for name in names]
    return [block["rows"][0]["cells"][place] for block, place in zip(tables, places, strict=True)]


def test_every_table_of_agents_says_how_many_came_near_the_shortest_path():
    """Spec F5: its mean with its error, its interval; dashes where nobody knows the path."""
    known = [made(seed, length=length, steps=2_000) for seed, length in enumerate((15, 16, 15, 16))]
    material = material_of(*known)
    spread, interval = tables_of(material)
    assert (spread["text"], spread["small"]) == ("0.50", "± 0.29")
    assert interval.startswith("0.50 [")
    assert [run["near"] for run in material.metrics["agents"][0]["runs"]] == [1, 0, 1, 0]
    assert "1.5 times the layout's shortest path" in meanings()["near"]["meaning"]
    unknown = material_of(*(made(seed, shortest=None) for seed in range(4)))
    spread, interval = tables_of(unknown)
    assert [spread["text"], interval] == ["–"] * 2
    assert {run["near"] for run in unknown.metrics["agents"][0]["runs"]} == {None}


def two(chooser="ppo", **more):
    """Two seeds with each of two ensembles."""
    return [made(seed, chooser=chooser, ensemble=name, **more) for name in ("dbat", "none") for seed in (0, 1)]


def test_sections_that_show_one_variant_say_which():
    """Spec F6: preferences, and Figures 7 and 8."""
    shown = "Shown is options (learned members), ensemble=dbat, one of 2 variants of the option agent."
    material = material_of(*two(), *two("random")[2:])
    assert shown in sections(material)[0]["paragraphs"]
    captions = {one.name: one.caption for one in paper_figures(material)[0]}
    assert captions["figure7"].endswith(shown)


def test_a_member_s_options_are_those_of_every_variant_with_its_ensemble():
    """Spec F6: the browser of states names the variant, and shows none of another ensemble."""
    found = _options(material_of(*two()), "none", SUB_GOALS[0], 1)
    assert [one["name"] for one in found] == [f"layout 200, run seed {seed}, ensemble=none" for seed in (0, 1)]
    assert [one["name"] for one in _options(material_of(made()), None, SUB_GOALS[0], 1)] == ["layout 200, run seed 0"]


def test_no_two_agents_have_the_same_line():
    """Spec F5: Figure 6 of many variants, none of which has a colour of its own."""
    variants = [made(ensemble=name, chooser=who) for who in ("ppo", "random") for name in "abcde"]
    material = material_of(*variants)
    summary_section(material)
    lines = material.figures["reward"].axes[0].get_lines()[: len(variants)]
    assert len({(line.get_color(), str(line._dash_pattern)) for line in lines}) == len(variants)


def test_of_one_variant_nothing_is_said_of_variants():
    """Spec F7: the page of one option agent and its control, whatever their names, speaks of no variant."""
    material = material_of(made(), made(chooser="random", reward=0.0))
    assert "variant" not in str(sections(material))
    drawn, _ = paper_figures(material)
    assert "variant" not in str([figure.caption for figure in drawn])


def test_failures_are_shares_and_lengths_are_of_solved_episodes():
    """An agent that solves nothing has no steps, and no line in the figure of lengths."""
    material = material_of(made(), made(chooser="random", reward=0.0, length=500))
    table = next(block for block in summary_section(material)["blocks"] if block["kind"] == "table")
    names = [column["name"] for column in table["columns"]]
    solved, failed = (dict(zip(names, row["cells"], strict=True)) for row in table["rows"])
    assert (solved["steps"]["text"], failed["steps"]["text"]) == ("20", "–")
    assert float(failed["failed: ended"]) + float(failed["cut"]) == 1
    assert "length" not in material.figures  # all solved ones take as long: nothing to see
