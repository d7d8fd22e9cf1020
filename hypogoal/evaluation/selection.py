"""Figures 7 and 8: which members the meta-policy prefers, and where their options stop."""

import re
from collections.abc import Mapping, Sequence
from functools import cache, partial
from pathlib import Path
from typing import Any

import numpy as np

from hypogoal.core.arrays import Bytes, Doubles, Ints
from hypogoal.core.artefacts import Artefact
from hypogoal.core.seeding import rng_for
from hypogoal.domains import find
from hypogoal.domains.base import Engine, Layouts
from hypogoal.evaluation import page, plots
from hypogoal.evaluation.curves import chosen_by
from hypogoal.evaluation.pictures import overlay
from hypogoal.evaluation.run import takes
from hypogoal.evaluation.table import melted, options_of
from hypogoal.hypotheses import scores
from hypogoal.meta.config import layout_seeds
from hypogoal.observations import PICTURE
from hypogoal.options.tables import ChoiceCounts

TITLE = "Which hypotheses are chosen, and where they stop"
LOOKED_AT = 10  # first layouts of an agent that has many, on whose states members are compared with the truth
NUMBERED = {
    "open-red-door": "figure7",
    "go-to-goal": "figure8",
}  # the sub-goals that the paper shows
SCOPE = "layout"  # scope of choices, and of the match with the truth, on a run's layout
COUNTS = ("offered", "chosen", "reached", "expected")
NUMBERS = (*COUNTS, "duration", "preference", "match")  # numbers of an option


def rows(work):
    """Yield the choices of each agent whose options are members, and how well the members match the truth."""
    judged = cache(on_layout)
    for artefact in work.contents.agents:
        work.progress.advance()
        if not takes(artefact):
            continue
        config, name = artefact.config, work.contents.name(artefact)
        seeds = layout_seeds(config.get("layouts") or "", config["layout_seed"])[:LOOKED_AT]
        match, overlaid = judged(artefact.input("ensemble"), tuple(seeds))
        for option, picture in overlaid.items():
            work.arrays[f"terminations/{name}/{option}"] = picture
        columns = numbers_of_choices(ChoiceCounts.read(artefact.path / ChoiceCounts.FILE), len(match))
        columns["match"] = match
        yield melted(columns, options_of(config), **work.place(artefact), scope=SCOPE)


def numbers_of_choices(choices: ChoiceCounts, options: int) -> dict[str, Doubles]:
    """Return the numbers of each of O options: ``COUNTS``, the mean ``duration`` in steps, and ``preference``.

    A raw share is confounded: a member that always fires is masked nearly always, and a member that never fires is
    always offered. ``preference`` (O,) is chosen / expected. It is 1 for a chooser that does not care, and NaN for an
    option that was never offered. ``expected`` is the sum of 1 / (options offered) over the decisions that offered the
    option.
    """
    columns = {name: choices.total(name, options) for name in COUNTS}
    columns["duration"] = scores.ratio(choices.total("duration", options), columns["chosen"])
    columns["preference"] = scores.ratio(columns["chosen"], columns["expected"])
    return columns


def on_layout(
    path: Path,
    layouts: tuple[int, ...],
) -> tuple[Doubles, dict[int, Bytes]]:
    """Return how well each member of an ensemble matches the truth on layouts, and the states where it is positive.

    The states are all that can be reached or, if the engine does not know them, those that random play meets. The first
    result is each option's balanced accuracy (G*K,). It is NaN if the user's own labels define the sub-goal, because
    the domain does not know its truth. The second result is empty unless states are pictures; then it has, for each
    option that is positive anywhere, an :func:`overlay` of the positive states.
    """
    from hypogoal.hypotheses.ensemble import read_ensemble  # with PyTorch, which a report does not need

    config = Artefact(path).config
    in_domain = find.load_domain(config["domain"]).sub_goals
    engine = engine_on(config, layouts)
    ids = engine.reachable()
    if ids is None:
        ids = states_met(engine, 2_000, rng_for(0, "states-of-layout"))
    images, labels = engine.images(ids), engine.labels(ids)
    matches, verdicts = [], []
    for sub_goal in config["sub_goals"]:
        predictions = read_ensemble(path, config, sub_goal).predictions(images)
        match = np.full(predictions.shape[1], np.nan)
        if sub_goal in in_domain:
            truth = labels[:, in_domain.index(sub_goal)]
            match = scores.member_scores(predictions, truth)["balanced_accuracy"]
        matches.append(match)
        verdicts.append(predictions)
    positive = np.concatenate(verdicts, axis=1)
    sets = {}
    if images.dtype == PICTURE:
        for option in np.flatnonzero(positive.any(axis=0)):
            sets[int(option)] = overlay(images[positive[:, option]])
    return np.concatenate(matches), sets


