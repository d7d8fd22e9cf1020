"""Figures 7 and 8: which members the meta-policy prefers, and where their options stop (Spec F6)."""

import math
from collections.abc import Iterator, Mapping, Sequence
from functools import cache
from operator import itemgetter
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray
from rich.table import Table

from hypogoal.core.artefacts import Artefact
from hypogoal.core.seeding import rng_for
from hypogoal.domains.base import BUILT_IN, Engine, Layouts, load_domain
from hypogoal.evaluation import choosing, page
from hypogoal.evaluation.curves import variants, which
from hypogoal.evaluation.judging import Work
from hypogoal.evaluation.numbers import grouped
from hypogoal.evaluation.page import Block, Drawn, Entry, Material, Question
from hypogoal.evaluation.pictures import STATES, overlay
from hypogoal.evaluation.plots import GREY, PICTURE_TITLE, grid_of_pictures, show_picture
from hypogoal.evaluation.run import takes, thresholds_of, within
from hypogoal.evaluation.table import Row, by_fields, by_run, rows_by_member, select
from hypogoal.hypotheses.scores import member_scores, most_and_least, ratio
from hypogoal.meta.config import layout_seeds
from hypogoal.observations import PICTURE
from hypogoal.options.tables import Choices

LOOKED_AT = 10  # layouts of an agent that has many, the first ones: on their states members are matched with the truth
NUMBERED = {"open-red-door": "figure7", "go-to-goal": "figure8"}  # the sub-goals that the paper shows
MOST = ("most", "least")  # preferred
SCOPE = "layout"  # in numbers.csv: of choices, and of the match with the truth, on a run's layout


def preference(chosen: NDArray[Any], expected: NDArray[np.float64]) -> NDArray[np.float64]:
    """Spec F6: chosen / expected under uniform choice among the options offered, float (..., O); NaN if never offered.

    A raw share is confounded: a member that always fires is masked nearly always, one that never fires is offered
    always. This ratio is 1 for a chooser that does not care. ``expected``: the sum of 1 / (options offered) over the
    decisions that offered it.
    """
    return ratio(chosen, expected)


def rows_of_choices(
    choices: Choices, sub_goals: Sequence[str], members: int, more: Mapping[str, NDArray[Any]], **place: Any
) -> Iterator[Row]:
    """Spec F6: how often each of K members of G sub-goals was offered and chosen, and ``more`` of each, (G*K,).

    Of each member there are offered, chosen, reached, expected, mean duration in steps, and preference.
    """
    options = len(sub_goals) * members
    columns: dict[str, NDArray[Any]] = {
        name: choices.total(name, options).astype(np.int64) for name in ("offered", "chosen", "reached")
    }
    columns["expected"] = choices.total("expected", options)
    columns["duration"] = ratio(choices.total("duration", options), columns["chosen"])
    columns |= {**more, "preference": preference(columns["chosen"], columns["expected"])}
    for index, sub_goal in enumerate(sub_goals):
        part = slice(index * members, (index + 1) * members)
        of_goal = {name: values[part] for name, values in columns.items()}
        yield from rows_by_member(of_goal, **place, sub_goal=sub_goal, scope=SCOPE)


def rows(work: Work) -> Iterator[Row]:
    """Spec F6: the choices of every run of each agent whose options are members, and how well these match the truth."""
    judged = cache(on_layout)
    for name, run in ((name, run) for name, runs in work.agents.items() for run in runs):
        work.progress.advance()
        artefact = work.artefact(run.path)
        config = artefact.config
        if not takes(artefact):
            continue
        layout = run.layout["layout_seed"]
        seeds = layout_seeds(config.get("layouts", ""), layout)[:LOOKED_AT]
        choices, members = Choices.read(artefact.path / "choices.csv"), judged(artefact.input("ensemble"), tuple(seeds))
        for option, picture in members.sets.items():
            work.arrays[f"terminations/{run.path}/{option}"] = picture
        work.arrays[f"{STATES}/{run.path}/counts"] = members.counts
        more = {"match": members.match, "threshold": thresholds_of(artefact)}
        place = {"method": name, "layout": layout, "seed": run.seed, "artefact": run.path}
        yield from rows_of_choices(choices, config["sub_goals"], config["members"], more, **place)


def view(work: Work) -> dict[str, Any]:
    """Of each run its sub-goals' members, see :func:`selection_of`, and which ensemble they are of."""
    selection = selection_of(work.rows)
    for run in (run for agent in selection for run in agent["runs"]):
        source = Artefact(work.artefact(run["path"]).input("ensemble"))
        run["ensemble"] = within(work.contents, source)
    return {"selection": selection}


def selection_of(rows: Sequence[Row]) -> list[dict[str, Any]]:
    """By agent and run: of each sub-goal its members, each with its option, and the most and the least preferred."""
    selection: list[dict[str, Any]] = []
    for (name,), rows_of_agent in by_fields(select(rows, scope=SCOPE), "method").items():
        runs = by_run(rows_of_agent)
        for goals in (run["sub_goals"] for run in runs):
            for option, member in enumerate(member for goal in goals for member in goal["members"]):
                member["option"] = option
            for goal in goals:
                preferences = np.array([member["preference"] for member in goal["members"]])
                goal["most"], goal["least"] = most_and_least(preferences)
        selection.append({"name": name, "runs": runs})
    return selection


