"""The tables of the result pages, from the cells.

    python -m studies.pages

A page says with ``<!-- NAME N -->`` where table N (from 0) of those stands that the study of the CSV ``NAME`` prints;
what follows the mark is written anew.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable, Iterator
from functools import cache
from itertools import groupby
from pathlib import Path

from studies import (
    attention,
    audits,
    choosing,
    coverage,
    distilled,
    figure6,
    hypotheses,
    ladder_options,
    ladder_stops,
    ladders,
    misgeneralise,
    misgeneralise_agents,
    one_room,
    symbols,
    two_factors,
    weight,
    weight_elsewhere,
)

RESULTS = Path(__file__).resolve().parents[1] / "docs" / "results"
PAGES = sorted(RESULTS.glob("*.md"))
TABLES: dict[str, Callable[[Path], Iterator[str]]] = {
    "audit-planted": audits.tables,
    "choosing-doorkey": choosing.tables,
    "coverage": coverage.tables,
    "distilled": distilled.tables,
    "distilled-agents": distilled.tables_of_agents,
    "figure2-ladders": attention.tables,
    "figure3-ladders": ladders.tables,
    "figure4-ladders": ladder_options.tables,
    "figure5-ladders": ladder_stops.tables,
    "figure6-doorkey": figure6.tables,
    "hypotheses-doorkey": hypotheses.tables,
    "misgeneralise": misgeneralise.tables,
    "misgeneralise-agents": misgeneralise_agents.tables,
    "options-that-hold": one_room.tables,
    "preference-doorkey": choosing.tables,
    "rooms": choosing.rooms,
    "symbols": symbols.tables,
    "two-factors": two_factors.tables,
    "weight": weight.tables,
    "weight-elsewhere": weight_elsewhere.tables,
}
MARKED = re.compile(r"<!-- ([\w-]+) (\d+) -->\n(?:\|.*\n)*")


def tables_in(lines: Iterable[str]) -> list[list[str]]:
    """The tables among lines of Markdown, each as its lines."""
    blocks = groupby(lines, key=lambda line: line.startswith("|"))
    return [list(block) for is_table, block in blocks if is_table]


@cache
def tables_of(name: str) -> list[list[str]]:
    """The tables that the study of a CSV prints."""
    return tables_in(TABLES[name](RESULTS / f"{name}.csv"))


def drawn(page: str) -> str:
    """A page with its tables as the cells have them."""

    def with_table(mark: re.Match[str]) -> str:
        name, number = mark.groups()
        tables = tables_of(name)
        return "\n".join([f"<!-- {name} {number} -->", *tables[int(number)], ""])

    return MARKED.sub(with_table, page)


def main() -> None:
    """Write the tables of every page that has marks."""
    for path in PAGES:
        page = path.read_text(encoding="utf-8")
        path.write_text(drawn(page), encoding="utf-8")


if __name__ == "__main__":
    main()
