"""Figures 4 and 5: how near to the true sub-goal options stop that were learned on ladders (Spec F3, F4)."""

import math
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import numpy as np
import pandas as pd
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from numpy.typing import NDArray

from hypogoal.core.artefacts import Artefact
from hypogoal.domains.base import Domain, installed_domain
from hypogoal.evaluation.house import over, pairs, per_run, tidy
from hypogoal.evaluation.judging import Work
from hypogoal.evaluation.names import ORACLE, rank
from hypogoal.evaluation.page import (
    Drawn,
    Results,
    deviation,
    displayed,
    mean,
    pairs_displayed,
    spans,
)
from hypogoal.evaluation.pictures import STATES, overlay
from hypogoal.evaluation.plots import GREY, INK, ORANGE, PALETTE, PURPLE, SKY, WIDTH, legend_below, plot, styled
from hypogoal.evaluation.rooms import VALIDATED, lacking
from hypogoal.evaluation.run import read_terminations, takes, thresholds_of, within
from hypogoal.hypotheses.scores import most_and_least
from hypogoal.options.tables import Executions

TITLE = "Options on ladders"
INSIDE = 300  # the distance of an execution that begins inside its own termination set (the paper's, a ladder's length)
NEAR = 4  # Manhattan distance that counts as there: the farthest corner of the base region, 2 in x and 2 in y
HIT, MISS, BEGAN_INSIDE = range(3)  # what became of an execution
BEST, WORST = "best_member", "worst_member"  # quantities: which member it is
SHARES = {"reached_base": "at sub-goal", "inside_at_start": "inside", "timed_out": "timed out", "died": "died"}
PICKED = {"best": BEST, "validated": VALIDATED, "mean": "mean", "worst": WORST}
BY = {"N": "N", "method": "method"}
COLUMNS = {which: (which, deviation(1)) for which in PICKED} | {"± exec.": ("executions_deviation", mean(1))}
COLUMNS |= {f"{title}, %": (share, mean(0, 100)) for share, title in SHARES.items()}
COLUMNS["seeds"] = ("best", lambda row: str(row["n"]))
ROOMS_SHOWN = 3
MARK: dict[str, Any] = {"linestyle": "none", "markersize": 6, "markeredgewidth": 1.5}
STOPS: dict[int, tuple[str, dict[str, Any]]] = {
    HIT: ("at the true sub-goal", MARK | {"marker": "o", "color": SKY, "markeredgewidth": 0.6, "markeredgecolor": INK}),
    MISS: ("elsewhere", MARK | {"marker": "x", "color": ORANGE}),
    BEGAN_INSIDE: ("began inside: counts 300", MARK | {"marker": "s", "color": PURPLE, "fillstyle": "none"}),
}
NEEDED = {
    "figure4": "options with executions.csv: train-options --set start=LADDER",
    "figure5": "the same, of a domain that draws its rooms",
}


def counted(executions: Executions) -> NDArray[np.float64]:
    """Spec F3: each execution's distance as it counts, (n,): 300 where it began inside its own termination set."""
    return np.where(executions.inside_at_start, INSIDE, executions.distance).astype(np.float64)


def at_base(executions: Executions) -> NDArray[np.bool_]:
    """Spec F3: which executions got to a true base, bool (n,): within 4 of one, and not inside at the start."""
    return (executions.distance <= NEAR) & ~executions.inside_at_start


def fates(executions: Executions) -> NDArray[np.int64]:
    """Figure 5: what became of executions, (n,): ``HIT`` at a true base, ``MISS``, or ``BEGAN_INSIDE``."""
    return np.select([executions.inside_at_start, at_base(executions)], [BEGAN_INSIDE, HIT], MISS)


