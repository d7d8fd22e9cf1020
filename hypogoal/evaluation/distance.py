"""Figures 4 and 5: how near to the true sub-goal the options stop that were learned on ladders."""

from collections.abc import Iterator, Mapping
from functools import partial
from itertools import product
from typing import Any

import numpy as np
import pandas as pd
from matplotlib.figure import Figure
from pandas import DataFrame

from hypogoal.core.arrays import Bytes
from hypogoal.domains.episodes import LAST
from hypogoal.domains.find import installed_domain
from hypogoal.evaluation import plots
from hypogoal.evaluation.hypotheses import VALIDATED
from hypogoal.evaluation.names import ORACLE
from hypogoal.evaluation.page import Drawn
from hypogoal.evaluation.run import takes
from hypogoal.evaluation.statistics import tables_of
from hypogoal.evaluation.table import melted, options_of, per_run, tidy
from hypogoal.hypotheses.scores import most_and_least
from hypogoal.options.tables import Executions

TITLE = "Options on ladders"
INSIDE = 300  # distance of an execution that begins inside its own termination set: the paper's, a ladder's length
NEAR = 4  # Manhattan distance that counts as at the base, whose farthest corner is 2 away in x and 2 in y
BEST, WORST = "best_member", "worst_member"  # quantities whose value is the number of a member
SHARES = ("reached_base", "inside_at_start", "timed_out", "died")
PICKED = {"best": BEST, "validated": VALIDATED, "mean": "mean", "worst": WORST}
BY = ["N", "method", "sub_goal"]
PAIRED = ("best", "validated", "mean")
HIT, MISS, BEGAN_INSIDE = range(3)  # what became of an execution, its ``fate``
FATES = {  # how Figure 5 marks it
    HIT: ("there", "o", plots.SKY),
    MISS: ("elsewhere", "x", plots.ORANGE),
    BEGAN_INSIDE: ("began inside", "s", plots.PURPLE),
}
STOP = ["room", "column", "row", "fate"]  # where an execution stopped, in the picture of the room


def last_executions(executions: Executions) -> DataFrame:
    """Return the last executions of each option, a row each, with what counts.

    ``counted`` is the distance, or 300 if the execution began inside its own termination set. ``reached_base``: it
    stopped within 4 of a true base, and did not begin inside. ``timed_out``: neither the classifier nor death ended it.
    ``fate`` is as in Figure 5.
    """
    last = DataFrame(vars(executions)).groupby("option").tail(LAST)
    inside = last["inside_at_start"]
    near = (last["distance"] <= NEAR) & ~inside
    return last.assign(
        counted=last["distance"].mask(inside, INSIDE),
        reached_base=near,
        timed_out=~last["reached"] & ~last["terminated"],
        died=last["terminated"],
        fate=np.select([inside, near], [BEGAN_INSIDE, HIT], MISS),
    )


def option_numbers(executions: Executions) -> DataFrame:
    """Return a row for each option with the numbers of its last executions.

    The distance is in the domain's units, the duration in steps, and the others are shares of executions. The deviation
    of one execution is NaN.
    """
    of_option = last_executions(executions).groupby("option")
    numbers = of_option[["duration", *SHARES]].mean()
    return numbers.assign(
        distance=of_option["counted"].mean(),
        executions=of_option.size(),
        executions_deviation=of_option["counted"].std(),
    )


def rows(work):
    """Yield the numbers of every member's option on every ladder.

    Where the options of the first seed stopped, which Figure 5 shows, is written to the arrays.
    """
    ladders = work.ranked(work.contents.ladders)
    first = min((artefact.seed for artefact in ladders), default=0)
    for artefact in ladders:
        executions = Executions.read(artefact.path / Executions.FILE)
        source = artefact.input("ensemble").resolve() if takes(artefact) else None
        validated = work.validated.get(source, {})
        yield from rows_of_ladder(
            executions,
            artefact.config,
            validated,
            work.place(artefact),
        )
        if artefact.seed == first:
            _write_stops(work, artefact, executions)
        work.progress.advance()


def rows_of_ladder(
    executions: Executions,
    config: Mapping[str, Any],
    validated: Mapping[str, float | None],
    place: Mapping[str, Any],
) -> Iterator[DataFrame]:
    """Yield the rows of one options artefact, trained from one start (a ladder) on G sub-goals with K members each.

    The rows of a sub-goal are each member's numbers, and which member is best (the least mean distance), worst, and
    validated. With ``mask_reached``, options that would begin inside were not offered, and count 300.
    """
    options = options_of(config)
    every = option_numbers(executions).reindex(range(len(options))).set_axis(options)
    every["executions"] = every["executions"].fillna(0)
    if config["mask_reached"] and len(executions):
        every.loc[every["executions"] == 0, "distance"] = INSIDE
    yield melted(every, **place)
    for sub_goal, distances in every["distance"].groupby("sub_goal", sort=False):
        worst, best = most_and_least(distances.to_numpy(float))
        picked = {VALIDATED: validated.get(str(sub_goal)), BEST: best, WORST: worst}
        yield tidy(picked, **place, sub_goal=sub_goal)


