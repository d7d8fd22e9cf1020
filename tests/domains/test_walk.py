"""What follows in Gymnasium environments, found by walking through them (Spec B6, H3)."""

from copy import deepcopy
from typing import Any

import corridor_env
import gymnasium
import numpy as np
import pytest
from corridor_env import LENGTH, SUB_GOALS, CorridorEnv
from gymnasium.wrappers import TimeLimit, TransformAction
from minigrid.envs import DoorKeyEnv, FetchEnv
from minigrid.wrappers import ImgObsWrapper, RGBImgPartialObsWrapper

from hypogoal.core.errors import UserError
from hypogoal.core.progress import Progress
from hypogoal.domains.base import Layouts
from hypogoal.domains.gymnasium import walk
from hypogoal.domains.gymnasium.domain import GymnasiumConfig, GymnasiumDomain
from hypogoal.domains.gymnasium.engine import GymnasiumEngine
from hypogoal.options.planned import distances, places_of


def fetch() -> gymnasium.Env:
    """Two things in a small room, seen from within; turn, walk, pick up."""
    env = ImgObsWrapper(RGBImgPartialObsWrapper(FetchEnv(size=5, numObjs=2), tile_size=8))
    return TransformAction(env, int, gymnasium.spaces.Discrete(4))


def place(env: Any) -> tuple[int, ...]:
    """Where the agent is, which its view hides."""
    return (*map(int, env.unwrapped.agent_pos), int(env.unwrapped.agent_dir))


def holds(env: Any) -> bool:
    return env.unwrapped.carrying is not None


FETCH = GymnasiumDomain(fetch, {"holds": holds}, plan=place)


def engine_of(domain: GymnasiumDomain = FETCH, seeds: tuple[int, ...] = (0,), **arguments: Any) -> GymnasiumEngine:
    return domain.make_engine(0, len(seeds), 60, layouts=Layouts(seeds), **arguments)


def test_a_plan_is_what_the_environment_does() -> None:
    """In two layouts of MiniGrid's Fetch at once, whose views look alike in many places."""
    engine, rng = engine_of(seeds=(0, 1)), np.random.default_rng(0)
    plan = engine.plan()
    assert plan is not None
    free = 2 * (9 - 2) * 4  # cells and directions of both layouts; the agent never enters a thing's cell
    ends = int(plan.final.sum())
    assert len(plan.ids) == free + ends
    at = places_of(plan, engine)
    rewarded = set()
    for _ in range(400):
        before, actions = engine.ids.copy(), rng.integers(4, size=2)
        step = engine.step(actions)
        np.testing.assert_array_equal(plan.following[at[before], actions], step.next_ids)
        np.testing.assert_array_equal(plan.final[at[step.next_ids]], step.terminated)
        np.testing.assert_array_equal(plan.solved[at[step.next_ids]], step.rewards > 0)
        rewarded |= {*step.next_ids[step.rewards > 0].tolist()}
    assert rewarded and rewarded <= {*plan.ids[plan.solved].tolist()} < {*plan.ids[plan.final].tolist()}
    assert engine.n_states == len(plan.ids)  # playing met nothing new


def test_the_shortest_way_is_that_of_a_search_by_copies() -> None:
    """In MiniGrid's DoorKey, where a door opens and closes and a key can be dropped anywhere."""

    def make() -> gymnasium.Env:
        return ImgObsWrapper(RGBImgPartialObsWrapper(DoorKeyEnv(size=5), tile_size=8))

    def state_of(env: Any) -> Any:
        return env.unwrapped.grid.encode().tobytes(), place(env), holds(env)

    domain = GymnasiumDomain(make, {"holds": holds}, plan=state_of)
    engine = engine_of(domain)
    plan = engine.plan()
    assert plan is not None
    start = places_of(plan, engine)[engine.ids[0]]
    steps = distances(plan.solved[:, None], places_of(plan, engine)[plan.following], plan.final)[start, 0]
    env = DoorKeyEnv(size=5)
    env.reset(seed=0)
    reached, seen, depth = [env], {state_of(env)}, 0
    while True:
        depth += 1
        following = []
        for before in reached:
            for action in range(7):
                after = deepcopy(before)
                _, reward, *_ = after.step(action)
                if reward > 0:
                    assert depth == steps
                    return
                if state_of(after) not in seen:
                    seen.add(state_of(after))
                    following.append(after)
        reached = following


def test_an_engine_with_a_plan_goes_on_from_a_snapshot() -> None:
    one, other = engine_of(seeds=(0, 1)), engine_of(seeds=(0, 1))
    one.plan()
    rng = np.random.default_rng(1)
    actions = rng.integers(4, size=(60, 2))
    for row in actions[:30]:
        one.step(row)
    other.plan()
    other.restore(one.snapshot())
    for row in actions[30:]:
        for left, right in zip(one.step(row), other.step(row), strict=True):
            np.testing.assert_array_equal(left, right)
    assert one.n_states == other.n_states