def option_numbers(executions: Executions, *, never_offered: bool = False) -> dict[str, float]:
    """Spec F3: the numbers of one option's last executions; NaN without executions, the deviation also of one.

    An option ``never_offered`` has none because it would always have begun inside its own termination set: it counts
    300. Units: the domain's; duration in steps; shares of executions. Timed out: neither classifier nor death ended it.
    """
    values = pd.DataFrame(
        {
            "distance": counted(executions),
            "duration": executions.duration,
            "reached_base": at_base(executions),
            "inside_at_start": executions.inside_at_start,
            "timed_out": ~executions.reached & ~executions.terminated,
            "died": executions.terminated,
        }
    ).astype(np.float64)
    numbers: dict[str, float] = dict(zip(values.columns, values.mean(), strict=True))
    numbers["executions"] = len(values)
    numbers["executions_deviation"] = values["distance"].std()
    if never_offered and values.empty:
        numbers["distance"] = INSIDE
    return numbers


def rows(work: Work) -> Iterator[pd.DataFrame]:
    """Spec F3: every member's option on every ladder: where its executions stopped; overlays go to the arrays."""
    for artefact in sorted(work.contents.ladders, key=lambda artefact: rank(work.place(artefact)["method"])):
        path, config = work.contents.name(artefact), artefact.config
        executions = Executions.read(artefact.path / "executions.csv")
        source = within(work.contents, Artefact(artefact.input("ensemble"))) if takes(artefact) else None
        validated = {goal: work.validated.get((source or "", goal)) for goal in config["sub_goals"]}
        thresholds = thresholds_of(artefact)
        yield from rows_of_ladder(executions, config, validated, thresholds, work.place(artefact))
        if "terminations.h5" in artefact.manifest.files:
            _write_overlays(work.arrays, artefact, path)
        work.progress.advance()


def rows_of_ladder(
    executions: Executions,
    config: Mapping[str, Any],
    validated: Mapping[str, int | None],
    thresholds: NDArray[np.float64],
    place: Mapping[str, Any],
) -> Iterator[pd.DataFrame]:
    """Spec F3: one options artefact, trained from one start (a ladder) on G sub-goals with K members each.

    Per sub-goal each member's numbers, with its threshold (of (G*K,)); the best member (the least mean distance), the
    worst, and the validated one. Where ``mask_reached``, options that would begin inside were not offered (Spec D6).
    """
    members = config["members"]
    masked = config["mask_reached"] and len(executions.step) > 0
    for index, sub_goal in enumerate(config["sub_goals"]):
        distances = []
        for member in range(members):
            option = index * members + member
            numbers = option_numbers(executions.of(option), never_offered=masked)
            distances.append(numbers["distance"])
            numbers["threshold"] = thresholds[option]
            yield tidy(numbers, **place, sub_goal=sub_goal, member=member)
        worst, best = most_and_least(np.array(distances))
        picked = {BEST: best, WORST: worst, VALIDATED: validated.get(sub_goal)}
        yield tidy(picked, **place, sub_goal=sub_goal)


def _write_overlays(arrays: Any, artefact: Artefact, path: str) -> None:
    ends = read_terminations(artefact.path / "terminations.h5")
    for option, states in ends.items():
        arrays.create_dataset(f"terminations/{path}/{option}", data=overlay(states), compression="gzip")
    options = range(len(artefact.config["sub_goals"]) * artefact.config["members"])
    arrays[f"{STATES}/{path}/counts"] = np.array([len(ends.get(option, ())) for option in options], np.int64)


def facts(work: Work) -> dict[str, Any]:
    """The ladders from the top down, and what Figure 5 shows, whose stops and pictures go to the arrays.

    Of each ladder and N the best members of the first seed; nothing where the domain has no pictures.
    """
    artefacts = work.contents.ladders
    domains = {artefact.config["domain"] for artefact in artefacts}
    domain = installed_domain(domains.pop()) if len(domains) == 1 else None
    used = {artefact.config["start"] for artefact in artefacts}
    ordered = [start for start in (domain.starts if domain else ()) if start in used]
    ladders = [*ordered, *sorted(used.difference(ordered))]
    shown = []
    if domain is not None and domain.pictures:
        for ladder in ladders:
            shown += _stops_of(work, domain, ladder)
        for room in sorted({room for figure in shown for room in figure["rooms"]}):
            work.arrays[f"pictures/{room}"] = domain.picture(room)
    return {"ladders": ladders, "stops": shown}


