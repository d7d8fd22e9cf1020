"""Play of trained agents, and of each of their options alone, on given layouts, where nothing is learned.

An agent's options tell what limits it: they stop at a false positive of their member, or get nowhere in time.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import TYPE_CHECKING, Any

import numpy as np
import pandas as pd

from hypogoal.core.arrays import Doubles
from hypogoal.core.artefacts import Artefact
from hypogoal.domains.base import Engine
from hypogoal.domains.find import load_domain
from hypogoal.evaluation.choosing import with_choosers
from hypogoal.evaluation.curves import scores
from hypogoal.evaluation.names import UNIFORM
from hypogoal.evaluation.statistics import tables_of
from hypogoal.evaluation.table import options_of, per_run

if TYPE_CHECKING:
    from hypogoal.options.loop import OptionLoop

EPISODES = 3  # episodes of an agent on each layout
AT_ONCE = 100  # layouts that are played at once
PATIENCE = 10  # timeouts after which an option alone is given up
QUANTITIES = ("success", "near", "within_2", "length", "false_positives")
TITLE = "On other layouts, without learning"
SCOPE = "zero-shot"
BY = ["method", "chooser", "sub_goal", "member"]
Played = dict[str, Doubles]  # a number of each layout (L,)


def shortest_ways(engine: Engine) -> Doubles:
    """Return the steps from each environment's state to each true sub-goal and, last, to success: (E, G + 1).

    Steps that are not known are NaN.
    """
    # with PyTorch, which a report does not need
    from hypogoal.options.planned import FAR, distances, places_of

    plan = engine.plan()
    labels = engine.labels(engine.ids)
    if plan is None:
        return np.full((engine.count, labels.shape[1] + 1), np.nan)
    place = places_of(plan, engine)
    holds = np.column_stack([engine.labels(plan.ids), plan.solved])
    every = distances(holds, place[plan.following], plan.final)
    steps = every[place[engine.ids]]
    return np.where(steps < FAR, steps, np.nan)


def alone(
    loop: OptionLoop,
    option: int,
    goal: int,
    shortest: Doubles,
) -> Played:
    """Return numbers of an option that runs alone until its member is positive.

    The option begins where episodes begin, and begins anew at each timeout. It succeeds if its true sub-goal, number
    ``goal`` of the engine's labels, holds where it ends. The numbers are NaN where that sub-goal holds from the
    beginning.
    """
    from hypogoal.evaluation.frozen import Always

    loop.begin_anew(Always(option))
    engine = loop.engine
    holds = engine.labels(engine.ids)[:, goal]
    steps = np.zeros(engine.count, int)
    positive, reached = np.zeros((2, engine.count), bool)
    going = ~positive
    for _ in range(PATIENCE * loop.config.option_timeout):
        moved = loop.advance(learning=False)
        steps[going] += 1
        ends = going & moved.reached
        positive |= ends
        reached |= ends & engine.labels(moved.next_ids)[:, goal]
        going &= ~moved.reached & (engine.elapsed > 0)  # else the episode ended
        if not going.any():
            break
    false_positives = positive & ~reached
    numbers = scores(reached, steps, shortest) | {"false_positives": false_positives * 1.0}
    return {name: np.where(holds, np.nan, values) for name, values in numbers.items()}


def played(artefact: Artefact, layouts: tuple[int, ...]) -> Iterator[tuple[dict[str, Any], Played]]:
    """Yield the numbers of an agent, of random choice among its options, and of each option alone.

    Each comes after the fields of its rows.
    """
    from hypogoal.evaluation.frozen import play_both
    from hypogoal.meta.episodes import agent_of

    config = artefact.config
    in_domain = load_domain(config["domain"]).sub_goals
    loop = agent_of(artefact, artefact.seed, len(layouts), layouts)
    loop.config = loop.config.model_copy(update={"restart_options": False})
    ways = shortest_ways(loop.engine)
    if artefact.kind == "meta":
        of_both = play_both(loop, artefact.seed, EPISODES)
        for fields, play in zip(({}, {"method": UNIFORM}), of_both, strict=True):
            numbers = play.scores(ways[:, -1:])
            yield fields, {name: values.mean(axis=1) for name, values in numbers.items()}
    loop.config = loop.config.model_copy(update={"mask_reached": False})
    for option, (sub_goal, member) in enumerate(options_of(config)):
        if sub_goal in in_domain:  # if the user's own labels define the sub-goal, its truth is not known
            goal = in_domain.index(sub_goal)
            fields = {
                "sub_goal": sub_goal,
                "member": member,
            }
            yield fields, alone(loop, option, goal, ways[:, goal])


def rows(work):
    """Yield the numbers of every agent, of random choice among its options, and of each option, on each layout."""
    for artefact in work.contents.agents:
        for first in range(0, len(work.layouts), AT_ONCE):
            layouts = work.layouts[first : first + AT_ONCE]
            work.progress.advance(len(layouts))
            if artefact.kind == "baseline":
                continue
            for fields, numbers in played(artefact, layouts):
                place = {
                    **work.place(artefact),
                    **fields,
                    "layout": layouts,
                    "scope": SCOPE,
                }
                yield pd.DataFrame(
                    {
                        **place,
                        **numbers,
                    }
                ).melt([*place], var_name="quantity")


def context(results):
    """Return tables of agents, of random choice among their options, of each option alone, and of the mean member."""
    numbers = results.of(scope=SCOPE)
    values = [per_run(numbers, *QUANTITIES, scope=SCOPE)]
    for member, of_member in numbers.groupby("member"):
        values.append(per_run(of_member, *QUANTITIES, scope=SCOPE).assign(member=member))
    return tables_of(with_choosers(pd.concat(values)), BY)
