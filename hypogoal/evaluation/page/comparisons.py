"""Tables of one method against the others, pair by pair (Spec F5)."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from hypogoal.evaluation.page.blocks import Block, cell, fixed, row, table

CAPTION = (
    "Pairs of runs that share {shared}. Probability: the share of pairs in which the first is better, a tie counting "
    "half, with its 95 % bootstrap interval (2,000 resamples, within {strata} where each has several); 0.5: neither "
    "is. An interval without width means that every pair came out alike, not that it is certain: see the number of "
    "pairs and the sign test (two-sided, ties left out). Difference: mean of first − second, with its 95 % interval."
)


def comparison_tables(
    rows: Sequence[Mapping[str, Any]], shared: str, strata: str, digits: Mapping[str, int] | None = None
) -> list[Block]:
    """The table, where there are pairs.

    Args:
        rows: what ``evaluation/comparisons.py`` found.
        shared, strata: what pairs share, and within what they are drawn.
        digits: decimals of a quantity's difference, 3 where it is not named.
    """
    lines: list[dict[str, Any]] = []
    last: tuple[str, str] | None = None
    for entry in rows:
        if not entry["n"]:
            continue
        key = (entry["quantity"], entry["where"])
        places = (digits or {}).get(entry["quantity"], 3)
        better = "" if entry["higher"] else " (lower is better)"
        lines.append(
            row(
                f"{entry['quantity']}{better}" if key != last else "",
                entry["where"] if key != last else "",
                entry["first"] if key != last else "",
                entry["second"],
                cell(fixed(entry["probability"], 2), _between(entry["interval"], 2)),
                f"{entry['wins']}–{entry['n'] - entry['wins'] - entry['ties']}–{entry['ties']}",
                fixed(entry["sign_test"], 3),
                cell(_signed(entry["difference"], places), _between(entry["difference_interval"], places)),
                mark="first" if key != last else "",
            )
        )
        last = key
    if not lines:
        return []
    if not any(line["cells"][1] for line in lines):
        lines = [{**line, "cells": [line["cells"][0], *line["cells"][2:]]} for line in lines]
        columns: tuple[str, ...] = ("quantity", "first", "second")
    else:
        columns = ("quantity", "of", "first", "second")
    numbers = ("probability of improvement", "won–lost–tied", "sign test p", "difference")
    caption = CAPTION.format(shared=shared, strata=strata)
    return [
        table(
            (*columns, *numbers),
            lines,
            texts=len(columns),
            tight=True,
            heading="Seed by seed against the first",
            caption=caption,
        )
    ]


def _between(bounds: Sequence[float | None], digits: int) -> str:
    low, high = bounds
    return "" if low is None or high is None else f"[{low:.{digits}f}, {high:.{digits}f}]"


def _signed(value: float | None, digits: int) -> str:
    return "–" if value is None else f"{value:+.{digits}f}"
