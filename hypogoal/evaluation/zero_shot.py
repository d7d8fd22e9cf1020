"""Trained agents, and each of their options alone, on layouts that they are given: nothing is learned there (Spec H6).

What limits an agent, its options tell: they stop at a false positive of their member, or get nowhere in time.
"""

from __future__ import annotations

from collections.abc import Iterator
from itertools import product
from typing import TYPE_CHECKING, Any

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from hypogoal.core.artefacts import Artefact
from hypogoal.core.seeding import rng_for
from hypogoal.domains.base import Engine, load_domain
from hypogoal.evaluation.curves import NEAR, scores
from hypogoal.evaluation.house import over, per_run
from hypogoal.evaluation.judging import Work
from hypogoal.evaluation.names import UNIFORM
from hypogoal.evaluation.page import Results, bounded, displayed
from hypogoal.meta.config import layout_seeds

if TYPE_CHECKING:
    from hypogoal.options.loop import OptionLoop

EPISODES = 3  # of an agent on each layout
AT_ONCE = 100  # layouts
PATIENCE = 10  # timeouts after which an option alone is given up
OF_AGENTS, OF_OPTIONS = ("success", "near", "within_2", "length"), ("success", "near", "within_2", "false_positives")
TITLE = "On other layouts, without learning"
SCOPE = "zero-shot"
Played = dict[str, NDArray[np.float64]]  # a number of each layout (L,)


def shortest_ways(engine: Engine) -> NDArray[np.float64]:
    """Steps from each environment's state to each true sub-goal and, last, to success: (E, G + 1); NaN if not known."""
    from hypogoal.options.planned import FAR, distances, places_of  # with PyTorch, which a report needs not

    plan, labels = engine.plan(), engine.labels(engine.ids)
    if plan is None:
        return np.full((engine.count, labels.shape[1] + 1), np.nan)
    place = places_of(plan, engine)
    holds = np.column_stack([engine.labels(plan.ids), plan.solved])
    steps = distances(holds, place[plan.following], plan.final)[place[engine.ids]]
    return np.where(steps < FAR, steps, np.nan)


def alone(loop: OptionLoop, option: int, goal: int, shortest: NDArray[np.float64]) -> Played:
    """``OF_OPTIONS`` of an option, begun where episodes begin and anew at each timeout until its member is positive.

    It succeeds where its true sub-goal, number ``goal`` of the engine's labels, holds then; NaN where that holds from
    the beginning.
    """
    from hypogoal.evaluation.frozen import Always, begin_anew

    begin_anew(loop, Always(option))
    engine, steps = loop.engine, np.zeros(loop.engine.count, dtype=np.int64)
    holds, (positive, reached) = engine.labels(engine.ids)[:, goal], np.zeros((2, engine.count), dtype=np.bool_)
    going = ~positive
    for _ in range(PATIENCE * loop.config.option_timeout):
        moved = loop.advance(learning=False)
        steps[going] += 1
        ends = going & moved.reached
        positive[ends], reached[ends] = True, engine.labels(moved.next_ids[ends])[:, goal]
        going &= ~moved.reached & (engine.elapsed > 0)  # nor did the episode end
        if not going.any():
            break
    scored = scores(reached, steps, shortest) | {"false_positives": (positive & ~reached) * 1.0}
    return {name: np.where(holds, np.nan, values) for name, values in scored.items()}


def played(artefact: Artefact, layouts: tuple[int, ...]) -> list[tuple[dict[str, Any], Played]]:
    """What an agent does, random choice among its options, and each option alone; each with the fields of its rows."""
    from hypogoal.evaluation.frozen import play
    from hypogoal.meta.episodes import agent_of
    from hypogoal.options.choosers import RandomChooser

    config, sub_goals = artefact.config, load_domain(artefact.config["domain"]).sub_goals
    loop = agent_of(artefact, artefact.seed, len(layouts), layouts)
    loop.config = loop.config.model_copy(update={"restart_options": False})
    ways = shortest_ways(loop.engine)
    players: list[tuple[dict[str, Any], Played]] = []
    if artefact.kind == "meta":
        random = RandomChooser(rng_for(artefact.seed, "uniform-choice"))
        for fields, chooser in (({}, loop.chooser), ({"method": UNIFORM}, random)):
            episodes = play(loop, chooser, EPISODES)
            scores = episodes.scores(ways[:, -1:]) | {"length": episodes.length}
            players.append((fields, {quantity: values.mean(1) for quantity, values in scores.items()}))
    loop.config = loop.config.model_copy(update={"mask_reached": False})
    for option, (sub_goal, member) in enumerate(product(config["sub_goals"], range(config["members"]))):
        if sub_goal in sub_goals:  # else the user's own labels said it: its truth here is not known
            goal = sub_goals.index(sub_goal)
            players.append(({"sub_goal": sub_goal, "member": member}, alone(loop, option, goal, ways[:, goal])))
    return players


