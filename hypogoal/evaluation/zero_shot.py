"""Trained agents, and each of their options alone, on layouts that they are given: nothing is learned there (Spec H6).

What limits an agent, its options tell: they stop at a false positive of their member, or get nowhere in time.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from itertools import product
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray
from rich.table import Table as Printed

from hypogoal.core.artefacts import Artefact
from hypogoal.core.seeding import rng_for
from hypogoal.domains.base import Engine, load_domain
from hypogoal.evaluation import page
from hypogoal.evaluation.choosing import UNIFORM, UNIFORM_CHOICE
from hypogoal.evaluation.curves import NEAR, scores
from hypogoal.evaluation.judging import Work
from hypogoal.evaluation.numbers import Metrics
from hypogoal.evaluation.page import Block, Material, Question
from hypogoal.evaluation.table import Number, Row, Table, by_fields, rows_of, select, tabulate
from hypogoal.meta.config import layout_seeds

if TYPE_CHECKING:
    from hypogoal.options.loop import OptionLoop

EPISODES = 3  # of an agent on each layout
AT_ONCE = 100  # layouts
PATIENCE = 10  # timeouts after which an option alone is given up
OF_AGENTS, OF_OPTIONS = ("success", "near", "within_2", "length"), ("success", "near", "within_2", "false_positives")
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


def rows(work: Work) -> Iterator[Row]:
    """Every agent, uniform-random choice among its options, and each option on every layout; none without layouts."""
    for artefact in work.contents.agents if work.layouts else ():
        if "options.safetensors" not in artefact.manifest.files:
            work.progress.advance(len(work.layouts))
            continue
        path = work.contents.name(artefact)
        place = {"method": work.agent_of[path], "scope": SCOPE, "seed": artefact.seed, "artefact": path}
        parts = []
        for first in range(0, len(work.layouts), AT_ONCE):
            layouts = work.layouts[first : first + AT_ONCE]
            parts.append(played(artefact, layouts))
            work.progress.advance(len(layouts))
        for players in zip(*parts, strict=True):  # the same one on all layouts
            where = place | players[0][0]
            names = OF_OPTIONS if "member" in where else OF_AGENTS
            columns = [np.concatenate([scores[name] for _, scores in players]).tolist() for name in names]
            for layout, *numbers in zip(work.layouts, *columns, strict=True):
                yield from rows_of(dict(zip(names, numbers, strict=True)), **where, layout=layout)


def _columns(names: Sequence[str]) -> dict[str, Number]:
    return {name: Number(name, SCOPE, "steps" if name == "length" else "fraction") for name in names}


def view(work: Work) -> dict[str, Any]:
    """Over layouts: ``agents``, each with uniform-random choice among its options below it, and ``options`` alone."""
    if not work.layouts:
        return {}

    def agent(row: Row) -> str:
        return work.agent_of[row.artefact]

    rows = select(work.rows, scope=SCOPE)
    by_chooser = Table(
        {"agent": agent, "name": "method"},
        _columns(OF_AGENTS),
        cell=lambda key: (SCOPE, key[0], UNIFORM if key[1] == UNIFORM else "agent"),
    )
    by_member = Table(
        {"agent": agent, "sub_goal": "sub_goal", "member": "member"},
        _columns(OF_OPTIONS),
        cell=lambda key: (SCOPE, *map(str, key)),
    )
    agents = tabulate((row for row in rows if not row.sub_goal), by_chooser)
    for entry in agents:
        configs = [run.config for run in work.agents[entry["agent"]]]
        trained = [layout_seeds(config.get("layouts", ""), config["layout_seed"]) for config in configs]
        entry["trained_on"] = max(len({*seeds}.intersection(work.layouts)) for seeds in trained)
    of_options: list[Row] = []  # the mean member of each sub-goal, then each member
    for members in by_fields((row for row in rows if row.sub_goal), agent, "sub_goal").values():
        of_options += [*(row._replace(member=MEAN) for row in members), *members]
    return {"zero_shot": {"layouts": list(work.layouts), "agents": agents, "options": tabulate(of_options, by_member)}}


SCORES = (
    page.number("success, %", "success", page.interval, 0, 100),
    page.number(f"within {NEAR} shortest, %", "near", page.interval, 0, 100),
    page.number("within 2, %", "within_2", page.interval, 0, 100),
)
AGENTS = (
    page.label("agent", lambda entry: UNIFORM_CHOICE if entry["name"] == UNIFORM else entry["name"]),
    *SCORES,
    page.number("steps", "length", page.interval, 0),
    page.number("trained on", "trained_on"),
    page.number("runs", "runs"),
)
OPTIONS = (
    page.label("options of", "agent", once=True),
    page.label("sub-goal", "sub_goal", once=lambda entry: (entry["agent"], entry["sub_goal"])),
    page.number("member", "member"),
    *SCORES,
    page.number("false positives, %", "false_positives", page.interval, 0, 100),
)


def summary(metrics: Metrics) -> list[Printed]:
    """For a terminal: agents, and the mean member of each sub-goal."""
    if not (zero_shot := metrics.get("zero_shot")):
        return []
    means = [
        entry | {"name": f"{entry['sub_goal']}, mean member"}
        for entry in zero_shot["options"]
        if entry["member"] == MEAN
    ]
    return [page.terminal(TITLE, (AGENTS[0], SCORES[0], SCORES[2]), [*zero_shot["agents"], *means])]


def sections(material: Material) -> list[Block]:
    """A table of agents and one of options; none where no layouts were given."""
    if not (zero_shot := material.metrics.get("zero_shot")):
        return []
    layouts = zero_shot["layouts"]
    text = (
        f"Trained agents play {len(layouts)} layouts ({layouts[0]} to {layouts[-1]}), {EPISODES} episodes each, "
        "without learning: options are greedy, choices drawn as in training. Uniform-random choice among the same "
        "options plays them, too. Each option also plays alone, from where episodes begin and anew at each timeout, "
        f"until its member is positive or for {PATIENCE} timeouts. It succeeds if its true sub-goal holds then; "
        "if not, its member's prediction was a false positive. The rest of 100 % never had a positive prediction."
    )
    caption = f"Over layouts. Trained on: how many of these layouts its training drew from, too. {page.INTERVALS}"
    tables = [page.table(AGENTS, zero_shot["agents"], caption=caption.format(units="layouts"))]
    tables.append(page.table(OPTIONS, zero_shot["options"], tight=True, heading="Each option alone"))
    return [page.section("zero-shot", TITLE, [text], [block for block in tables if block["rows"]])]


QUESTION = Question(
    rows=rows,
    view=view,
    summary=summary,
    sections=sections,
    meanings={
        "within_2": (
            "fraction",
            "share (scope zero-shot) that succeeded within twice the shortest path: of an agent's episodes on a layout "
            "that it was given, or an option's that began there, to its true sub-goal; near: within 1.5 of it",
        ),
        "false_positives": ("fraction", "share of an option's executions alone that end at a false positive"),
    },
)