def _write_stops(
    work,
    artefact,
    executions,
):
    """Write what Figure 5 needs: ``STOP`` of each execution of each sub-goal's best option, and pictures of rooms."""
    domain = installed_domain(artefact.config["domain"])
    if domain is None or not domain.pictures:
        return
    distances = option_numbers(executions)["distance"]
    best = distances.groupby(distances.index // artefact.config["members"]).idxmin()
    last = last_executions(executions)
    stops = last[last["option"].isin(best)].copy()
    stops[["column", "row"]] = domain.pixel(stops[["room", "x", "y"]].to_numpy())
    work.arrays[f"stops/{work.contents.name(artefact)}"] = stops[STOP].to_numpy(float)
    for room in stops["room"].unique():
        if f"pictures/{room}" not in work.arrays:
            work.arrays.create_dataset(f"pictures/{room}", data=domain.picture(room), compression="gzip")


def context(results):
    """Return Figure 4's table: each seed's mean over the run's ladders of the best, validated, mean and worst member.

    The table has the best member's shares, too. A seed that lacks a ladder is left out, because unlike ladders are not
    averaged. Methods are compared ladder by ladder, except oracle terminations, which have no members to choose among.
    """
    numbers = results.numbers[results.numbers["ladder"] != ""]
    if numbers.empty:
        return {}
    values = [
        per_run(
            numbers,
            "distance",
            member=member,
            name=which,
        )
        for which, member in PICKED.items()
    ]
    values.append(per_run(numbers, "executions_deviation", *SHARES, member=BEST))
    ladders = pd.concat(values)
    seeds = ladders.groupby([*BY, "quantity", "of", "seed"], dropna=False, sort=False)
    means = seeds.agg(value=("value", "mean"), ladders=("ladder", "nunique")).reset_index()
    whole = means[means["ladders"] == ladders["ladder"].nunique()]
    tables = tables_of(whole.assign(layout=None).sort_values("N", kind="stable"), BY)
    if not tables:
        return {}
    has_members = ~ladders["method"].str.startswith(ORACLE)
    compared = ladders[has_members & ladders["quantity"].isin(PAIRED)]
    return {**tables, "compared": compared, "figures": [*_figures(results, tables["table"])]}


def _figures(results, table):
    """Yield Figures 4 and 5."""
    best = table[table["quantity"] == "best"]
    yield Drawn("figure4", "Figure 4: distance to the true sub-goal", partial(distance_bars, best))
    rooms = results.within("pictures")
    options = results.of(quantity=BEST).drop_duplicates("artefact")
    for ladder, of_ladder in options.groupby("ladder"):
        shown = {}
        for _, option in of_ladder.iterrows():
            stops = results.arrays.get(f"stops/{option['artefact']}")
            if stops is not None:
                groups = "" if pd.isna(option["N"]) else f", N={option['N']}"
                shown[option["method"] + groups] = DataFrame(stops, columns=STOP)
        if shown:
            draw = partial(stops_over_rooms, rooms, shown)
            yield Drawn(
                f"figure5-{ladder}",
                "Figure 5: where executions stopped",
                draw,
                {"ladder": ladder},
            )


def distance_bars(best: DataFrame) -> Figure:
    """Draw Figure 4: the best member's distance, methods side by side for each N. Lower is better."""
    groups = best["N"].map("N={}".format).mask(best["N"].isna(), "true sub-goal")
    if best["sub_goal"].nunique() > 1:
        groups = best["sub_goal"] + "\n" + groups
    cells = best.assign(place=groups).set_index(["place", "method"])
    wide = cells[["mean", "standard_deviation"]].unstack(sort=False)
    figure, axes = plots.bars("bar", wide["mean"], 3.1, yerr=wide["standard_deviation"])
    axes.set(xlabel="", ylabel="distance to the true sub-goal\n(units of position)")
    return figure


def stops_over_rooms(rooms: Mapping[str, Bytes], options: Mapping[str, DataFrame]) -> Figure:
    """Draw Figure 5: a row per option, and side by side the two rooms in which most executions stopped.

    Shape and colour tell what became of an execution. ``rooms`` are pictures, uint8 (H, W, 3), by their numbers;
    ``options`` have ``STOP`` of each execution.
    """
    every = pd.concat(options.values())["room"].astype(int)
    shown = every.value_counts().index[:2]
    cells = [*product(options, shown)]
    pictures = []
    for method, room in cells:
        name = method if room == shown[0] else ""
        pictures.append((f"{name}\nroom {room}", rooms[str(room)]))
    figure, places = plots.panels(pictures, len(shown))
    for place, (method, room) in zip(places, cells, strict=True):
        stops = options[method]
        for fate, (label, marker, colour) in FATES.items():
            inside = stops[(stops["room"] == room) & (stops["fate"] == fate)]
            place.scatter(
                inside["column"],
                inside["row"],
                marker=marker,
                color=colour,
                label=label,
                alpha=0.75,
            )
    plots.legend_below(figure, 3)
    return figure