def _stops_of(work: Work, domain: Domain, ladder: str) -> list[dict[str, Any]]:
    """Figure 5 of one ladder, for each N: each method's best option; oracle terminations stand beside every N."""
    artefacts = [artefact for artefact in work.contents.ladders if artefact.config["start"] == ladder]
    first = min(artefact.seed for artefact in work.contents.ladders)
    options: list[dict[str, Any]] = []
    for artefact in artefacts:
        if artefact.seed == first:
            options += _best_options(work, domain, artefact)
    options.sort(key=lambda option: rank(option["method"]))
    groups = sorted({option["N"] for option in options if option["N"] is not None}) or [None]
    shown = []
    for number in groups:
        beside = [dict(option) for option in options if option["N"] in (number, None)]
        where = [work.arrays[f"{option['stops']}/positions"][:, 0] for option in beside]
        rooms = rooms_shown(where, [room for name in ladder.split(",") for room in domain.rooms_of(name)])
        for option, rooms_of_stops in zip(beside, where, strict=True):
            option["elsewhere"] = int((~np.isin(rooms_of_stops, rooms)).sum())
        if beside:
            shown.append({"ladder": ladder, "N": number, "seed": first, "rooms": rooms, "options": beside})
    return shown


def _best_options(work: Work, domain: Domain, artefact: Artefact) -> Iterator[dict[str, Any]]:
    """Of each sub-goal the option that stops nearest; its stops are written into the arrays."""
    place = work.place(artefact)
    executions = Executions.read(artefact.path / "executions.csv")
    members = artefact.config["members"]
    for index, sub_goal in enumerate(artefact.config["sub_goals"]):
        of_members = [executions.of(index * members + member) for member in range(members)]
        masked = artefact.config["mask_reached"] and len(executions.step) > 0
        distances = [option_numbers(stops, never_offered=masked)["distance"] for stops in of_members]
        _, best = most_and_least(np.array(distances))
        if best is None:
            continue
        stops = of_members[best]
        folder = f"stops/{place['artefact']}/{index * members + best}"
        work.arrays[f"{folder}/positions"] = stops.positions()
        pixels = np.asarray(domain.pixel(stops.positions()), np.float64).reshape(-1, 2)
        work.arrays[f"{folder}/pixels"] = pixels
        work.arrays[f"{folder}/fates"] = fates(stops)
        yield {
            "method": place["method"],
            "N": place["N"],
            "sub_goal": sub_goal,
            "member": best,
            "distance": distances[best],
            "executions": len(stops.step),
            "hits": int((fates(stops) == HIT).sum()),
            "inside": int(stops.inside_at_start.sum()),
            "stops": folder,
        }


def rooms_shown(where: Sequence[NDArray[np.int64]], of_ladder: Sequence[int] = ()) -> list[int]:
    """Figure 5: the rooms that are drawn: the ladder's own, from the top down, then those in which the most executions
    stopped; ``where`` are per option the rooms of its stops, (n,).
    """
    first = list(dict.fromkeys(of_ladder))
    rooms, counts = np.unique(np.concatenate([np.zeros(0, np.int64), *where]), return_counts=True)
    often = rooms[np.argsort(-counts, kind="stable")]
    others = [int(room) for room in often if room not in first]
    return [*first, *others][: max(ROOMS_SHOWN, len(first))]


def tables(results: Results) -> dict[str, pd.DataFrame]:
    """Spec F3, Figure 4: distances per method and N over seeds, each seed's mean over the run's ladders first.

    Of the best, validated, mean and worst member, and the best member's shares. A seed that lacks a ladder is left out:
    unlike ladders are not averaged. Artefacts with one seed and ladder all count.
    """
    numbers = results.numbers[results.numbers["ladder"] != ""]
    runs = [per_run(numbers, "distance", member=member, name=which) for which, member in PICKED.items()]
    runs += [per_run(numbers, name, member=BEST) for name in ("executions_deviation", *SHARES)]
    every = pd.concat(runs)
    return {
        "distance": over(_over_ladders(every, len(results.facts["ladders"])), ["method", "N", "sub_goal"]),
        "distance-pairs": pairs(compared(results)),
        "distance-seeds": _each_seed(results),
    }