def test_what_episodes_are_too_short_for_is_in_no_plan() -> None:
    """The corridor's right end is three steps from the start, its left end two."""
    for steps, cells in ((1, {1, 2, 3}), (2, {0, 1, 2, 3, 4}), (9, {*range(LENGTH)})):

        def make(steps: int = steps) -> gymnasium.Env:
            return TimeLimit(CorridorEnv(), steps)

        engine = engine_of(GymnasiumDomain(make, SUB_GOALS, plan=True))
        plan = engine.plan()
        assert plan is not None
        seen = engine.images(plan.ids)[:, 0, ::8, 0].argmax(1)
        assert {*seen.tolist()} == cells


def test_success_says_what_is_solved() -> None:
    """An end of the corridor is reached with a loss, and ``success`` calls it one."""
    domain = GymnasiumDomain(corridor_env.Paid, SUB_GOALS, success=lambda *_: False, plan=True)
    plan = engine_of(domain).plan()
    assert plan is not None
    assert plan.final.sum() == 1 and not plan.solved.any()
    rewarded = engine_of(GymnasiumDomain(CorridorEnv, SUB_GOALS, plan=True)).plan()
    assert rewarded is not None and rewarded.solved.sum() == 1


def test_a_success_by_earlier_rewards_needs_a_function() -> None:
    """A coin pays and the right end does not, so an episode's success is no matter of its last state."""

    class Coin(CorridorEnv):
        def step(self, action: int) -> Any:
            image, _, over, cut, info = super().step(action)
            return image, float(self.cell == 3), over, cut, info

    with pytest.raises(UserError, match=r"succeeds by rewards before its last.*layout_seed=0, action=1.*success=f"):
        engine_of(GymnasiumDomain(Coin, SUB_GOALS, plan=True)).plan()
    plan = engine_of(GymnasiumDomain(Coin, SUB_GOALS, success=lambda *_: True, plan=True)).plan()
    assert plan is not None and plan.solved.sum() == 1


def test_no_plan_unless_asked_for() -> None:
    assert engine_of(corridor_env.DOMAIN).plan() is None


@pytest.mark.parametrize("make", [fetch, corridor_env.Restless])
def test_what_is_not_determined_is_not_planned(make: Any) -> None:
    """Views that look alike in two places, and steps that are drawn."""
    goals = {"holds": holds} if make is fetch else SUB_GOALS
    with pytest.raises(UserError, match=r"led from the same state to another one.*layout_seed=0, action=.*Give plan=f"):
        engine_of(GymnasiumDomain(make, goals, plan=True)).plan()


def test_a_change_after_planning_is_noticed() -> None:
    """Once the plan is made the corridor turns round."""
    turned = [False]

    class Turning(CorridorEnv):
        def step(self, action: int) -> Any:
            return super().step(1 - action if turned[0] else action)

    engine = engine_of(GymnasiumDomain(Turning, SUB_GOALS, plan=True))
    assert engine.plan() is not None
    engine.step(np.array([0]))
    turned[0] = True
    with pytest.raises(UserError, match="led from the same state to another one"):
        engine.step(np.array([0]))


def test_too_many_states_are_one_line(monkeypatch: pytest.MonkeyPatch) -> None:
    """Counted over all layouts; the engine's memory is a bound, too."""
    with pytest.raises(UserError, match="more than 20 states, too many to plan in: layout_seed=0"):
        engine_of(memory=20).plan()
    engine_of(memory=50).plan()
    monkeypatch.setattr(walk, "MOST", 50)
    with pytest.raises(UserError, match="more than 50 states, too many to plan in: layout_seed=1"):
        engine_of(seeds=(0, 1)).plan()


def test_environments_differ_by_split() -> None:
    """Labelled in one corridor, played in another; features are kept beside states, and balance what is held out."""

    class Short(CorridorEnv):
        def step(self, action: int) -> Any:
            image, reward, over, cut, info = super().step(action)
            return image, reward, over, cut or self.cell == 1, info

    makes = {"training": CorridorEnv, "labelled": Short}
    domain = GymnasiumDomain(
        makes, {"right-end": corridor_env.at_right}, origins={"planted_left": corridor_env.at_left}
    )
    config = GymnasiumConfig(heldout_seeds=(4, 5), unlabelled_seeds=(1,), steps=200, states=3)
    found = domain.collect(config, 0, Progress("collect", 1, quiet=True))
    cells = found.labelled.observations[:, 0, ::8, 0].argmax(1)
    assert cells.min() == 1
    assert isinstance(domain.make_env(), CorridorEnv) and not isinstance(domain.make_env(), Short)
    heldout = found.heldout.observations[:, 0, ::8, 0].argmax(1)
    np.testing.assert_array_equal(found.heldout.origins["planted_left"], heldout == 0)
    assert (heldout == 0).sum() == (heldout == LENGTH - 1).sum() == 2  # one of each on both layouts
    assert not found.labelled.origins["planted_left"].any()


@pytest.mark.parametrize("makes", [{"labelled": CorridorEnv}, {"training": CorridorEnv, "tests": CorridorEnv}])
def test_unknown_splits_are_refused(makes: Any) -> None:
    with pytest.raises(UserError, match=r"make is of unknown splits: .*Give training, and any of labelled"):
        GymnasiumDomain(makes, SUB_GOALS)
