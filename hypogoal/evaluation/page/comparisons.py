"""Tables of one method against the others, pair by pair (Spec F5)."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from operator import itemgetter
from typing import Any

from hypogoal.evaluation.page.blocks import Block, cell, fixed, row, table

CAPTION = (
    "Pairs of runs that share {shared}. P: the probability of improvement, the share of pairs in which the first is "
    "better, a tie counting half, with its 95 % bootstrap interval (2,000 resamples {drawn}); 0.5: neither is. An "
    "interval without width means that every pair came out alike, not that it is certain: see the sign test "
    "(two-sided, ties left out) and over how many {units} it is, each of which counts once, by its mean: pairs of one "
    "are not independent. Difference: mean of first − second, with its 95 % interval."
)


def comparison_tables(
    rows: Sequence[Mapping[str, Any]], shared: str, units: str = "seeds", digits: Mapping[str, int] | None = None
) -> list[Block]:
    """The table, where there are pairs.

    Args:
        rows: what ``evaluation/comparisons.py`` found.
        shared, units: what pairs share, and what is independent of each other.
        digits: decimals of a quantity's difference, 3 where it is not named.
    """
    pairs = [entry for entry in rows if entry["n"]]
    if not pairs:
        return []
    firsts = {entry["first"] for entry in pairs}
    texts: dict[str, Callable[[Mapping[str, Any]], str]] = {
        "quantity": _quantity,
        "of": itemgetter("where"),
        "first": itemgetter("first"),
    }
    shown = [name for name in texts if {"of": any(map(texts["of"], pairs)), "first": len(firsts) > 1}.get(name, True)]
    lines: list[dict[str, Any]] = []
    last: tuple[str, ...] | None = None
    for entry in pairs:
        key = tuple(texts[name](entry) for name in shown)
        places = max((digits or {}).get(entry["quantity"], 3), 1)  # a difference may be small where the numbers are not
        lines.append(
            row(
                *(key if key != last else [""] * len(key)),
                entry["second"],
                cell(fixed(entry["probability"], 2), _between(entry["interval"], 2)),
                f"{entry['wins']}–{entry['n'] - entry['wins'] - entry['ties']}–{entry['ties']}",
                cell(fixed(entry["sign_test"], 3), f"n = {entry['units']}"),
                cell(_signed(entry["difference"], places), _between(entry["difference_interval"], places)),
                mark="first" if key != last else "",
            )
        )
        last = key
    numbers = ("P(first better)", "won–lost–tied", "sign test p", "difference")
    title = f"Seed by seed: {firsts.pop()} against the others" if len(firsts) == 1 else "Seed by seed"
    return [
        table(
            (*shown, "second", *numbers),
            lines,
            texts=len(shown) + 1,
            tight=True,
            heading=title,
            caption=CAPTION.format(
                shared=shared,
                units=units,
                drawn="within layouts where each has several" if units == "layouts" else "of seeds",
            ),
        )
    ]


def _quantity(entry: Mapping[str, Any]) -> str:
    name = str(entry["quantity"]).replace("_", " ")
    return name if entry["higher"] else f"{name} (lower is better)"


def _between(bounds: Sequence[float | None], digits: int) -> str:
    low, high = bounds
    return "" if low is None or high is None else f"[{low:.{digits}f}, {high:.{digits}f}]"


def _signed(value: float | None, digits: int) -> str:
    return "–" if value is None else f"{round(value, digits) + 0.0:+.{digits}f}"  # + 0.0: no "-0"