class OnLayout(NamedTuple):
    """The members of an ensemble, as options, on the states of layouts.

    ``match``, float (G*K,), is their balanced accuracy (Spec F6), NaN where the domain does not have the sub-goal but
    the user's own labels do: its truth is unknown there. ``counts``, int (G*K,), are of the states in which they are
    positive. ``sets``, of pictures only, has for options that are positive anywhere an :func:`overlay` of these.
    """

    match: NDArray[np.float64]
    counts: NDArray[np.int64]
    sets: dict[int, NDArray[np.uint8]]


def on_layout(path: Path, layouts: tuple[int, ...]) -> OnLayout:
    """Every member of an ensemble's artefact on the states of layouts: those that can be reached, else that are met."""
    from hypogoal.hypotheses.ensemble import read_ensemble  # with PyTorch, which a report needs not

    source = Artefact(path)
    domain, members = load_domain(source.config["domain"]), source.config["members"]
    arguments = domain.world(source.config["domain_config"])
    arguments |= {"layouts": Layouts(layouts)} if len(layouts) > 1 else {}
    engine = domain.make_engine(layouts[0], len(layouts), 500, **arguments)
    reachable = engine.reachable()
    ids = states_met(engine, 2_000, rng_for(0, "states-of-layout")) if reachable is None else reachable
    images, labels = engine.images(ids), dict(zip(domain.sub_goals, engine.labels(ids).T, strict=True))
    match, sets = np.full(len(source.config["sub_goals"]) * members, np.nan), {}
    counts = np.zeros(len(match), np.int64)
    for index, sub_goal in enumerate(source.config["sub_goals"]):
        ensemble = read_ensemble(source.path, source.config, sub_goal)
        verdicts = ensemble.predictions(images)
        options = range(index * members, (index + 1) * members)
        if sub_goal in labels:
            match[options] = member_scores(verdicts, labels[sub_goal])["balanced_accuracy"]
        counts[options] = verdicts.sum(axis=0)
        for option, positives in zip(options, verdicts.T, strict=True):
            if positives.any() and images.dtype == PICTURE:
                sets[option] = overlay(images[positives])
    return OnLayout(match, counts, sets)