def engine_on(config: Mapping[str, Any], layouts: Sequence[int]) -> Engine:
    """Return an engine with a game on each of ``layouts``, in the world that an artefact's ``config`` says."""
    domain = find.load_domain(config["domain"])
    world = domain.world(config["domain_config"])
    if len(layouts) > 1:
        world["layouts"] = Layouts(layouts)
    return domain.make_engine(layouts[0], len(layouts), 500, **world)


def states_met(
    engine: Engine,
    steps: int,
    rng: np.random.Generator,
) -> Ints:
    """Return the distinct states, int64 (n,), that random play of an engine meets in ``steps`` environment steps."""
    met = [engine.ids]
    for _ in range(steps // engine.count):
        met.append(engine.step(rng.integers(engine.n_actions, size=engine.count)).next_ids)
    return np.unique(np.concatenate(met))


def missing(work):
    """Return a line for each sub-goal that is not known to the domain of an agent."""
    lines = set()
    for artefact in filter(takes, work.contents.agents):
        name = artefact.config["domain"]
        in_domain = find.load_domain(name).sub_goals
        for sub_goal in set(artefact.config["sub_goals"]).difference(in_domain):
            lines.add(f"no truth of {sub_goal} to match members with: {name} has {page.listed(in_domain)}")
    return sorted(lines)


def context(results):
    """Return ``table``, with a row for each run's member, and the figures.

    ``members`` are the rows of the first run that learned to choose or, if none did, of the first run.
    """
    numbers = results.of(scope=SCOPE)
    if numbers.empty:
        return {}
    place = ["artefact", "method", "layout", "seed", "sub_goal", "member"]
    wide = numbers.pivot_table("value", place, "quantity", sort=False).reset_index()
    table = wide.reindex(columns=[*place, *NUMBERS])
    learned = table["method"].isin([*chosen_by(results, "learned")])
    shown = table[learned] if learned.any() else table
    first = min(shown["artefact"], key=_by_numbers)
    members = shown[shown["artefact"] == first].reset_index(drop=True)
    return {
        "table": table,
        "members": members,
        "figures": [*_figures(members, results.arrays)],
    }


def _by_numbers(path):
    """Return a key that sorts paths by the numbers in them, so that seed-2 comes before seed-10."""
    texts = re.split(r"(\d+)", path)
    return [int(text) if text.isdecimal() else text for text in texts]


def _figures(members, arrays):
    """Yield a figure per sub-goal (7, 8 and others): where options of the most and the least preferred member stop."""
    path = members["artefact"].min()
    for sub_goal, of_goal in members.dropna(subset="preference").groupby("sub_goal", sort=False):
        preference = of_goal["preference"]
        sides = {}
        for word, option in (("most", preference.idxmax()), ("least", preference.idxmin())):
            states = arrays.get(f"terminations/{path}/{option}")
            if states is not None:
                sides[f"{word} preferred\nmember {members['member'][option]}"] = states
        if sides:
            name = NUMBERED.get(str(sub_goal), f"terminations-{sub_goal}")
            label = f"Termination states of {sub_goal}"
            yield page.Drawn(
                name,
                label,
                partial(side_by_side, sides),
                {"sub_goal": sub_goal},
            )


def side_by_side(sides):
    """Draw at most two pictures, given by their titles."""
    figure, _ = plots.panels(sides.items(), 2, titles=0.6)
    return figure
