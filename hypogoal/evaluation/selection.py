"""Figures 7 and 8: which members the meta-policy prefers, and where their options stop (Spec F6)."""

from collections.abc import Iterator, Mapping, Sequence
from functools import cache
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pandas as pd
from matplotlib.figure import Figure

from hypogoal.core.arrays import Bytes, Doubles, Ints
from hypogoal.core.artefacts import Artefact
from hypogoal.core.seeding import rng_for
from hypogoal.domains import base
from hypogoal.evaluation import page, plots
from hypogoal.evaluation.curves import chosen_by
from hypogoal.evaluation.house import of_options
from hypogoal.evaluation.judging import Work
from hypogoal.evaluation.pictures import STATES, overlay
from hypogoal.evaluation.run import takes, thresholds_of
from hypogoal.hypotheses import scores
from hypogoal.meta.config import layout_seeds
from hypogoal.observations import PICTURE
from hypogoal.options.tables import Choices

TITLE = "Which hypotheses are chosen, and where they stop"
LOOKED_AT = 10  # layouts of an agent that has many, the first ones: on their states members are matched with the truth
NUMBERED = {"open-red-door": "figure7", "go-to-goal": "figure8"}  # the sub-goals that the paper shows
SCOPE = "layout"  # of choices, and of the match with the truth, on a run's layout
COUNTS = ("offered", "chosen", "reached", "expected")
NUMBERS = (*COUNTS, "duration", "preference", "match", "threshold")  # of an option
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
        yield of_options(columns, config, **work.place(artefact), scope=SCOPE)


def numbers_of_choices(choices: Choices, options: int) -> dict[str, Doubles]:
    """Spec F6: how often each option was offered, chosen, reached; its mean duration in steps; ``preference``, (O,).

    A raw share is confounded: a member that always fires is masked nearly always, one that never fires is offered
    always. Preference is chosen / expected, 1 for a chooser that does not care, NaN for an option never offered;
    ``expected``: the sum of 1 / (options offered) over the decisions that offered it.
    """
    columns = {name: choices.total(name, options) for name in COUNTS}
    columns["duration"] = scores.ratio(choices.total("duration", options), columns["chosen"])
    columns["preference"] = scores.ratio(columns["chosen"], columns["expected"])
    return columns


class OnLayout(NamedTuple):
    """The members of an ensemble, as options, on the states of layouts.

    ``match``, float (G*K,), is their balanced accuracy (Spec F6), NaN where the domain does not have the sub-goal but
    the user's own labels do: its truth is unknown there. ``counts``, int (G*K,), are of the states in which they are
    positive. ``sets``, of pictures only, has for options that are positive anywhere an :func:`overlay` of these.
    """

    match: Doubles
    counts: Ints
    sets: dict[int, Bytes]


def on_layout(path: Path, layouts: tuple[int, ...]) -> OnLayout:
    """Every member of an ensemble's artefact on the states of layouts: those that can be reached, else that are met."""
    from hypogoal.hypotheses.ensemble import read_ensemble  # with PyTorch, which a report needs not

    source = Artefact(path)
    domain = base.load_domain(source.config["domain"])
    world = domain.world(source.config["domain_config"])
    if len(layouts) > 1:
        world["layouts"] = base.Layouts(layouts)
    engine = domain.make_engine(layouts[0], len(layouts), 500, **world)
    ids = engine.reachable()
    if ids is None:
        ids = states_met(engine, 2_000, rng_for(0, "states-of-layout"))
    images, labels = engine.images(ids), engine.labels(ids)
    matches, verdicts = [], []
    for sub_goal in source.config["sub_goals"]:
        ensemble = read_ensemble(source.path, source.config, sub_goal)
        predictions = ensemble.predictions(images)
        match = np.full(predictions.shape[1], np.nan)
        if sub_goal in domain.sub_goals:
            truth = labels[:, domain.sub_goals.index(sub_goal)]
            match = scores.member_scores(predictions, truth)["balanced_accuracy"]
        matches.append(match)
        verdicts.append(predictions)
    positive = np.concatenate(verdicts, axis=1)
    sets = {}
    for option, states in enumerate(positive.T):
        if states.any() and images.dtype == PICTURE:
            sets[option] = overlay(images[states])
    return OnLayout(np.concatenate(matches), positive.sum(axis=0), sets)


def states_met(engine: base.Engine, steps: int, rng: np.random.Generator) -> Ints:
    """The states that random play of an engine meets in so many steps, each once."""
    met = [engine.ids]
    for _ in range(steps // engine.count):
        met.append(engine.step(rng.integers(engine.n_actions, size=engine.count)).next_ids)
    return np.unique(np.concatenate(met))


def missing(work: Work) -> list[str]:
    """Sub-goals of which the domain does not know where they are reached, and where to say it."""
    lines = {}
    for artefact in filter(takes, work.contents.agents):
        name = artefact.config["domain"]
        domain = base.load_domain(name)
        for sub_goal in artefact.config["sub_goals"]:
            if sub_goal in domain.sub_goals:
                continue
            do = f"add {sub_goal} to the domain's sub_goals"
            if name in base.BUILT_IN:
                do = "import them under one of these names, if it is one of them"
            has = f"{name} has {page.listed(domain.sub_goals)}"
            lines[f"no truth of {sub_goal} to match members with: {has}; {do}, then evaluate again"] = True
    return [*lines]


def context(results: page.Results) -> dict[str, Any] | None:
    """A row of ``table`` for each run's member; ``members``: those of the first run that learned to choose, if any."""
    numbers = results.of(scope=SCOPE)
    if numbers.empty:
        return None
    place = ["artefact", "method", "layout", "seed", "sub_goal", "member"]
    wide = numbers.pivot_table(index=place, columns="quantity", values="value", sort=False).reset_index()
    table = wide.reindex(columns=[*place, *NUMBERS])
    learned = table[table["method"].isin([*chosen_by(results, "learned")])]
    shown = table if learned.empty else learned
    members = shown[shown["artefact"] == shown["artefact"].min()]
    return {"table": table, "members": members.reset_index(drop=True)}


def figures(context: Mapping[str, Any]) -> Iterator[page.Drawn]:
    """Figures 7 and 8 and the other sub-goals', of the run that is shown; none of numbers."""
    members, arrays = context["members"], context["results"].arrays
    path = members["artefact"].min()
    for sub_goal, of_goal in members.groupby("sub_goal", sort=False):
        preference = of_goal["preference"].dropna()
        sides = []
        for word, option in (("most", preference.idxmax()), ("least", preference.idxmin())) if len(preference) else ():
            states = arrays.get(f"terminations/{path}/{option}")
            if states is not None:
                count = arrays[f"{STATES}/{path}/counts"][option]
                sides.append((f"{word} preferred: member {members['member'][option]}\n{count:,} states", states))
        if sides:
            name = NUMBERED.get(str(sub_goal), f"terminations-{sub_goal}")
            label = f"Termination states of {sub_goal}"
            yield page.Drawn(name, label, termination_states(sides), {"sub_goal": sub_goal})


def termination_states(sides: Sequence[tuple[str, Bytes]]) -> Figure:
    """Figures 7 and 8: overlaid termination states of some members, the most preferred first.

    A side is a title and an overlay uint8 (H, W, C).
    """
    with plots.styled():
        figure, places = plots.pictures(1, 2, titles=0.6)
        for place, (title, image) in zip(places, sides, strict=False):
            plots.show_picture(place, image, title)
    return figure
