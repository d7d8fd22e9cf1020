"""The metrics as tables for a terminal."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any

from rich.console import Group
from rich.table import Table


def summary_table(metrics: Mapping[str, Any]) -> Table | Group:
    """The headline numbers of a run, mean over seeds; at most 80 columns wide. See ``quantities.QUANTITIES``.

    A table for each kind of thing that there is: ensembles, options on ladders, agents.
    """
    tables = []
    if metrics["rooms"]:
        tables.append(rooms_summary(metrics))
    if metrics["hypotheses"]:
        tables.append(hypotheses_summary(metrics))
    if metrics["distance"]["options"]:
        tables.append(distance_summary(metrics))
    if metrics["agents"] or not tables:
        tables.append(agents_summary(metrics))
    if metrics["missing"]:
        last = tables[-1]
        last.caption, last.caption_justify = f"In this run: {'; '.join(metrics['missing'])}.", "left"
    return tables[0] if len(tables) == 1 else Group(*tables)


def agents_summary(metrics: Mapping[str, Any]) -> Table:
    """Every agent's headline numbers, mean over runs; at most 80 columns wide."""
    table = Table(title="Training episodes, the last 100 of each run", title_justify="left", width=79)
    table.add_column("agent", ratio=1)
    for heading in ("runs", "success", "length", "x shortest", "95 % at"):
        table.add_column(heading, justify="right", no_wrap=True)
    for agent in metrics["agents"]:
        table.add_row(
            agent["name"],
            str(len(agent["runs"])),
            percent(agent["success"]["mean"]),
            number(agent["length"]["mean"], 0),
            number(agent["length_over_shortest"]["mean"], 1),
            solved(agent["steps_to_95"]),
        )
    return table


def rooms_summary(metrics: Mapping[str, Any]) -> Table:
    """Figure 3 by method and N: on unseen rooms, and the paper's number; at most 80 columns wide."""
    title = "Balanced accuracy on unseen rooms; the best member's accuracy on all rooms"
    table = Table(title=title, title_justify="left", width=79)
    table.add_column("method", ratio=1)
    for heading in ("N", "best", "validated", "mean", "worst", "acc., all", "seeds"):
        table.add_column(heading, justify="right", no_wrap=True)
    several = len({row["sub_goal"] for row in metrics["rooms"]}) > 1
    for row in metrics["rooms"]:
        unseen = row["scores"]["unseen"]["balanced_accuracy"]
        table.add_row(
            f"{row['method']} ({row['sub_goal']})" if several else row["method"],
            "–" if row["groups"] is None else str(row["groups"]),
            *(number(unseen[which]["mean"], 2) for which in ("best", "validated", "mean", "worst")),
            number(row["scores"]["all"]["accuracy"]["best"]["mean"], 2),
            str(row["ensembles"]),
        )
    return table


def distance_summary(metrics: Mapping[str, Any]) -> Table:
    """Figure 4: by ladder and N the best member's distance and the mean one's, a column per method; at most 80 wide."""
    found = metrics["distance"]
    methods = list(dict.fromkeys(_method(row, found["over_ladders"]) for row in found["over_ladders"]))
    title = "Distance from a true base where options stop: best member (mean member)"
    table = Table(title=title, title_justify="left", width=79)
    table.add_column("ladder", no_wrap=True)
    table.add_column("N", no_wrap=True)
    for method in methods:
        table.add_column(method, justify="right", ratio=1)

    def add(name: str, rows: Sequence[Mapping[str, Any]], shown: Callable[[Mapping[str, Any]], str]) -> None:
        numbers = sorted({row["groups"] for row in rows if row["groups"] is not None}) or [None]
        for groups in numbers:
            own = {_method(row, found["over_ladders"]): row for row in rows if row["groups"] in (groups, None)}
            cells = [shown(own[method]) if method in own else "–" for method in methods]
            table.add_row(name, "–" if groups is None else str(groups), *cells)
            name = ""

    for ladder in dict.fromkeys(row["ladder"] for row in found["by_ladder"]):
        here = [row for row in found["by_ladder"] if row["ladder"] == ladder]
        add(ladder, here, _best_and_mean)
    table.add_section()
    add("mean", found["over_ladders"], _best_and_mean)
    add("at base, best", found["over_ladders"], lambda row: percent(row["reached_base"]["mean"]))
    return table


def _best_and_mean(row: Mapping[str, Any]) -> str:
    best, mean = (number(row[which]["mean"], 0) for which in ("best", "mean"))
    return f"{best} ({mean})"


def _method(row: Mapping[str, Any], rows: Sequence[Mapping[str, Any]]) -> str:
    """A method, with its sub-goal where there are several."""
    several = len({one["sub_goal"] for one in rows}) > 1
    return f"{row['method']} ({row['sub_goal']})" if several else str(row["method"])


def hypotheses_summary(metrics: Mapping[str, Any]) -> Table:
    """Balanced accuracy of the best, mean and worst member on held-out states; at most 80 columns wide."""
    title = "Balanced accuracy on held-out states: best, mean and worst member"
    table = Table(title=title, title_justify="left", width=79)
    table.add_column("method", ratio=1, overflow="fold")
    table.add_column("sub-goal", ratio=1, overflow="fold")
    for heading in ("best", "mean", "worst", "disagree"):
        table.add_column(heading, justify="right", no_wrap=True)
    before = None
    for row in metrics["hypotheses"]:
        if before not in (None, row["name"]):
            table.add_section()
        numbers = [number(row[which]["mean"], 3) for which in ("best", "mean", "worst", "disagreement_heldout")]
        table.add_row("" if row["name"] == before else row["name"], row["sub_goal"], *numbers)
        before = row["name"]
    return table


def percent(value: float | None) -> str:
    """0.953 -> '95 %'; a dash for None."""
    return "–" if value is None else f"{100 * value:.0f} %"


def number(value: float | None, digits: int) -> str:
    """A number with a fixed number of decimals; a dash for None."""
    return "–" if value is None else f"{value:.{digits}f}"


def thousands(value: float | None) -> str:
    """123456 -> '123 k'; a dash for None."""
    return "–" if value is None else f"{value / 1000:.0f} k"


def solved(steps: Mapping[str, Any]) -> str:
    """When 95 % were reached: the median over runs, or how many of them did."""
    if steps["reached"] == steps["n"]:
        return thousands(steps["median"])
    if steps["reached"] == 0:
        return "never"
    return f"{steps['reached']} of {steps['n']}"
