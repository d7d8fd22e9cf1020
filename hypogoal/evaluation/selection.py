"""Figures 7 and 8: which members the meta-policy prefers, and where their options stop (Spec F6)."""

import math
from collections.abc import Iterator
from functools import cache
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pandas as pd
from matplotlib.figure import Figure
from numpy.typing import NDArray

from hypogoal.core.artefacts import Artefact
from hypogoal.core.seeding import rng_for
from hypogoal.domains.base import BUILT_IN, Engine, Layouts, load_domain
from hypogoal.evaluation.curves import is_learned
from hypogoal.evaluation.house import tidy_members
from hypogoal.evaluation.judging import Work
from hypogoal.evaluation.page import Drawn, Results, fixed, listed, percent
from hypogoal.evaluation.pictures import STATES, overlay
from hypogoal.evaluation.plots import GREY, pictures, show_picture, styled
from hypogoal.evaluation.run import takes, thresholds_of
from hypogoal.hypotheses.scores import member_scores, most_and_least, ratio
from hypogoal.meta.config import layout_seeds
from hypogoal.observations import PICTURE
from hypogoal.options.tables import Choices

TITLE = "Which hypotheses are chosen, and where they stop"
LOOKED_AT = 10  # layouts of an agent that has many, the first ones: on their states members are matched with the truth
NUMBERED = {"open-red-door": "figure7", "go-to-goal": "figure8"}  # the sub-goals that the paper shows
SCOPE = "layout"  # of choices, and of the match with the truth, on a run's layout
COUNTS = ("offered", "chosen", "reached")
NUMBERS = (*COUNTS, "expected", "duration", "preference", "match", "threshold")
NEEDED = {
    "figure7": "a meta artefact with the sub-goal open-red-door: train-meta",
    "figure8": "a meta artefact with the sub-goal go-to-goal: train-meta",
}


def rows(work: Work) -> Iterator[pd.DataFrame]:
    """Spec F6: the choices of every run of each agent whose options are members, and how well these match the truth."""
    judged = cache(on_layout)
    for artefact in work.contents.agents:
        work.progress.advance()
        if not takes(artefact):
            continue
        config, path = artefact.config, work.contents.name(artefact)
        seeds = layout_seeds(config.get("layouts") or "", config["layout_seed"])[:LOOKED_AT]
        members = judged(artefact.input("ensemble"), tuple(seeds))
        for option, overlaid in members.sets.items():
            work.arrays[f"terminations/{path}/{option}"] = overlaid
        work.arrays[f"{STATES}/{path}/counts"] = members.counts
        choices = Choices.read(artefact.path / "choices.csv")
        columns = numbers_of_choices(choices, len(members.match))
        columns |= {"match": members.match, "threshold": thresholds_of(artefact)}
        for index, sub_goal in enumerate(config["sub_goals"]):
            part = slice(index * config["members"], (index + 1) * config["members"])
            of_goal = {name: values[part] for name, values in columns.items()}
            yield tidy_members(of_goal, **work.place(artefact), sub_goal=sub_goal, scope=SCOPE)


def numbers_of_choices(choices: Choices, options: int) -> dict[str, NDArray[np.float64]]:
    """Spec F6: how often each option was offered, chosen, reached; its mean duration in steps; ``preference``, (O,).

    A raw share is confounded: a member that always fires is masked nearly always, one that never fires is offered
    always. Preference is chosen / expected, 1 for a chooser that does not care, NaN for an option never offered;
    ``expected``: the sum of 1 / (options offered) over the decisions that offered it.
    """
    columns = {name: choices.total(name, options) for name in (*COUNTS, "expected")}
    columns["duration"] = ratio(choices.total("duration", options), columns["chosen"])
    columns["preference"] = ratio(columns["chosen"], columns["expected"])
    return columns


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
    lines = []
    for artefact in work.contents.agents:
        if not takes(artefact):
            continue
        name = artefact.config["domain"]
        domain = load_domain(name)
        do = "import them under one of these names, if it is one of them"
        for sub_goal in artefact.config["sub_goals"]:
            if sub_goal not in domain.sub_goals:
                do = do if name in BUILT_IN else f"add {sub_goal} to the domain's sub_goals"
                has = f"{name} has {listed(domain.sub_goals)}"
                lines.append(f"no truth of {sub_goal} to match members with: {has}; {do}, then evaluate again")
    return list(dict.fromkeys(lines))


def tables(results: Results) -> dict[str, pd.DataFrame]:
    """Of each run and sub-goal its members, a column for each number."""
    numbers = results.of(scope=SCOPE)
    place = ["method", "layout", "seed", "artefact", "sub_goal", "member"]
    wide = numbers.pivot_table(index=place, columns="quantity", values="value", sort=False, dropna=False)
    wide = wide.dropna(how="all").reset_index()
    return {"choices": wide.reindex(columns=[*place, *NUMBERS])}