def compared(results: Results) -> pd.DataFrame:
    """The numbers of runs by which options are compared; oracle terminations have no members to choose among."""
    numbers = results.numbers[(results.numbers["ladder"] != "") & ~results.numbers["method"].str.startswith(ORACLE)]
    parts = []
    for which in ("best", "validated", "mean"):
        parts.append(per_run(numbers, "distance", member=PICKED[which], name=f"distance, {which} member"))
    return pd.concat(parts).sort_values("N", kind="stable")


def _over_ladders(runs: pd.DataFrame, ladders: int) -> pd.DataFrame:
    """The mean over ladders of each seed that has all of them, as runs."""
    cell = ["method", "N", "sub_goal", "quantity", "of"]
    copies = runs.groupby([*cell, "seed", "ladder"], dropna=False).cumcount()
    seeds = runs.assign(copy=copies).groupby([*cell, "seed", "copy"], dropna=False, sort=False)
    means = seeds.agg(value=("value", "mean"), ladders=("ladder", "nunique")).reset_index()
    return means[means["ladders"] == ladders].assign(layout=None)


def context(results: Results) -> dict[str, Any] | None:
    """For the template: the table over ladders, pairs, and which seeds are left out."""
    if not results.facts["ladders"]:
        return None
    computed = tables(results)
    table = computed["distance"].sort_values("N", kind="stable", na_position="last")
    by = dict(BY)
    if table["sub_goal"].nunique() > 1:
        by["sub_goal"] = "sub-goal"
    shown = displayed(table, by, COLUMNS)
    printed = {which: (which, mean(1)) for which in PICKED} | {"at sub-goal, %": ("reached_base", mean(0, 100))}
    return {
        "table": shown,
        "printed": displayed(table, by, printed),
        "pairs": pairs_displayed(computed["distance-pairs"], {"distance, best member": 1}),
        "ladders": results.facts["ladders"],
        "stops": results.facts["stops"],
        "seeds": spans(results.numbers[results.numbers["ladder"] != ""]["seed"]),
    }


def figures(results: Results) -> Iterator[Drawn]:
    """Figures 4 and 5."""
    if not results.facts["ladders"]:
        return
    table = tables(results)["distance"]
    best = table[table["quantity"] == "best"].sort_values("N", kind="stable", na_position="last")
    if len(best):
        yield Drawn("figure4", "Figure 4: distance to the true sub-goal", distance_bars(best, _each_seed(results)))
    for figure in results.facts["stops"]:
        suffix = "" if figure["N"] is None else f"-N{figure['N']}"
        pictures = [(room, results.arrays[f"pictures/{room}"]) for room in figure["rooms"]]
        options = []
        for option in figure["options"]:
            of_option = results.within(option["stops"])
            rooms = of_option["positions"][:, 0]
            options.append((option["method"], rooms, of_option["pixels"], of_option["fates"]))
        drawn = stops_over_rooms(pictures, options)
        yield Drawn(f"figure5-{figure['ladder']}{suffix}", "Figure 5: where executions stopped", drawn, figure)


def _each_seed(results: Results) -> pd.DataFrame:
    """The best member's distance of each seed, mean over ladders."""
    numbers = results.numbers[results.numbers["ladder"] != ""]
    runs = per_run(numbers, "distance", member=BEST, name="best")
    return _over_ladders(runs, len(results.facts["ladders"]))