def rows(work: Work) -> Iterator[pd.DataFrame]:
    """Every agent, uniform-random choice among its options, and each option on every layout; none without layouts."""
    for artefact in work.contents.agents if work.layouts else ():
        if "options.safetensors" not in artefact.manifest.files:
            work.progress.advance(len(work.layouts))
            continue
        place = {**work.place(artefact), "scope": SCOPE}
        for first in range(0, len(work.layouts), AT_ONCE):
            layouts = work.layouts[first : first + AT_ONCE]
            for fields, numbers in played(artefact, layouts):
                wide = pd.DataFrame(numbers).assign(layout=layouts)
                fields = {name: value for name, value in {**place, **fields}.items() if name != "layout"}
                yield wide.melt("layout", var_name="quantity").assign(**fields)
            work.progress.advance(len(layouts))


def facts(work: Work) -> dict[str, Any]:
    """The layouts, and on how many of them each agent was trained, too."""
    trained: dict[str, int] = {}
    for artefact in work.contents.agents if work.layouts else ():
        seeds = layout_seeds(artefact.config.get("layouts") or "", artefact.config["layout_seed"])
        name = work.place(artefact)["method"]
        trained[name] = max(trained.get(name, 0), len({*seeds}.intersection(work.layouts)))
    return {"other_layouts": [*work.layouts], "trained_on": trained}


def tables(results: Results) -> dict[str, pd.DataFrame]:
    """Over layouts: agents, uniform-random choice among their options, and each option alone and the mean member."""
    numbers = results.of(scope=SCOPE)
    methods = numbers[numbers["method"] != UNIFORM].drop_duplicates("artefact").set_index("artefact")["method"]
    agents = pd.concat([per_run(numbers[numbers["sub_goal"] == ""], name, SCOPE) for name in OF_AGENTS])
    chooser = agents["method"].where(agents["method"] == UNIFORM, "the agent's")
    agents = agents.assign(chooser=chooser, method=agents["artefact"].map(methods))
    of_options = numbers[numbers["sub_goal"] != ""]
    parts = [per_run(of_options, name, SCOPE).assign(member="mean") for name in OF_OPTIONS]
    for member, of_member in of_options.groupby("member"):
        parts += [per_run(of_member, name, SCOPE).assign(member=str(member)) for name in OF_OPTIONS]
    options = pd.concat(parts)
    return {
        "other-layouts": over(agents, ["method", "chooser"]),
        "other-layouts-options": over(options, ["method", "sub_goal", "member"]),
    }


def context(results: Results) -> dict[str, Any] | None:
    """For the template: a table of agents and one of options; nothing where no layouts were given."""
    if results.of(scope=SCOPE).empty:
        return None
    computed = tables(results)
    columns = {
        "success, %": ("success", bounded(0, 100)),
        f"within {NEAR} shortest, %": ("near", bounded(0, 100)),
        "within 2, %": ("within_2", bounded(0, 100)),
    }
    by = {"method": "agent", "chooser": "choice"}
    table = displayed(computed["other-layouts"], by, columns | {"steps": ("length", bounded(0))})
    by = {"method": "options of", "sub_goal": "sub-goal", "member": "member"}
    more = columns | {"false positives, %": ("false_positives", bounded(0, 100))}
    return {
        "table": table,
        "options": displayed(computed["other-layouts-options"], by, more),
        "printed": table[["success, %", "within 2, %"]],
        "layouts": results.facts["other_layouts"],
        "trained_on": results.facts["trained_on"],
        "episodes": EPISODES,
        "patience": PATIENCE,
    }