def states_met(engine: Engine, steps: int, rng: np.random.Generator) -> NDArray[np.int64]:
    """The states that random play of an engine meets in so many steps, each once."""
    met = [engine.ids]
    for _ in range(steps // engine.count):
        met.append(engine.step(rng.integers(engine.n_actions, size=engine.count)).next_ids)
    return np.unique(np.concatenate(met))


def missing(work: Work) -> list[str]:
    """Sub-goals of which the domain does not know where they are reached, and where to say it."""
    domains = {work.contents.name(artefact): artefact.config.get("domain", "") for artefact in work.contents.agents}
    unknown = {
        (goal["sub_goal"], domains[run["path"]]): None
        for agent in work.metrics["selection"]
        for run in agent["runs"]
        for goal in run["sub_goals"]
        if all(math.isnan(member["match"]) for member in goal["members"])
    }
    lines = []
    for name, domain in unknown:
        loaded = load_domain(domain)
        do = "import them under one of these names, if it is one of them"
        do = do if domain in BUILT_IN else f"add {name} to {loaded.labels_stand_in}"
        goals = page.listed(loaded.sub_goals)
        lines.append(f"no truth of {name} to match members with: {domain} has {goals}; {do}, then evaluate again")
    return lines


PRACTISED = (
    page.label("options of", "sub_goal"),
    page.number("executions", "chosen"),
    page.number("reached", "reached", page.percent),
    page.number("steps", "duration", page.fixed, 1),
)


def summary(metrics: Entry) -> list[Table]:
    """What options do, for a terminal, where no policy over them tells it."""
    selection = metrics.get("selection", [])
    agents = [] if variants(selection) else selection
    goals = [goal for agent in agents for run in agent["runs"] for goal in run["sub_goals"]]
    rows = [
        practised(name, [member for goal in alike for member in goal["members"]])
        for name, alike in grouped(goals, itemgetter("sub_goal")).items()
    ]
    return [page.terminal("What options did while they learned", PRACTISED, rows)] if rows else []


def practised(name: str, members: Sequence[Entry]) -> Entry:
    """How often the options of a sub-goal were executed, the share that reached it, and their mean duration."""
    executed = [member for member in members if member["chosen"]]
    count = sum(member["chosen"] for member in executed)
    reached = sum(member["reached"] for member in executed) / count if count else None
    steps = sum(member["chosen"] * member["duration"] for member in executed) / count if count else None
    return {"sub_goal": name, "chosen": count, "reached": reached, "duration": steps}


MEMBERS = (
    page.label("sub-goal", "sub_goal", once=True),
    page.label("member", "name"),
    page.number("offered", "offered"),
    page.number("chosen", "chosen"),
    page.number("expected", "expected", page.fixed, 0),
    page.number("preference", "preference", page.fixed, 2),
    page.number("steps", "duration", page.fixed, 1),
    page.number("match", "match", page.fixed, 2),
)


def _agent(material: Material) -> Entry | None:
    """The variant of the option agent that is shown."""
    return next(iter(variants(material.metrics["selection"])), None)


def _side(material: Material, path: str, goal: Entry, word: str) -> tuple[str, str, NDArray[np.uint8] | None]:
    """Title, note and picture of the most or the least preferred member."""
    member = goal["members"][goal[word]]
    note = f"preference {page.fixed(member['preference'], 2)}, match {page.fixed(member['match'], 2)}"
    image, states = material.termination_states(path, member["option"])
    return f"{word} preferred: member {goal[word]}", f"{note}\n{states}".rstrip(), image


def sections(material: Material) -> list[Block]:
    """Of the first run how often each member was chosen, over what a uniform choice would have; Figures 7 and 8."""
    agent = _agent(material)
    if agent is None:
        return []
    run = agent["runs"][0]
    text = (
        "Preference is how often an option was chosen over how often a uniform choice among the options offered "
        "would have chosen it; uniform choice has 1. Match is the balanced accuracy of the member's classifier against "
        "the true sub-goal on the layout, not how good its option is. numbers.csv has these numbers for every run, and "
        f"for the random chooser if there is one. '{choosing.TITLE}' says what the choices gain."
    )
    stops = (
        "A picture shows a state of the layout in which a member is positive, where its option ends, and over it, half "
        "transparent, the agent and all else where other such states have it; above it, how many there are. For each "
        "sub-goal it shows the member that the agent prefers most and the one that it prefers least."
    )
    lines = []
    for goal in run["sub_goals"]:
        words = {goal[word]: f" ({word})" for word in reversed(MOST)}
        for index, member in enumerate(goal["members"]):
            lines.append({**member, "sub_goal": goal["sub_goal"], "name": f"{index}{words.get(index, '')}"})
    caption = (
        f"{run['path']}, layout seed {run['layout_seed']}, run seed {run['seed']}: decisions at which the option was "
        "offered and chosen; expected under uniform choice; preference; mean steps of an execution; match."
    )
    drawn = [page.shown(material, figure) for figure in figures(material)]  # none of numbers
    blocks = [page.table(MEMBERS, lines, caption=caption)]
    blocks += [{"kind": "row", "blocks": drawn, "caption": stops}] if drawn else []
    texts = [text, which(agent, material.metrics["selection"])]
    return [page.section("choices", "Which hypotheses are chosen, and where they stop", texts, blocks, folded=True)]


def figures(material: Material) -> Iterator[Drawn]:
    """Figures 7 and 8 and the other sub-goals', of the agent's first run."""
    agent, selection = _agent(material), material.metrics["selection"]
    run = agent["runs"][0] if agent and not material.of_numbers() else {"sub_goals": []}
    for goal in run["sub_goals"]:
        where = f"layout seed {run['layout_seed']}, run seed {run['seed']}"
        sides = [_side(material, run["path"], goal, word) for word in MOST if goal[word] is not None]
        if not sides:
            continue
        name = NUMBERED.get(goal["sub_goal"], f"terminations-{goal['sub_goal']}")
        title = name.replace("figure", "Figure ") if name in NUMBERED.values() else "As Figures 7 and 8"
        caption = (
            f"{title} of the paper: termination states of {goal['sub_goal']}, of the member that the agent prefers "
            f"most and of the one it prefers least ({run['path']}, {where}): one state of the layout in which the "
            "member is positive, the others half transparent over it. Preference: chosen / expected under uniform "
            f"choice; match: balanced accuracy on that layout. {which(agent, selection) if agent else ''}"
        ).rstrip()
        drawn = termination_states([(f"{title}\n{note}", image) for title, note, image in sides])
        yield Drawn(name, title, drawn, caption)


def termination_states(sides: Sequence[tuple[str, NDArray[np.uint8] | None]]) -> Figure:
    """Figures 7 and 8: overlaid termination states of some members, the most preferred first.

    A side is a title and an overlay uint8 (H, W, C), None where the member is positive nowhere.
    """
    figure, places = grid_of_pictures(1, max(2, len(sides)), PICTURE_TITLE)
    for place, (title, image) in zip(places, sides, strict=False):
        if image is None:
            place.set_title(title, fontsize=9)
            place.text(0.5, 0.5, "positive\nnowhere", ha="center", va="center", color=GREY)
        else:
            show_picture(place, image, title)
    return figure


QUESTION = Question(
    rows=rows,
    view=view,
    missing=missing,
    summary=summary,
    sections=sections,
    figures=figures,
    needed={
        "figure7": "a meta artefact with learned terminations that has open-red-door: train-meta",
        "figure8": "a meta artefact with learned terminations that has go-to-goal: train-meta",
    },
)
