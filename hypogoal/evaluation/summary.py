"""The metrics as tables for a terminal."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from rich.table import Table


def summary_table(metrics: Mapping[str, Any]) -> Table:
    """Every agent's headline numbers, mean over runs; at most 80 columns wide. See ``quantities.QUANTITIES``."""
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
    if metrics["missing"]:
        table.caption, table.caption_justify = f"In this run: {'; '.join(metrics['missing'])}.", "left"
    return table


def hypotheses_summary(metrics: Mapping[str, Any]) -> Table:
    """Balanced accuracy of the best, mean and worst member on held-out layouts; at most 80 columns wide."""
    table = Table(title="Balanced accuracy on held-out layouts", title_justify="left", width=79)
    table.add_column("ensemble", ratio=1)
    table.add_column("sub-goal", no_wrap=True)
    for heading in ("best", "mean", "worst", "disagree"):
        table.add_column(heading, justify="right", no_wrap=True)
    for row in metrics["hypotheses"]:
        numbers = [number(row[which]["mean"], 3) for which in ("best", "mean", "worst", "disagreement_heldout")]
        table.add_row(row["name"], row["sub_goal"], *numbers)
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
