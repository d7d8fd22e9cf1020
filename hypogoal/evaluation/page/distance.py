"""The sections on options that were learned on ladders: Figures 4 and 5."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from hypogoal.evaluation.distance import BEGAN_INSIDE, HIT, INSIDE, LAST, NEAR, ORACLE
from hypogoal.evaluation.ladder_figures import Bar, Stops, distance_bars, stops_over_rooms
from hypogoal.evaluation.page.blocks import (
    Block,
    Material,
    deviation,
    figure,
    fixed,
    interval,
    listed,
    row,
    section,
    table,
)
from hypogoal.evaluation.page.comparisons import comparison_tables
from hypogoal.evaluation.summary import percent

SHARES = {"reached_base": "at base", "inside_at_start": "inside", "timed_out": "timed out", "died": "died"}
NEEDED = "It needs options artefacts with executions.csv: train-options with --set start=LADDER."


def distance_section(material: Material) -> Block:
    """Figure 4: how far from a true base options stop."""
    found = material.metrics["distance"]
    title = "Options on ladders"
    if not found["options"]:
        label = "Figure 4: distance to the nearest true base"
        return section("distance", title, [], [figure(material, "figure4", label, None, missing=NEEDED)])
    text = (
        "Each member's option is learned from the top of a ladder. Its distance is how far, on a way through the "
        f"rooms, it stops from the nearest true base of a ladder, over its last {LAST} executions; an execution that "
        f"begins inside the option's own termination set counts {INSIDE}. Per ladder the best member, as in the paper, "
        "with mean, worst and validated member beside it; then the mean over ladders. Oracle termination ends "
        "options at the true base: what is left to it is how well policies were learned."
    )
    blocks = [_bars(material), _table(found["over_ladders"]), _intervals(found["over_ladders"])]
    digits = {"distance, best member": 1}
    blocks += comparison_tables(material.comparisons("distance"), "ladder, N and seed", digits=digits)
    blocks += [_ladders(found["by_ladder"]), _options(found["options"])]
    return section("distance", title, [text], blocks)


def _names(rows: Sequence[Mapping[str, Any]]) -> list[str]:
    """Methods whose options end at members' verdicts."""
    return list(dict.fromkeys(entry["method"] for entry in rows if not entry["method"].startswith(ORACLE)))


def _group(groups: int | None) -> str:
    return "true sub-goal" if groups is None else f"N={groups}"


def _ordered(rows: Sequence[Mapping[str, Any]]) -> list[Mapping[str, Any]]:
    """By N, then as they come; those without N last."""
    return sorted(rows, key=lambda entry: (entry["groups"] is None, entry["groups"] or 0))


def _bars(material: Material) -> Block:
    found = material.metrics["distance"]
    rows = [entry for entry in _ordered(found["over_ladders"]) if entry["best"]["mean"] is not None]
    bars = []
    for entry in rows:
        wide = entry["best"]["standard_deviation"]
        name = f"{entry['method']} ({entry['sub_goal']})" if _several(found["options"]) else entry["method"]
        values = _seed_means(found["options"], entry)
        bars.append(Bar(name, _group(entry["groups"]), entry["best"]["mean"], np.nan if wide is None else wide, values))
    names = list(dict.fromkeys(bar.name for bar in bars if not bar.name.startswith(ORACLE)))
    drawn = distance_bars(bars, names, INSIDE) if bars else None
    seeds = sorted({one["seed"] for one in found["options"]})
    ladders = found["over_ladders"][0]["ladders"]
    caption = (
        f"Figure 4 of the paper: distance of the best member of each ladder, mean over the ladders {listed(ladders)}; "
        f"bars: mean over seeds ({listed(seeds)}), whiskers: ± one standard deviation over seeds, dots: each seed. "
        "Lower is better. The paper's error bars are the deviation over the last 100 executions instead: in the table."
    )
    missing = "No seed has executions on all ladders of the run."
    return figure(material, "figure4", "Figure 4: distance to the nearest true base", drawn, caption, missing)


def _several(options: Sequence[Mapping[str, Any]]) -> bool:
    return len({one["sub_goal"] for one in options}) > 1


def _seed_means(options: Sequence[Mapping[str, Any]], entry: Mapping[str, Any]) -> list[float]:
    """Each complete seed's mean over ladders of the best member's distance."""
    keys = ("method", "groups", "sub_goal")
    own = [one for one in options if all(one[key] == entry[key] for key in keys) and one["best"] is not None]
    values = []
    for seed in sorted({one["seed"] for one in own} - set(entry["incomplete_seeds"])):
        distances = [one["options"][one["best"]]["distance"] for one in own if one["seed"] == seed]
        if len(distances) == len(entry["ladders"]):
            values.append(float(np.mean(distances)))
    return values


def _table(rows: Sequence[Mapping[str, Any]]) -> Block:
    lines = []
    last: str | None = None
    for entry in _ordered(rows):
        group = _group(entry["groups"])
        lines.append(
            row(
                group if group != last else "",
                entry["method"],
                *(deviation(entry[which], 1) for which in ("best", "validated", "mean", "worst")),
                fixed(entry["executions_deviation"]["mean"], 1),
                *(percent(entry[share]["mean"]) for share in SHARES),
                str(entry["seeds"]),
                mark="first" if group != last else "",
            )
        )
        last = group
    short = [f"{entry['method']}, {_group(entry['groups'])}" for entry in rows if entry["incomplete_seeds"]]
    left = f" Seeds that lack a ladder are left out: {'; '.join(short)}." if short else ""
    return table(
        ("labels", "method", "best", "validated", "mean", "worst", "± exec.", *SHARES.values(), "seeds"),
        lines,
        texts=2,
        tight=True,
        caption="Distance of the best, the validated, the mean and the worst member, mean over ladders; mean "
        "over seeds ± standard deviation over seeds. ± exec.: the best member's standard deviation over its last "
        f"{LAST} executions, mean over ladders and seeds. Shares of the best member's executions: at base, within "
        f"{NEAR} of a true one and not begun inside; inside, begun in its own termination set; timed out; died. A "
        f"death or a time-out at a base counts as both.{left}",
    )


