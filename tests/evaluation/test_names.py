"""Spec E6, E7, F5: runs that were not made alike have different names, which people can read."""

import pytest

from hypogoal.evaluation.names import agent_title, ensemble_title, groups_of, names_apart, rank

META = {"termination": "learned", "chooser": "ppo"}


@pytest.mark.parametrize(
    ("kind", "config", "title"),
    [
        ("meta", META, "option agent"),
        ("meta", META | {"chooser": "random"}, "random choice"),
        ("meta", META | {"termination": "oracle"}, "oracle terminations"),
        ("meta", {"termination": "oracle", "chooser": "random"}, "oracle terminations, random choice"),
        ("meta", META | {"chooser": "first:First"}, "option agent, chooser=first:First"),
        ("options", {}, "random choice while options learn"),
        ("baseline", {"agent": "dqn", "setting": "paper"}, "DQN paper"),
    ],
)
def test_agents_are_named_after_how_they_choose(kind: str, config: dict, title: str) -> None:
    assert agent_title(kind, config) == title


@pytest.mark.parametrize(
    ("members", "diversity", "title"),
    [
        (3, "dbat", "D-BAT, 3 members"),
        (3, "none", "no diversity, 3 members"),
        (1, "dbat", "one classifier"),
        (6, "own:loss", "own:loss, 6 members"),
    ],
)
def test_ensembles_are_named_after_their_objective(members: int, diversity: str, title: str) -> None:
    assert ensemble_title({"members": members, "diversity": diversity}) == title


def test_what_most_have_in_common_goes_unsaid() -> None:
    """Of four that are alike but for one setting each, each is named after that one; half and half are both named."""
    configs: list[dict[str, object]] = [{"a": 1, "b": 1}, {"a": 2, "b": 1}, {"a": 1, "b": 2}, {"a": 1, "b": 1}]
    assert names_apart(["x"] * 4, configs) == ["x", "x, a=2", "x, b=2", "x"]
    assert names_apart(["x"] * 2, configs[:2]) == ["x, a=1", "x, a=2"]
    assert names_apart(["x"] * 2, configs[:2], [1, 2]) == ["x", "x"], "at another N each is alone"


def test_an_agent_of_one_of_several_ensembles_has_its_name() -> None:
    """In place of 'option agent', behind the others' names."""
    configs = [{"ensemble": "D-BAT, 3 members"}, {"ensemble": "one classifier"}]
    assert names_apart(["option agent"] * 2, configs) == ["D-BAT, 3 members", "one classifier"]
    alike = [configs[0] | {"steps": 1}, configs[0] | {"steps": 2}]
    assert names_apart(["option agent"] * 2, alike) == ["option agent, steps=1", "option agent, steps=2"]
    assert names_apart(["random choice"] * 2, configs)[0] == "random choice, D-BAT, 3 members"
    both = [configs[0] | {"a": 1}, configs[1] | {"a": 2}]
    assert names_apart(["option agent"] * 2, both) == ["D-BAT, 3 members, a=1", "one classifier, a=2"]


def test_settings_of_the_domain_split_and_n_does_not() -> None:
    base = {"members": 6, "domain_config": {"groups": 1, "states": 10}}
    more = {**base, "domain_config": {"groups": 2, "states": 10}}
    other = {**base, "domain_config": {"groups": 2, "states": 20}}
    assert names_apart(["x"] * 2, [base, more]) == ["x", "x"]
    assert names_apart(["x"] * 2, [base, other]) == ["x, states=10", "x, states=20"]
    assert (groups_of(more), groups_of({}), groups_of({"domain_config": None})) == (2, None, None)


def test_the_papers_method_comes_first() -> None:
    names = ["PPO tuned", "random choice while options learn", "one classifier", "random choice", "D-BAT, 3 members"]
    assert sorted(names, key=rank) == [*names[:1:-2], names[3], names[1], names[0]]
