"""Spec E6, E7, F5: runs that were not made alike are not averaged; what is missing is said."""

import numpy as np
import pytest
from works import named, work_of

from hypogoal.evaluation.curves import (
    LEARNED,
    ORACLE,
    RANDOM,
    Run,
    agent_curves,
    agents_table,
    base_name,
    common_grid,
    group_runs,
    missing,
    rows_of_run,
)
from hypogoal.evaluation.numbers import ensemble_names, name_apart
from hypogoal.evaluation.selection import rows_of_choices, selection_of
from hypogoal.options.tables import Choices, Episodes

META = {"termination": "learned", "chooser": "ppo", "steps": 1_000, "options_steps": 200, "option_gamma": 0.95}
DOORS = {"door_label": "unlocked"}


def made(layout_seed=100, seed=0, kind="meta", episodes=120, success=1, shortest=10, **config):
    length = np.full(episodes, 20)
    done = np.full(episodes, bool(success))
    run = Episodes(np.arange(1, episodes + 1) * 10, length, done.astype(float), done, done)
    layout = {"layout_seed": layout_seed, "shortest_path": shortest, "random_success": 0.1, "random_episodes": 10}
    about = {
        **(META if kind == "meta" else {"steps": 1_000}),
        "domain_config": DOORS,
        "layout_seed": layout_seed,
        **config,
    }
    return Run(kind, f"{kind}/{layout_seed}-{seed}", seed, about, run, layout)


def test_agents_are_named_after_how_they_choose():
    """Spec E6, E7: the agent, its two controls and the baselines, in the report's order, layouts together."""
    runs = [
        made(kind="baseline", agent="dqn", setting="paper"),
        made(termination="oracle"),
        made(chooser="random"),
        made(),
        made(layout_seed=101, seed=1),
        made(kind="baseline", agent="ppo", setting="tuned"),
    ]
    groups = group_runs(runs)
    assert list(groups) == [LEARNED, RANDOM, ORACLE, "PPO tuned", "DQN paper"]
    assert len(groups[LEARNED]) == 2
    assert base_name("options", {}) == "random choice while options learn"
    assert missing(work_of(agents=named(*groups))) == [], "what nobody asked for is not missed"
    assert missing(work_of(agents=[])) == ["no agents"]


def test_a_setting_that_differs_splits_an_agent():
    """Spec F5: a run with another discount is another agent."""
    groups = group_runs([made(), made(seed=1, option_gamma=0.9), made(seed=2, domain_config={"door_label": "open"})])
    assert sorted(groups) == [LEARNED, f"{LEARNED}, door_label=open", f"{LEARNED}, option_gamma=0.9"]


def table_of(runs):
    """The agent's entry."""
    (entry,) = agents_table([row for run in runs for row in rows_of_run(run, "agent")], {"agent": runs})
    return entry


def test_numbers_over_runs():
    """Spec F5: mean over layouts, each once; how many got to 95 %, and the median that counts those that did not."""
    runs = [made(), made(seed=1), made(layout_seed=101, success=0, shortest=20)]
    metrics = table_of(runs)
    assert metrics["success"]["mean"] == pytest.approx((1 + 0) / 2)
    assert metrics["length_over_shortest"]["mean"] == pytest.approx((2 + 1) / 2)
    assert metrics["steps_to_95"] == {"reached": 2, "median": 1_000.0, "n": 3, "unit": "environment steps"}
    assert metrics["runs"][0]["steps"] == 1_200
    never = table_of(runs[2:])["steps_to_95"]
    assert (never["reached"], never["median"]) == (0, None)


def test_curves_end_with_the_budget():
    """Figure 6: beyond its budget a run has no curve, and the grid reaches the largest one."""
    runs = [made(), made(seed=1, steps=300)]
    grid = common_grid(runs, points=13)
    assert grid.tolist() == list(range(0, 1_201, 100))
    reward = agent_curves(runs, grid)["reward"]
    assert np.isnan(reward[1, 6:]).all()
    assert reward[1, 5] == reward[0, 12] == 1


def test_ensembles_are_named_after_their_objective():
    """Spec C1, F1: settings without effect do not split, those with effect do."""
    base = {"members": 3, "diversity": "dbat", "diversity_weight": 1e-4, "steps": 300}
    single = {**base, "members": 1}
    assert ensemble_names([base, {**base, "diversity": "none"}, single, {**single, "diversity": "none"}]) == [
        "dbat, K=3", "no diversity, K=3", "single CNN", "single CNN",
    ]  # fmt: skip
    assert ensemble_names([base, {**base, "steps": 600}]) == ["dbat, K=3, steps=300", "dbat, K=3, steps=600"]


def test_selection_of_a_run_by_hand():
    """Spec F6: two sub-goals of two members, two windows; one member is never offered."""
    rows = [
        # step, option, offered, chosen, expected, reached, duration
        (100, 0, 40, 10, 20.0, 5, 50), (100, 1, 40, 20, 10.0, 20, 40), (100, 2, 0, 0, 0.0, 0, 0),
        (100, 3, 10, 0, 5.0, 0, 0),
        (200, 0, 40, 0, 10.0, 0, 0), (200, 1, 40, 30, 10.0, 30, 60), (200, 2, 0, 0, 0.0, 0, 0),
        (200, 3, 10, 10, 5.0, 9, 20),
    ]  # fmt: skip
    columns = [np.array(column) for column in zip(*rows, strict=True)]
    match = {"match": np.array([0.6, 0.9, 0.5, 1.0])}
    (agent,) = selection_of(list(rows_of_choices(Choices(*columns), ("a", "b"), 2, match)))
    first, second = agent["runs"][0]["sub_goals"]
    assert [member["preference"] for member in first["members"]] == pytest.approx([10 / 30, 50 / 20])
    assert [member["match"] for member in first["members"]] == [0.6, 0.9]
    assert [member["option"] for member in second["members"]] == [2, 3]
    assert [member["chosen"] for member in second["members"]] == [0, 10]
    assert first["members"][1]["duration"] == 2
    assert (first["most"], first["least"]) == (1, 0)
    assert np.isnan(second["members"][0]["preference"])
    assert (second["most"], second["least"]) == (1, 1)


def test_what_most_have_in_common_goes_unsaid() -> None:
    """Of five that are alike but for one setting each, each is named after that one; half and half are both named."""
    configs: list[dict[str, object]] = [{"a": 1, "b": 1}, {"a": 2, "b": 1}, {"a": 1, "b": 2}, {"a": 1, "b": 1}]
    assert name_apart(["x"] * 4, configs) == ["x", "x, a=2", "x, b=2", "x"]
    assert name_apart(["x"] * 2, configs[:2]) == ["x, a=1", "x, a=2"]


def test_a_users_own_chooser_has_its_name():
    """Spec E6: it is no PPO; the page still shows it as an option agent."""
    assert base_name("meta", {"termination": "learned", "chooser": "first:First"}) == f"{LEARNED}, chooser=first:First"
    assert base_name("meta", {"termination": "oracle", "chooser": "first:First"}) == f"{ORACLE}, chooser=first:First"
