"""Figures 4 and 5: how near to the true sub-goal options stop that were learned on ladders (Spec F3, F4)."""

import math
from collections import Counter, defaultdict
from collections.abc import Iterable, Iterator, Mapping, Sequence
from itertools import chain, count, product
from operator import itemgetter
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from numpy.typing import NDArray
from rich.table import Table as Printed

from hypogoal.core.artefacts import Artefact
from hypogoal.domains.base import Domain, installed_domain
from hypogoal.evaluation import page
from hypogoal.evaluation.judging import Work
from hypogoal.evaluation.numbers import (
    ORACLE,
    Metrics,
    by_groups,
    by_method,
    ensemble_name,
    grouped,
    groups_of,
    mean_of,
    method_rank,
    methods_lacking,
    name_apart,
    over,
)
from hypogoal.evaluation.page import Block, Drawn, Entry, Material, Question
from hypogoal.evaluation.pictures import STATES, overlay
from hypogoal.evaluation.plots import GREY, INK, METHOD_COLOURS, ORANGE, PURPLE, SKY, WIDTH, drawing, styled
from hypogoal.evaluation.rooms import VALIDATION, group_name
from hypogoal.evaluation.run import read_terminations, takes, thresholds_of, within
from hypogoal.evaluation.table import (
    BEST,
    VALIDATED,
    WORST,
    Number,
    Pairs,
    Row,
    by_fields,
    per_run,
    rows_of,
    select,
    with_members,
)
from hypogoal.hypotheses.scores import most_and_least
from hypogoal.learners.episodes import LAST
from hypogoal.options.tables import Executions