def _intervals(rows: Sequence[Mapping[str, Any]]) -> Block:
    lines = [
        row(
            entry["method"],
            _group(entry["groups"]),
            *(interval(entry[which], 1) for which in ("best", "validated", "mean")),
        )
        for entry in _ordered(rows)
    ]
    return table(
        ("method", "labels", "best", "validated", "mean"),
        lines,
        texts=2,
        tight=True,
        folded="Interquartile means of the distance with intervals",
        caption="Interquartile mean over seeds with its 95 % bootstrap interval; no interval with one seed.",
    )


def _ladders(rows: Sequence[Mapping[str, Any]]) -> Block:
    lines = []
    last = ""
    for ladder in dict.fromkeys(entry["ladder"] for entry in rows):
        for entry in _ordered([one for one in rows if one["ladder"] == ladder]):
            lines.append(
                row(
                    ladder if ladder != last else "",
                    entry["method"],
                    _group(entry["groups"]),
                    *(deviation(entry[which], 1) for which in ("best", "validated", "mean", "worst")),
                    *(percent(entry[share]["mean"]) for share in SHARES),
                    str(entry["seeds"]),
                    mark="first" if ladder != last else "",
                )
            )
            last = ladder
    return table(
        ("ladder", "method", "labels", "best", "validated", "mean", "worst", *SHARES.values(), "seeds"),
        lines,
        texts=3,
        tight=True,
        folded="Every ladder",
        caption="As above, ladder by ladder.",
    )


def _options(rows: Sequence[Mapping[str, Any]]) -> Block:
    lines = []
    for entry in rows:
        for index, option in enumerate(entry["options"]):
            notes = [word for word in ("best", "validated") if entry[word] == index]
            lines.append(
                row(
                    entry["path"] if index == 0 else "",
                    f"{index}{' (' + ', '.join(notes) + ')' if notes else ''}",
                    str(option["executions"]),
                    fixed(option["distance"], 1),
                    fixed(option["executions_deviation"], 1),
                    fixed(option["duration"], 1),
                    *(percent(option[share]) for share in SHARES),
                    mark="first" if index == 0 else "",
                )
            )
    return table(
        ("options", "member", "executions", "distance", "±", "steps", *SHARES.values()),
        lines,
        texts=2,
        tight=True,
        folded=f"Every option of {len(rows)} artefacts",
        caption=f"The last {LAST} executions of each. An option without any was never offered: it would always have "
        f"begun inside its own termination set, and counts {INSIDE}.",
    )


def stops_section(material: Material) -> Block:
    """Figure 5: where on the ladders' rooms the best members' options stopped."""
    found = material.metrics["distance"]
    title = "Where options stop on the ladders"
    if not found["shown"]:
        missing = NEEDED if not found["options"] else "The domain has no pictures of its rooms."
        label = "Figure 5: where executions stopped"
        return section("stops", title, [], [figure(material, "figure5", label, None, missing=missing)])
    text = (
        f"The last {LAST} executions of the best member on each ladder, drawn where they stopped; in rooms that are "
        "not drawn none or few did. Circles: at a true base. Crosses: anywhere else, by the member's own verdict, out "
        "of time, or dead. Squares: executions that began inside the option's own termination set."
    )
    return section("stops", title, [text], [_scatter(material, one, index) for index, one in enumerate(found["shown"])])


def _scatter(material: Material, one: Mapping[str, Any], index: int) -> Block:
    columns, notes = [], []
    for column in one["columns"]:
        place = f"stops/{column['path']}/{column['option']}"
        positions, fates = material.arrays[f"{place}/positions"], material.arrays[f"{place}/fates"]
        columns.append(Stops(column["method"], positions[:, 0], material.arrays[f"{place}/pixels"], fates))
        elsewhere = int((~np.isin(positions[:, 0], one["rooms"])).sum())
        hits, inside = int((fates == HIT).sum()), int((fates == BEGAN_INSIDE).sum())
        more = f", {inside} began inside" if inside else ""
        more += f", {elsewhere} in rooms not drawn" if elsewhere else ""
        notes.append(
            f"{column['method']}: member {column['member']}, {hits} of {len(fates)} at a base{more}, "
            f"distance {fixed(column['distance'], 1)}"
        )
    pictures = [(room, material.arrays[f"pictures/{room}"]) for room in one["rooms"]]
    groups = "" if one["groups"] is None else f", {_group(one['groups'])}"
    name = f"Ladder {one['ladder']}{groups}"
    caption = f"Figure 5 of the paper: ladder {one['ladder']}{groups}, seed {one['seed']}. {'. '.join(notes)}."
    drawn = stops_over_rooms(pictures, columns)
    label = f"Where executions stopped, ladder {one['ladder']}{groups}"
    identity = f"figure5-{one['ladder']}" + ("" if one["groups"] is None else f"-N{one['groups']}")
    return figure(material, identity, label, drawn, caption, folded=name if index else "")
