"""Trained agents, and each of their options alone, on layouts that they are given: nothing is learned there (Spec H6).

What limits an agent, its options tell: they stop where their members are wrong (a wrong yes), or get nowhere in time.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import replace
from operator import itemgetter
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray
from rich.table import Table

from hypogoal.core.artefacts import Artefact
from hypogoal.core.seeding import rng_for
from hypogoal.domains.base import Engine, load_domain
from hypogoal.evaluation import page
from hypogoal.evaluation.choosing import UNIFORM
from hypogoal.evaluation.curves import NEAR
from hypogoal.evaluation.numbers import Metrics, Row, grouped, over, rows_of
from hypogoal.evaluation.page import Block, Material, Question
from hypogoal.meta.config import layout_seeds

if TYPE_CHECKING:
    from hypogoal.evaluation.judging import Work
    from hypogoal.options.loop import OptionLoop

EPISODES = 3  # of an agent on each layout
AT_ONCE = 100  # layouts
PATIENCE = 10  # timeouts after which an option alone is given up
OF_AGENTS, OF_OPTIONS = ("success", "near", "within_2", "length"), ("success", "near", "within_2", "wrong_yes")
MEAN = "mean"  # in place of a member's number
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
    """``OF_OPTIONS`` of an option, begun where episodes begin and again when its time is up, till its member says yes.

    It succeeds where its true sub-goal, number ``goal`` of the engine's labels, holds then; NaN where that holds from
    the beginning.
    """
    from hypogoal.evaluation.frozen import begin_anew, scores
    from hypogoal.options.choosers import Chooser

    class Always(Chooser):
        def choose(self, environments: Any, ids: NDArray[np.int64], offered: Any) -> NDArray[np.int64]:
            return np.full(len(ids), option)

    begin_anew(loop, Always())
    engine, steps = loop.engine, np.zeros(loop.engine.count, dtype=np.int64)
    holds, (yes, there) = engine.labels(engine.ids)[:, goal], np.zeros((2, engine.count), dtype=np.bool_)
    going = ~yes
    for _ in range(PATIENCE * loop.config.option_timeout):
        moved = loop.advance(learning=False)
        steps[going] += 1
        ends = going & moved.reached
        yes[ends], there[ends] = True, engine.labels(moved.next_ids[ends])[:, goal]
        going &= ~moved.reached & (engine.elapsed > 0)  # nor did the episode end
        if not going.any():
            break
    scored = scores(there, steps, shortest) | {"wrong_yes": (yes & ~there) * 1.0}
    return {name: np.where(holds, np.nan, of) for name, of in scored.items()}


def played(artefact: Artefact, layouts: tuple[int, ...]) -> dict[tuple[str, ...], Played]:
    """What an agent does, ``("agent",)``, chance among its options, and each option, (sub-goal, member)."""
    from hypogoal.evaluation.frozen import play
    from hypogoal.meta.episodes import agent_of
    from hypogoal.options.choosers import RandomChooser

    config, known = artefact.config, load_domain(artefact.config["domain"]).sub_goals
    loop = agent_of(artefact, artefact.seed, len(layouts), layouts)
    loop.config = replace(loop.config, restart_options=False)
    ways = shortest_ways(loop.engine)
    found: dict[tuple[str, ...], Played] = {}
    if artefact.kind == "meta":
        choosers = {"agent": loop.chooser, UNIFORM: RandomChooser(rng_for(artefact.seed, "uniform-choice"))}
        for name, chooser in choosers.items():
            episodes = play(loop, chooser, EPISODES)
            scores = episodes.scores(ways[:, -1:]) | {"length": episodes.length}
            found[name,] = {quantity: values.mean(1) for quantity, values in scores.items()}
    loop.config, loop.initiation = replace(loop.config, mask_reached=False), None
    for index, sub_goal in enumerate(config["sub_goals"]):
        if sub_goal in known:  # else the user's own labels said it: its truth here is not known
            goal, first = known.index(sub_goal), index * config["members"]
            members = [alone(loop, first + of, goal, ways[:, goal]) for of in range(config["members"])]
            found[sub_goal, MEAN] = {name: np.mean([of[name] for of in members], axis=0) for name in OF_OPTIONS}
            found |= {(sub_goal, str(of)): scores for of, scores in enumerate(members)}
    return found


def numbers(work: Work) -> dict[str, Any]:
    """Of every agent and option; nothing where no layouts were given."""
    if not work.layouts:
        return {}
    names = {run["path"]: agent["name"] for agent in work.metrics["agents"] for run in agent["runs"]}
    found: list[tuple[tuple[str, ...], dict[str, Any]]] = []
    for artefact in work.contents.agents:
        if "options.safetensors" not in artefact.manifest["files"]:
            work.progress.advance(len(work.layouts))
            continue
        path, config = work.contents.name(artefact), artefact.config
        parts = []
        for first in range(0, len(work.layouts), AT_ONCE):
            layouts = work.layouts[first : first + AT_ONCE]
            parts.append(played(artefact, layouts))
            work.progress.advance(len(layouts))
        own = {*layout_seeds(config.get("layouts", ""), config["layout_seed"])}
        about = {"path": path, "seed": artefact.seed, "trained_on": len(own.intersection(work.layouts))}
        for key in parts[0]:
            joined = {name: np.concatenate([part[key][name] for part in parts]).tolist() for name in parts[0][key]}
            found.append(((names[path], *key), about | joined))
    told: dict[str, Any] = {"layouts": list(work.layouts), "agents": [], "options": []}
    for (agent, *key), alike in grouped(found, itemgetter(0)).items():
        runs = [run for _, run in alike]
        entry: dict[str, Any] = {"agent": agent, "name": key[0] if key[0] == UNIFORM else agent, "runs": runs}
        if options := len(key) > 1:
            entry |= {"sub_goal": key[0], "member": key[1]}
        for name in OF_OPTIONS if options else OF_AGENTS:
            values, unit = [value for run in runs for value in run[name]], "steps" if name == "length" else "fraction"
            entry[name] = over(values, unit, SCOPE, agent, *key, name, layouts=work.layouts * len(runs))
        told["options" if options else "agents"].append(entry)
    return {"zero_shot": told}


def rows(metrics: Metrics, arrays: Mapping[str, Any]) -> Iterator[Row]:
    """Every agent and option on every layout."""
    told = metrics.get("zero_shot", {"layouts": [], "agents": [], "options": []})
    for names, entry in [(OF_AGENTS, of) for of in told["agents"]] + [(OF_OPTIONS, of) for of in told["options"]]:
        place = {"scope": SCOPE} | {key: entry[key] for key in ("sub_goal", "member") if key in entry}
        for run in entry["runs"] if place.get("member") != MEAN else ():
            place |= {"method": entry["name"], "seed": run["seed"], "artefact": run["path"]}
            for index, layout in enumerate(told["layouts"]):
                yield from rows_of({name: run[name][index] for name in names}, **place, layout=layout)


SCORES = (
    page.number("success, %", "success", page.interval, 0, 100),
    page.number(f"within {NEAR} shortest, %", "near", page.interval, 0, 100),
    page.number("within 2, %", "within_2", page.interval, 0, 100),
)
AGENTS = (
    page.label("agent", "name"),
    *SCORES,
    page.number("steps", "length", page.interval, 0),
    page.number("trained on", lambda entry: max(run["trained_on"] for run in entry["runs"])),
    page.number("runs", lambda entry: len(entry["runs"])),
)
OPTIONS = (
    page.label("options of", "agent", once=True),
    page.label("sub-goal", "sub_goal", once=lambda entry: (entry["agent"], entry["sub_goal"])),
    page.number("member", "member"),
    *SCORES,
    page.number("wrong yes, %", "wrong_yes", page.interval, 0, 100),
)


def summary(metrics: Metrics) -> list[Table]:
    """For a terminal: agents, and the mean member of each sub-goal."""
    if not (told := metrics.get("zero_shot")):
        return []
    means = [of | {"name": f"{of['sub_goal']}, mean member"} for of in told["options"] if of["member"] == MEAN]
    return [page.terminal(TITLE, (AGENTS[0], SCORES[0], SCORES[2]), [*told["agents"], *means])]


def sections(material: Material) -> list[Block]:
    """A table of agents and one of options; none where no layouts were given."""
    if not (told := material.metrics.get("zero_shot")):
        return []
    layouts = told["layouts"]
    text = (
        f"Trained agents play {len(layouts)} layouts ({layouts[0]} to {layouts[-1]}), {EPISODES} episodes each, and "
        "nothing is learned: options are greedy, choices drawn as in training; so does chance among the same options. "
        "Each option also plays alone, from where episodes begin and again when its time is up, until its own member "
        f"says yes or {PATIENCE} times its timeout is over. It succeeds where its true sub-goal holds then; elsewhere "
        "it was a wrong yes, and what is left of 100 % never got a yes."
    )
    caption = f"Over layouts. Trained on: how many of these layouts its training drew from, too. {page.INTERVALS}"
    tables = [page.table(AGENTS, told["agents"], caption=caption.format(units="layouts"))]
    tables.append(page.table(OPTIONS, told["options"], tight=True, heading="Each option alone"))
    return [page.section("zero-shot", TITLE, [text], [of for of in tables if of["rows"]])]


QUESTION = Question(
    numbers=numbers,
    rows=rows,
    summary=summary,
    sections=sections,
    meanings={
        "within_2": (
            "fraction",
            "share (scope zero-shot) that succeeded within twice the shortest path: of an agent's episodes on a layout "
            "that it was given, or an option's that began there, to its true sub-goal; near: within 1.5 of it",
        ),
        "wrong_yes": ("fraction", "share of an option's executions alone whose member says yes elsewhere"),
    },
)