INSIDE = 300  # the distance of an execution that begins inside its own termination set (the paper's, a ladder's length)
NEAR = 4  # Manhattan distance that counts as there: the farthest corner of the base region, 2 in x and 2 in y
HIT, MISS, BEGAN_INSIDE = range(3)  # what became of an execution
SHARES = {"reached_base": "at sub-goal", "inside_at_start": "inside", "timed_out": "timed out", "died": "died"}
PICKED = {"best": BEST, "validated": VALIDATED, "mean": "mean", "worst": WORST}
NUMBERS = {which: Number("distance", "", "units of position", member) for which, member in PICKED.items()}
NUMBERS["executions_deviation"] = Number("executions_deviation", "", "units of position", BEST)
NUMBERS |= {share: Number(share, "", "share of executions", BEST) for share in SHARES}
OF_OPTIONS = ("executions", "distance", "executions_deviation", "duration", *SHARES, "threshold")
QUANTITIES = (*OF_OPTIONS, BEST, WORST, VALIDATED)
NOT_A_METHOD = frozenset({"start", "domain_config", "termination", "members"})  # settings said elsewhere
NO_PICTURES = "The domain has no pictures of its rooms."
ROOMS_SHOWN = 3
GAP, TITLE = 0.08, 0.24  # inches, between pictures and above each
HATCHES = ("", "//", r"\\", "xx")  # of bars, from one round of colours to the next
MARK: dict[str, Any] = {"linestyle": "none", "markersize": 6, "markeredgewidth": 1.5}
STOPS: dict[int, tuple[str, dict[str, Any]]] = {
    HIT: ("at the true sub-goal", MARK | {"marker": "o", "color": SKY, "markeredgewidth": 0.6, "markeredgecolor": INK}),
    MISS: ("elsewhere", MARK | {"marker": "x", "color": ORANGE}),
    BEGAN_INSIDE: ("began inside: counts 300", MARK | {"marker": "s", "color": PURPLE, "fillstyle": "none"}),
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


def option_numbers(executions: Executions, *, never_offered: bool = False) -> dict[str, float | int]:
    """Spec F3: the numbers of one option's last executions; NaN without executions, the deviation also of one.

    An option ``never_offered`` has none because it would always have begun inside its own termination set: it counts
    300. Units: the domain's; duration in steps; shares of executions. Timed out: neither classifier nor death ended it.
    """
    distance, executed = counted(executions), len(executions.step)
    shares = {
        "reached_base": at_base(executions),
        "inside_at_start": executions.inside_at_start,
        "timed_out": ~executions.reached & ~executions.terminated,
        "died": executions.terminated,
    }
    return {
        "executions": executed,
        "distance": float(INSIDE) if never_offered and not executed else mean_of(distance),
        "executions_deviation": float(distance.std(ddof=1)) if executed > 1 else math.nan,
        "duration": mean_of(executions.duration),
        **{name: mean_of(values) for name, values in shares.items()},
    }


def rows_of_ladder(
    executions: Executions,
    sub_goals: Sequence[str],
    members: int,
    validated: Mapping[str, int],
    *,
    masked: bool,
    thresholds: NDArray[np.float64] | None = None,
    **place: Any,
) -> Iterator[Row]:
    """Spec F3: one options artefact, trained from one start (a ladder) on G sub-goals with K members each.

    Per sub-goal each member's numbers, with its threshold (of (G*K,)); the best member (the least mean distance), the
    worst, and the validated one. ``masked``: options that would begin inside were not offered (Spec D6).
    """
    masked = masked and len(executions.step) > 0
    for index, sub_goal in enumerate(sub_goals):
        distances = []
        for member, option in enumerate(range(index * members, (index + 1) * members)):
            numbers = option_numbers(executions.of(option), never_offered=masked)
            numbers |= {} if thresholds is None else {"threshold": thresholds[option].item()}
            yield from rows_of(numbers, **place, sub_goal=sub_goal, member=member)
            distances.append(numbers["distance"])
        worst, best = most_and_least(np.array(distances))
        picked = {BEST: best, WORST: worst, VALIDATED: validated.get(sub_goal)}
        yield from rows_of(picked, **place, sub_goal=sub_goal)


def _of_options(rows: Iterable[Row]) -> list[Row]:
    return [row for row in select(rows, scope="", quantity=QUANTITIES) if row.ladder]


def options_of(rows: Iterable[Row]) -> list[dict[str, Any]]:
    """Of each options artefact and sub-goal its ``options``, and which member is ``best``, ``worst``, ``validated``."""
    names = {"method": "method", "groups": "N", "ladder": "ladder", "seed": "seed", "sub_goal": "sub_goal"}
    entries = with_members(_of_options(rows), path="artefact", **names)
    numbers: dict[str, Iterator[int]] = defaultdict(count)  # of each artefact's options
    for entry in entries:
        entry["options"] = entry.pop("members")
        for option in entry["options"]:
            option["option"] = next(numbers[entry["path"]])
        for name, quantity in {"best": BEST, "worst": WORST, "validated": VALIDATED}.items():
            member = entry.pop(quantity)
            entry[name] = None if math.isnan(member) else int(member)
    return entries


def distance_table(rows: Sequence[Row], ladders: Sequence[str]) -> list[dict[str, Any]]:
    """Spec F3, Figure 4: per method and N distances over seeds, each seed's mean over the run's ladders first.

    Entries have the distance of the best, validated, mean and worst member and the best member's shares. A seed that
    lacks a ladder is left out: unlike ladders are not averaged. Artefacts with one seed and ladder all count.
    """
    table = []
    cells = by_fields(_of_options(rows), "method", "N", "sub_goal")
    for key in sorted(cells, key=by_method):
        by_seed: dict[tuple[int, int], dict[str, list[Row]]] = {}
        artefacts: Counter[tuple[Any, ...]] = Counter()
        for (seed, ladder, _), of_artefact in by_fields(cells[key], "seed", "ladder", "artefact").items():
            by_seed.setdefault((seed, artefacts[seed, ladder]), {})[ladder] = of_artefact
            artefacts[seed, ladder] += 1
        seeds = [seed for seed in sorted(by_seed) if by_seed[seed].keys() >= set(ladders)]
        incomplete = [seed for seed, number in sorted(by_seed) if (seed, number) not in seeds]
        entry: dict[str, Any] = dict(zip(("method", "groups", "sub_goal"), key, strict=True))
        entry |= {"ladders": list(ladders), "seeds": len(seeds), "incomplete_seeds": incomplete}
        for name, number in NUMBERS.items():
            means = [float(np.mean([per_run(by_seed[seed][on], number)[0][1] for on in ladders])) for seed in seeds]
            entry |= {"each_seed": means} if name == "best" else {}
            entry[name] = over(means, number.unit, "distance", *map(str, key), name, deviation=True)
        table.append(entry)
    return table


def ladder_names(
    methods: Sequence[str], groups: Sequence[int | None], configs: Sequence[Mapping[str, Any]]
) -> list[str]:
    """Names of n options artefacts by their ensemble's method; where their own settings differ at one N, with those."""
    settings = [{key: value for key, value in config.items() if key not in NOT_A_METHOD} for config in configs]
    return name_apart(methods, settings, groups)


def rooms_shown(where: Sequence[NDArray[np.int64]], of_ladder: Sequence[int] = ()) -> list[int]:
    """Figure 5: the rooms that are drawn: the ladder's own, from the top down, then those in which the most executions
    stopped; ``where`` are per option the rooms of its stops, (n,).
    """
    rooms, counts = np.unique(np.concatenate([np.zeros(0, np.int64), *where]), return_counts=True)
    often = rooms[np.argsort(-counts, kind="stable")]
    return [*of_ladder, *(int(room) for room in often if room not in of_ladder)][: max(ROOMS_SHOWN, len(of_ladder))]


def rows(work: Work) -> Iterator[Row]:
    """Spec F3: every member's option on every ladder: where its executions stopped; overlays go to the arrays."""
    picked = by_fields(select(work.rows, quantity=VALIDATED, scope=VALIDATION), "artefact")
    for artefact, source, place in _named(work):
        path, config = work.contents.name(artefact), artefact.config
        choices = picked.get((source,), []) if takes(artefact) else []
        validated = {row.sub_goal: int(row.value) for row in choices if not math.isnan(row.value)}
        executions = Executions.read(artefact.path / "executions.csv")
        if "terminations.h5" in artefact.manifest.files:
            ends = read_terminations(artefact.path / "terminations.h5")
            for option, states in ends.items():
                work.arrays.create_dataset(f"terminations/{path}/{option}", data=overlay(states), compression="gzip")
            every = range(len(config["sub_goals"]) * config["members"])
            work.arrays[f"{STATES}/{path}/counts"] = np.array([len(ends.get(option, ())) for option in every], np.int64)
        more: dict[str, Any] = {"masked": config["mask_reached"], "thresholds": thresholds_of(artefact)}
        more |= {**place, "ladder": config["start"], "seed": artefact.seed, "artefact": path}
        yield from rows_of_ladder(executions, config["sub_goals"], config["members"], validated, **more)
        work.progress.advance()


def view(work: Work) -> dict[str, Any]:
    """Spec F3, F4: ``options`` of each artefact and sub-goal; ``over_ladders``, over seeds; ``shown`` in Figure 5."""
    contents = work.contents
    artefacts = {contents.name(artefact): artefact for artefact in contents.ladders}
    options = options_of(work.rows)
    for entry in options:
        artefact = artefacts[entry["path"]]
        source = Artefact(artefact.input("ensemble")) if takes(artefact) else None
        entry["ensemble"] = source and within(contents, source)
    names = {artefact.config["domain"] for artefact in contents.ladders}
    domain = installed_domain(names.pop()) if len(names) == 1 else None
    used = {entry["ladder"] for entry in options}
    starts = [start for start in (domain.starts if domain else ()) if start in used]
    ladders = [*starts, *sorted(used - set(starts))]
    executions = {path: Executions.read(artefact.path / "executions.csv") for path, artefact in artefacts.items()}
    stops = show_stops(options, ladders, executions, domain, work.arrays)
    return {"distance": {"options": options, "over_ladders": distance_table(work.rows, ladders), "shown": stops}}


def _named(work: Work) -> Iterator[tuple[Artefact, str, dict[str, Any]]]:
    """Each ladder's options, the path of their ensemble, empty where it is not the run's, and its method and N."""
    methods_of = {row.artefact: row.method for row in select(work.rows, scope="unseen")}
    paths, methods, groups = [], [], []
    for artefact in work.contents.ladders:
        source = Artefact(artefact.input("ensemble"))
        paths.append(within(work.contents, source) or "")
        methods.append(methods_of.get(paths[-1], ensemble_name(source.config)) if takes(artefact) else ORACLE)
        groups.append(groups_of(source.config) if takes(artefact) else None)
    names = ladder_names(methods, groups, [artefact.config for artefact in work.contents.ladders])
    for artefact, path, name, number in zip(work.contents.ladders, paths, names, groups, strict=True):
        yield artefact, path, {"method": name, "N": number}


def show_stops(
    rows: Sequence[Mapping[str, Any]],
    ladders: Sequence[str],
    executions: Mapping[str, Executions],
    domain: Domain | None,
    arrays: Any,
) -> list[dict[str, Any]]:
    """Figure 5's material: for each ladder and N the best members' stops of the first seed, and pictures of the rooms.

    Rows are those of :func:`options_of`, ``executions`` by their paths. ``stops/<path>/<option>/{positions,pixels,
    fates}`` and ``pictures/<room>`` are written into ``arrays``. None where the domain has no pictures.
    """
    if domain is None or not domain.pictures:
        return []
    first = min((row["seed"] for row in rows), default=0)
    numbers: list[int | None] = [groups for groups in by_groups(rows) if groups is not None] or [None]
    shown = []
    for ladder, groups in product(ladders, numbers):
        at_start = [row for row in rows if (row["ladder"], row["seed"]) == (ladder, first) and row["best"] is not None]
        beside = [row for row in at_start if row["groups"] == groups or row["method"].startswith(ORACLE)]
        columns, where = [], []
        for row in sorted(beside, key=lambda row: method_rank(row["method"])):
            best = row["options"][row["best"]]
            stops = executions[row["path"]].of(best["option"])
            group = arrays.require_group(f"stops/{row['path']}/{best['option']}")
            if not len(group):  # the oracle's stand beside every N
                group["positions"] = stops.positions()
                group["pixels"] = np.asarray(domain.pixel(stops.positions()), np.float64).reshape(-1, 2)
                group["fates"] = fates(stops)
            columns.append({key: row[key] for key in ("path", "method", "sub_goal")} | best)
            where.append(stops.room)
        if columns:
            place: dict[str, Any] = {"ladder": ladder, "groups": groups, "seed": first}
            shown.append({**place, "rooms": rooms_shown(where, _rooms_of(domain, ladder)), "columns": columns})
    for room in sorted({room for figure in shown for room in figure["rooms"]}):
        arrays[f"pictures/{room}"] = domain.picture(room)
    return shown


def _rooms_of(domain: Domain, ladder: str) -> list[int]:
    rooms = chain.from_iterable(domain.rooms_of(name) for name in ladder.split(","))
    return list(dict.fromkeys(rooms))


def missing(work: Work) -> list[str]:
    """Spec F3, F4: the options that are not there, of a run with ladders."""
    tells = "its domain tells no distance"
    lines = [f"no executions.csv in {work.contents.name(artefact)}: {tells}" for artefact in work.contents.silent]
    options = work.metrics["distance"]["options"]
    if not options:
        return [*lines, "no options artefact of a ladder (Figures 4 and 5)"] if work.metrics["rooms"] else lines
    lines += methods_lacking(options, "options", "Figures 4 and 5")
    oracle = any(row["method"].startswith(ORACLE) for row in options)
    return lines if oracle else [*lines, "no options artefact with oracle terminations beside them"]


PAIRS = Pairs(
    "distance",
    {
        # The best member is the best on the executions that are compared, of more members the better.
        f"distance, {which} member": Number("distance", member=member, higher=False)
        for which, member in (("best", BEST), ("validated", VALIDATED), ("mean", "mean"))
    },
    # Oracle terminations have no N and no members to choose among.
    lambda rows: [row for row in rows if not row.method.startswith(ORACLE)],
    ranked=True,
)


def _group(entry: Entry) -> str:
    return "true sub-goal" if entry["groups"] is None else f"N={entry['groups']}"


STOPPED = tuple(page.number(which, which, page.deviation, 1) for which in PICKED)
SHARED = tuple(page.number(title, f"{share}.mean", page.percent) for share, title in SHARES.items())
SEEDS = page.number("seeds", "seeds")
OVER_LADDERS = (
    page.label("labels", _group, once=True),
    page.label("method", "method"),
    *STOPPED,
    page.number("± exec.", "executions_deviation.mean", page.fixed, 1),
    *SHARED,
    SEEDS,
)


def summary(metrics: Metrics) -> list[Printed]:
    """Figure 4 by method and N."""
    rows = metrics["distance"]["over_ladders"] if metrics["distance"]["options"] else []
    title = "Distance from the true sub-goal where options stop, mean over ladders"
    columns = (page.label("method", page.method_of(rows)), page.number("N", group_name), *STOPPED, SHARED[0])
    return [page.terminal(title, columns, rows)] if rows else []


def sections(material: Material) -> list[Block]:
    """Figures 4 and 5, of a run with ladders."""
    distance = material.metrics["distance"]
    if not distance["options"]:
        return []
    bars, *stops = (page.shown(material, figure) for figure in figures(material))
    text = (
        "Each member's option is learned from the top of a ladder. Its distance is how far, on a way through the "
        "rooms, it stops from the nearest place where the sub-goal holds, such as a ladder's base, over its last "
        f"{LAST} executions; one that begins inside the option's own termination set counts {INSIDE}. Per ladder "
        "the best member, as in the paper, with mean, worst and validated member beside it; then the mean over "
        "ladders. Oracle termination ends options at the true sub-goal: what is left to it is how well "
        "policies were learned."
    )
    rows = _ordered(distance["over_ladders"])
    short = [f"{entry['method']}, {_group(entry)}" for entry in distance["over_ladders"] if entry["incomplete_seeds"]]
    left = f" Seeds that lack a ladder are left out: {'; '.join(short)}." if short else ""
    caption = (
        "Distance of the best, the validated, the mean and the worst member, mean over ladders; mean over seeds ± "
        "standard deviation over seeds. ± exec.: the best member's standard deviation over its last "
        f"{LAST} executions, mean over ladders and seeds. Shares of the best member's executions: at sub-goal, "
        f"within {NEAR} of the true one and not begun inside; inside, begun in its own termination set; timed out; "
        f"died. A death or a time-out there counts as both.{left}"
    )
    pairs = page.comparison_tables(material.comparisons("distance"), "ladder, N and seed")
    table = page.table(OVER_LADDERS, rows, tight=True, caption=caption)
    where = (
        f"The last {LAST} executions of the best member on each ladder, drawn where they stopped; in rooms that are "
        "not drawn none or few did. Circles: at the true sub-goal. Crosses: anywhere else, by the member's own "
        "prediction, out of time, or dead. Squares: executions that began inside the option's own termination set."
    )
    return [
        page.section("distance", "Options on ladders", [text], [bars, table, *pairs]),
        page.section("stops", "Where options stop on the ladders", [where] if distance["shown"] else [], stops),
    ]


def _ordered(rows: Sequence[Entry]) -> list[Entry]:
    """By N, then as they come; those without N last."""
    return sorted(rows, key=lambda entry: (entry["groups"] is None, entry["groups"] or 0))


def figures(material: Material) -> list[Drawn]:
    """Figures 4 and 5."""
    distance, title = material.metrics["distance"], "Figure 5: where executions stopped"
    if not distance["options"]:
        return []
    stops = [_scatter(material, figure, index) for index, figure in enumerate(distance["shown"])]
    return [_bars(material), *(stops or [Drawn("figure5", title, None, missing=NO_PICTURES)])]


def _bars(material: Material) -> Drawn:
    distance, name = material.metrics["distance"], "Figure 4: distance to the true sub-goal"
    rows = [entry for entry in _ordered(distance["over_ladders"]) if entry["best"]["mean"] is not None]
    name_of, bars = page.method_of(distance["options"]), []
    for entry in rows:
        mean, deviation = np.array([entry["best"][key] for key in ("mean", "standard_deviation")], float)
        each = [seed for seed in entry["each_seed"] if seed is not None]
        bars.append((name_of(entry), _group(entry), mean, deviation, each))
    names = list(dict.fromkeys(name for name, *_ in bars if not name.startswith(ORACLE)))
    drawn = distance_bars(bars, names, INSIDE) if bars else None
    seeds = page.spans({row["seed"] for row in distance["options"]})
    runs = f"Ladders: {page.listed(distance['over_ladders'][0]['ladders'])}; seeds: {seeds}."
    caption = (
        "Figure 4 of the paper: distance of the best member of each ladder, mean over ladders; bars: mean over seeds, "
        "whiskers: ± one standard deviation over seeds, dots: each seed. Lower is better. The paper's error bars are "
        "the deviation over the last 100 executions instead: in the table."
    )
    return Drawn("figure4", name, drawn, caption, runs, "No seed has executions on all ladders of the run.")


def _scatter(material: Material, figure: Entry, index: int) -> Drawn:
    columns, notes = [], []
    for column in figure["columns"]:
        place = f"stops/{column['path']}/{column['option']}"
        positions, ends = material.arrays[f"{place}/positions"], material.arrays[f"{place}/fates"]
        columns.append((column["method"], positions[:, 0], material.arrays[f"{place}/pixels"], ends))
        elsewhere = int((~np.isin(positions[:, 0], figure["rooms"])).sum())
        hits, inside = int((ends == HIT).sum()), int((ends == BEGAN_INSIDE).sum())
        more = f", {inside} began inside" if inside else ""
        more += f", {elsewhere} in rooms not drawn" if elsewhere else ""
        notes.append(
            f"{column['method']}: member {column['member']}, {hits} of {len(ends)} at the sub-goal{more}, "
            f"distance {page.fixed(column['distance'], 1)}"
        )
    pictures = [(room, material.arrays[f"pictures/{room}"]) for room in figure["rooms"]]
    groups = "" if figure["groups"] is None else f", {_group(figure)}"
    caption = f"Figure 5 of the paper: ladder {figure['ladder']}{groups}, seed {figure['seed']}. {'. '.join(notes)}."
    return Drawn(
        f"figure5-{figure['ladder']}" + ("" if figure["groups"] is None else f"-N{figure['groups']}"),
        f"Where executions stopped, ladder {figure['ladder']}{groups}",
        stops_over_rooms(pictures, columns),
        caption,
        folded=f"Ladder {figure['ladder']}{groups}" if index else "",
    )


def distance_bars(
    bars: Sequence[tuple[str, str, float, float, Sequence[float]]], names: Sequence[str], inside: float
) -> Figure:
    """Figure 4: the best member's distance; lower is better. A line marks ``inside`` if it is near.

    A bar is method, group, mean, standard deviation (NaN for one seed) and the seeds' own values; groups stand side by
    side. Methods are coloured in the order of ``names``, others grey.
    """
    with drawing(3.1, 2, handlelength=2.6) as (figure, axes):
        groups = grouped(bars, itemgetter(1))
        highest = max((mean + np.nan_to_num(deviation) for _, _, mean, deviation, _ in bars), default=1.0)
        for place, group in enumerate(groups.values()):
            width = min(0.26, 0.84 / len(group))
            for index, (name, _, mean, deviation, seeds) in enumerate(group):
                x = place + (index - (len(group) - 1) / 2) * width
                turn, method = divmod(names.index(name), len(METHOD_COLOURS)) if name in names else (0, -1)
                colour = METHOD_COLOURS[method] if method >= 0 else GREY
                hatch = HATCHES[turn % len(HATCHES)]
                look: dict[str, Any] = {"color": colour, "edgecolor": INK, "linewidth": 0, "alpha": 0.8, "hatch": hatch}
                axes.bar(x, mean, width * 0.92, label=name, **look)
                if np.isfinite(deviation):
                    axes.errorbar(x, mean, deviation, color=INK, capsize=3, linewidth=1.2)
                axes.plot(np.full(len(seeds), x), seeds, ".", color=INK, markersize=5, alpha=0.7)
        if highest > inside / 2:
            axes.axhline(inside, color=GREY, linewidth=1.2, linestyle=":", label="began inside its own termination set")
        axes.set_xticks(range(len(groups)), list(groups))
        axes.set_xlim(-0.6, len(groups) - 0.4)
        axes.grid(visible=False, axis="x")
        axes.set_ylim(0, None)
        axes.set_ylabel("distance to the true sub-goal\n(units of position)")
    return figure


def stops_over_rooms(
    pictures: Sequence[tuple[int, NDArray[np.uint8]]],
    options: Sequence[tuple[str, NDArray[np.int64], NDArray[np.float64], NDArray[np.int64]]],
) -> Figure:
    """Figure 5: a row per option, its rooms side by side; with one room two options in a row.

    What became of an execution is told by shape and by colour. A picture is (room, uint8 (H, W, 3)), an option its
    title and of the stops their rooms (n,), pixels (n, 2) in the pictures and :func:`fates` (n,).
    """
    with styled():
        columns = max(2, len(pictures))
        panels = list(product(options, pictures))
        rows = -(-len(panels) // columns)
        height, width = pictures[0][1].shape[:2]
        wide = (WIDTH - (columns - 1) * GAP) / columns  # inches
        high = wide * height / width
        size = (WIDTH, rows * (high + TITLE) + TITLE)
        figure = Figure(figsize=size)
        for index, ((title, rooms, pixels, ends), (room, picture)) in enumerate(panels):
            row, column = divmod(index, columns)
            left, bottom = column * (wide + GAP), size[1] - (row + 1) * (high + TITLE)
            place = figure.add_axes((left / size[0], bottom / size[1], wide / size[0], high / size[1]))
            place.set_axis_off()
            place.imshow(picture, interpolation="none", aspect="auto")
            for fate, (_, mark) in STOPS.items():
                x, y = pixels[(rooms == room) & (ends == fate)].T
                place.plot(x, y, alpha=0.75, **mark)
            first = room == pictures[0][0]
            name = f"{title}, room {room}" if first else f"room {room}"
            place.set_title(name, pad=3, fontsize=9.5 if columns == 2 else 8)
        handles, labels = [Line2D([], [], **mark) for _, mark in STOPS.values()], [name for name, _ in STOPS.values()]
        figure.legend(handles, labels, loc="lower left", ncols=3, handletextpad=0.2, columnspacing=1.2, borderpad=0)
        return figure


QUESTION = Question(
    rows=rows,
    view=view,
    missing=missing,
    pairs=PAIRS,
    summary=summary,
    sections=sections,
    figures=figures,
    needed={
        "figure4": "options artefacts with executions.csv: train-options with --set start=LADDER",
        "figure5": "options artefacts with executions.csv, of a domain that draws its rooms",
    },
)