def context(results: Results) -> dict[str, Any] | None:
    """For the template: of the first run how often each member was chosen, over what a uniform choice would have."""
    if results.of(scope=SCOPE).empty:
        return None
    table = tables(results)["choices"]
    learned = [name for name, agent in results.facts["agents"].items() if is_learned(agent)]
    first = _first_run(results, table)
    practised = _practised(table)
    if first is None:
        return {"printed": practised, "table": practised, "run": None}
    shown = pd.DataFrame(
        {
            "sub-goal": first["sub_goal"],
            "member": first["member"].astype(str) + first["marks"],
            "offered": first["offered"].map("{:.0f}".format),
            "chosen": first["chosen"].map("{:.0f}".format),
            "expected": [fixed(value, 0) for value in first["expected"]],
            "preference": [fixed(value) for value in first["preference"]],
            "steps": [fixed(value, 1) for value in first["duration"]],
            "match": [fixed(value) for value in first["match"]],
        }
    )
    run = {name: first[name].iloc[0] for name in ("artefact", "layout", "seed", "method")}
    return {"table": shown.set_index(["sub-goal", "member"]), "run": run, "agents": len(learned)}


def _practised(table: pd.DataFrame) -> pd.DataFrame:
    """How often the options of each sub-goal were executed, how often they reached it, and their mean duration."""
    rows = []
    for sub_goal, members in table.groupby("sub_goal", sort=False):
        count = members["chosen"].sum()
        steps = (members["chosen"] * members["duration"].fillna(0)).sum()
        share = members["reached"].sum() / count if count else math.nan
        mean_steps = fixed(steps / count if count else math.nan, 1)
        cells = {"executions": f"{count:.0f}", "reached": percent(share), "steps": mean_steps}
        rows.append({"options of": sub_goal, **cells})
    return pd.DataFrame(rows).set_index("options of")


def _first_run(results: Results, table: pd.DataFrame) -> pd.DataFrame | None:
    """The members of the first run that learned to choose; ``marks``: whether one is preferred most or least."""
    learned = [name for name, agent in results.facts["agents"].items() if is_learned(agent)]
    of_learned = table[table["method"].isin(learned)]
    if of_learned.empty:
        return None
    first = of_learned[of_learned["artefact"] == of_learned["artefact"].iloc[0]]
    marks = pd.Series("", first.index)
    for _, members in first.groupby("sub_goal", sort=False):
        for word, member in zip(("most", "least"), most_and_least(members["preference"].to_numpy()), strict=True):
            if member is not None:
                marks[members.index[member]] = f" ({word})"
    return first.assign(marks=marks, option=np.arange(len(first)))


def figures(results: Results) -> Iterator[Drawn]:
    """Figures 7 and 8 and the other sub-goals', of the first agent's first run; none of numbers."""
    first = None if results.of(scope=SCOPE).empty else _first_run(results, tables(results)["choices"])
    if first is None:
        return
    path = first["artefact"].iloc[0]
    if not any(name.startswith(f"terminations/{path}/") for name in results.arrays):
        return
    counts = results.arrays[f"{STATES}/{path}/counts"]
    for sub_goal, members in first.groupby("sub_goal", sort=False):
        sides = []
        for word in ("most", "least"):
            for _, member in members[members["marks"] == f" ({word})"].iterrows():
                numbers = f"preference {fixed(member['preference'])}, match {fixed(member['match'])}"
                title = f"{word} preferred: member {member['member']}\n{numbers}\n{counts[member['option']]:,} states"
                sides.append((title, results.arrays.get(f"terminations/{path}/{member['option']}")))
        if not sides:
            continue
        name = NUMBERED.get(str(sub_goal), f"terminations-{sub_goal}")
        details = {"sub_goal": sub_goal, "path": path, "layout": first["layout"].iloc[0], "seed": first["seed"].iloc[0]}
        label = f"Termination states of {sub_goal}"
        yield Drawn(name, label, termination_states(sides), details)


def termination_states(sides: list[tuple[str, NDArray[np.uint8] | None]]) -> Figure:
    """Figures 7 and 8: overlaid termination states of some members, the most preferred first.

    A side is a title and an overlay uint8 (H, W, C), None where the member is positive nowhere.
    """
    with styled():
        figure, places = pictures(1, max(2, len(sides)), titles=0.6)
        for place, (title, image) in zip(places, sides, strict=False):
            if image is None:
                place.set_title(title, fontsize=9, loc="center")
                place.text(0.5, 0.5, "positive\nnowhere", ha="center", va="center", color=GREY)
            else:
                show_picture(place, image, title)
    return figure
