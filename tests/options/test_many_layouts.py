"""Episodes in many layouts: engines, what is kept of them, and options tried without learning (Spec H6)."""

from collections import Counter
from pathlib import Path
from typing import Any

import corridor_env
import numpy as np
import own_domain
import pytest
from corridor import Corridor
from option_loops import Scripted, loop_of

from hypogoal.core.artefacts import open_artefact
from hypogoal.core.errors import UserError
from hypogoal.core.seeding import rng_for
from hypogoal.domains.base import Engine, Layouts
from hypogoal.domains.doorkey.engine import DoorKeyEngine
from hypogoal.evaluation.frozen import play
from hypogoal.evaluation.names import UNIFORM
from hypogoal.evaluation.zero_shot import alone, played, shortest_ways
from hypogoal.meta.config import TrainOptionsConfig, layout_seeds
from hypogoal.meta.setup import Setup, make_engine
from hypogoal.options.loop import OptionLoop
from hypogoal.options.termination import Terminations, oracle_terminations

SEEDS = (5, 100, 101, 7)


def drawn(seeds: tuple[int, ...] = SEEDS) -> Layouts:
    return Layouts(seeds, rng_for(0, "layouts"))


def corridors(layouts: int | Layouts, count: int) -> Engine:
    if isinstance(layouts, int):
        return corridor_env.DOMAIN.make_engine(layouts, count, 9)
    return corridor_env.DOMAIN.make_engine(0, count, 9, layouts=layouts)


def doorkeys(layouts: int | Layouts, count: int) -> Engine:
    return DoorKeyEngine(layouts, count, max_steps=40)


@pytest.mark.parametrize(("make", "steps"), [(corridors, 60), (doorkeys, 400)])
def test_each_episode_is_one_of_its_layout(make: Any, steps: int) -> None:
    """Step by step what an engine of that layout alone gives; every layout is drawn, and about as often as another."""
    engine, rng = make(drawn(), 6), np.random.default_rng(0)
    alone_there = {seed: make(seed, 1) for seed in SEEDS}
    played: list[list[int]] = [[] for _ in range(6)]
    where, begun = [*engine.layouts.now], Counter(engine.layouts.now)
    for _ in range(steps):
        actions = rng.integers(engine.n_actions, size=6)
        step = engine.step(actions)
        images, labels = engine.images(step.next_ids), engine.labels(step.next_ids)
        for place in range(6):
            played[place].append(int(actions[place]))
            if len(played[place]) % 13 == 0 or step.terminated[place]:
                other = alone_there[where[place]]
                other.reset()
                for action in played[place]:
                    last = other.step(np.array([action]))
                assert np.array_equal(other.images(last.next_ids)[0], images[place])
                assert np.array_equal(other.labels(last.next_ids)[0], labels[place])
                assert (last.rewards[0], last.terminated[0]) == (step.rewards[place], step.terminated[place])
            if engine.elapsed[place] == 0:
                played[place], where[place] = [], engine.layouts.now[place]
                begun[where[place]] += 1
    assert sorted(begun) == sorted(SEEDS) and max(begun.values()) < 3 * min(begun.values())


@pytest.mark.parametrize("make", [corridors, doorkeys])
def test_one_among_layouts_is_as_that_one(make: Any) -> None:
    """Draws nothing."""
    one, other = make(Layouts((5,)), 3), make(5, 3)
    assert one.layouts.now == [5, 5, 5]
    actions = np.arange(30).reshape(10, 3) % 2
    assert all(np.array_equal(one.step(row).next_ids, other.step(row).next_ids) for row in actions)


def test_in_turn_each_environment_keeps_its_own() -> None:
    """Which is how layouts are tried: no short episode takes the place of a long one."""
    engine = doorkeys(Layouts(SEEDS), 6)
    engine.restart(np.array([True, False, True, True, False, False]))
    assert engine.layouts is not None and engine.layouts.now == [5, 100, 101, 7, 5, 100]