def distance_bars(best: pd.DataFrame, seeds: pd.DataFrame) -> Figure:
    """Figure 4: the best member's distance; lower is better. A line marks ``INSIDE`` if it is near.

    ``best`` is of :func:`tables`, methods side by side for each N; ``seeds`` their values, drawn as dots.
    """
    methods = [name for name in best["method"].unique() if not name.startswith(ORACLE)]
    groups = list(best["N"].unique())
    with styled():
        figure, axes = plot(3.1)
        for place, number in enumerate(groups):
            alike = best[best["N"].isna() if pd.isna(number) else best["N"] == number]
            width = min(0.26, 0.84 / len(alike))
            for index, (_, row) in enumerate(alike.iterrows()):
                x = place + (index - (len(alike) - 1) / 2) * width
                is_method = row["method"] in methods
                colour = PALETTE[methods.index(row["method"]) % len(PALETTE)] if is_method else GREY
                axes.bar(x, row["mean"], width * 0.92, color=colour, alpha=0.8, label=row["method"])
                if pd.notna(row["standard_deviation"]):
                    axes.errorbar(x, row["mean"], row["standard_deviation"], color=INK, capsize=3, linewidth=1.2)
                same_n = seeds["N"].isna() if pd.isna(number) else seeds["N"] == number
                same = (seeds["method"] == row["method"]) & same_n & (seeds["sub_goal"] == row["sub_goal"])
                axes.plot(np.full(same.sum(), x), seeds["value"][same], ".", color=INK, markersize=5, alpha=0.7)
        highest = (best["mean"] + best["standard_deviation"].fillna(0)).max()
        if highest > INSIDE / 2:
            axes.axhline(INSIDE, color=GREY, linewidth=1.2, linestyle=":", label="began inside its own termination set")
        names = ["true sub-goal" if pd.isna(number) else f"N={number}" for number in groups]
        axes.set_xticks(range(len(groups)), names)
        axes.set_xlim(-0.6, len(groups) - 0.4)
        axes.grid(visible=False, axis="x")
        axes.set_ylim(0, None)
        axes.set_ylabel("distance to the true sub-goal\n(units of position)")
        legend_below(figure, [axes], 2)
    return figure


def stops_over_rooms(
    pictures: Sequence[tuple[int, NDArray[np.uint8]]],
    options: Sequence[tuple[str, NDArray[np.int64], NDArray[np.float64], NDArray[np.int64]]],
) -> Figure:
    """Figure 5: a row per option, its rooms side by side; with one room two options in a row.

    What became of an execution is told by shape and by colour. A picture is (room, uint8 (H, W, 3)), an option its
    title and of the stops their rooms (n,), pixels (n, 2) in the pictures and :func:`fates` (n,).
    """
    panels = [(option, picture) for option in options for picture in pictures]
    columns = max(2, len(pictures))
    rows = math.ceil(len(panels) / columns)
    height, width = pictures[0][1].shape[:2]
    with styled():
        high = WIDTH / columns * height / width
        figure = Figure(figsize=(WIDTH, rows * (high + 0.24) + 0.24))
        places = figure.subplots(rows, columns, squeeze=False)
        for place in places.flat:
            place.set_axis_off()
        for place, ((title, rooms, pixels, ends), (room, picture)) in zip(places.flat, panels, strict=False):
            place.imshow(picture, interpolation="none", aspect="auto")
            for fate, (_, mark) in STOPS.items():
                x, y = pixels[(rooms == room) & (ends == fate)].T
                place.plot(x, y, alpha=0.75, **mark)
            name = f"{title}, room {room}" if room == pictures[0][0] else f"room {room}"
            place.set_title(name, pad=3, fontsize=9.5 if columns == 2 else 8)
        handles = [Line2D([], [], **mark) for _, mark in STOPS.values()]
        labels = [name for name, _ in STOPS.values()]
        figure.legend(handles, labels, loc="outside lower left", ncols=3, handletextpad=0.2, columnspacing=1.2)
    return figure


def missing(work: Work) -> list[str]:
    """Spec F3, F4: the options that are not there, of a run with ladders."""
    contents = work.contents
    lines = [
        f"no executions.csv in {contents.name(artefact)}: its domain tells no distance" for artefact in contents.silent
    ]
    if not contents.ladders:
        return [*lines, "no options of a ladder (Figures 4 and 5)"] if work.validated else lines
    methods = [work.place(artefact)["method"] for artefact in contents.ladders]
    lines += lacking(methods, "options", "Figures 4 and 5")
    if any(method.startswith(ORACLE) for method in methods):
        return lines
    return [*lines, "no options with oracle terminations beside them"]