def test_plans_are_of_all_layouts_together() -> None:
    engine, none = DoorKeyEngine(Layouts(SEEDS), 4), np.random.default_rng(0)
    ways, plan = shortest_ways(engine), engine.plan()
    assert len(plan.ids) == sum(len(DoorKeyEngine(seed).plan().ids) for seed in SEEDS)
    assert ways[:, -1].tolist() == [DoorKeyEngine(seed).shortest_path() for seed in SEEDS]
    assert engine.shortest_path() is None and 0 <= engine.random_success(20, none) <= 1


def planned_loop(terminations: Any) -> OptionLoop:
    engine = DoorKeyEngine(Layouts(SEEDS), 4)
    return loop_of(engine, ends=terminations(engine), network="planned", environments=4, mask_reached=False)


def test_planned_options_to_true_sub_goals_are_perfect_without_learning() -> None:
    """The upper bound: each in the fewest steps, also where these are more than a timeout; chance succeeds, too."""
    loop = planned_loop(lambda engine: oracle_terminations(engine, range(5)))
    ways = shortest_ways(loop.engine)
    for option in range(5):
        told = alone(loop, option, option, ways[:, option])
        assert all(told[name].tolist() == [1.0] * 4 for name in ("success", "near", "within_2"))
        assert told["false_positives"].tolist() == [0.0] * 4
        assert alone(loop, option, option, ways[:, option] / 2.1)["within_2"].tolist() == [0.0] * 4
    episodes = play(loop, loop.chooser, 3)
    assert episodes.succeeded.shape == (4, 3) and episodes.succeeded.all()
    assert (episodes.length >= ways[:, -1:]).all()


def test_a_wrong_member_is_told_from_an_option_that_gets_nowhere() -> None:
    """The door's option ends at the red key, the goal's nowhere; the key's own is where it should be."""

    def ends(engine: Engine) -> Terminations:
        never = np.array([True, True, True, True, False])
        return Terminations.of_predictions(lambda ids: engine.labels(ids)[:, [0, 1, 2, 2, 4]] & never, 5)

    loop = planned_loop(ends)
    ways = shortest_ways(loop.engine)
    found = [alone(loop, option, option, ways[:, option]) for option in (2, 3, 4)]
    assert [told["success"].mean() for told in found] == [1, 0, 0]
    assert [told["false_positives"].mean() for told in found] == [0, 1, 0]


def test_an_agent_and_random_choice_among_its_options_are_played(tiny_run: Path) -> None:
    """Beside each option alone, whatever its kind; an artefact of options has no choice of its own to play."""
    every: dict[str, list[Any]] = {}
    for kind in ("meta", "options"):
        of_kind = played(open_artefact(tiny_run / kind), (100, 101))
        every[kind] = [fields for fields, _ in of_kind]
    alone_in_turn = every["options"]
    assert [fields["member"] for fields in alone_in_turn] == [0, 1, 0, 1]
    assert every["meta"] == [{}, {"method": UNIFORM}, *alone_in_turn]


def test_the_setting_says_how_many_or_which() -> None:
    assert layout_seeds("", 100) == layout_seeds("1", 100) == [100]
    assert layout_seeds("3", 100) == layout_seeds("100-102", 7) == [100, 101, 102]
    assert layout_seeds("7,9,7") == [7, 9]
    for text in ("200", "", "two", "0"):
        with pytest.raises(UserError):
            layout_seeds(text)
    about, config = {"sub_goals": ["left-end"], "members": 1, "domain_config": {}}, TrainOptionsConfig.of(layouts="2")
    with pytest.raises(UserError, match="plays one layout"):
        make_engine(Setup(own_domain.DOMAIN, about, Path(), config, 0))
    layouts = make_engine(Setup(corridor_env.DOMAIN, about, Path(), config, 0)).layouts
    assert layouts is not None and layouts.seeds == (100, 101)
    assert Corridor(1).layouts is None


def test_an_option_alone_is_not_played_into_the_next_episode() -> None:
    """It goes right, which ends the episode, and only in the next one to the left end."""
    told = alone(loop_of(Corridor(1), Scripted(1, 1, 1, 0)), 0, 0, np.array([2.0]))
    assert (told["success"].tolist(), told["false_positives"].tolist()) == ([0.0], [0.0])
