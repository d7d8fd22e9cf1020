"""What a page and a terminal's tables are made from: results, how numbers are written, templates, pictures.

Every sentence is in ``templates/``; a question gives its template what it computed.
"""

import io
import re
from base64 import b64encode
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field
from functools import cache, cached_property, partial
from hashlib import sha256
from pathlib import Path
from typing import Any

import jinja2
import numpy as np
import pandas as pd
from matplotlib.figure import Figure
from pandas import DataFrame
from rich.console import Console
from rich.table import Table

from hypogoal.core.artefacts import versions
from hypogoal.evaluation import pictures
from hypogoal.evaluation.plots import slug, styled, to_file

WIDTH = 80  # of tables in a terminal
DASH = "–"
TEMPLATES = Path(__file__).with_name("templates")


@dataclass(frozen=True)
class Drawn:
    """A figure, drawn once somebody looks; ``name`` is its file's, and the id on the page."""

    name: str
    label: str  # what it shows
    draw: Callable[[], Figure]
    about: Mapping[str, Any] = field(default_factory=dict)  # for its caption

    @cached_property
    def figure(self) -> Figure:
        """What is drawn."""
        with styled():
            return self.draw()

    @cached_property
    def svg(self) -> bytes:
        """Its file."""
        return to_file(self.figure, "svg")


def fixed(
    value: Any,
    digits: int = 2,
    scale: float = 1.0,
    sign: str = "",
) -> str:
    """A number with a fixed number of decimals; a dash where there is none. ``sign``: as Python formats it."""
    return DASH if pd.isna(value) else f"{scale * value:{sign}.{digits}f}"


def percent(value: Any) -> str:
    """0.953 -> '95 %'."""
    return f"{fixed(value, 0, 100)} %"


def between(
    low: Any,
    high: Any,
    *how: Any,
) -> str:
    """An interval; nothing where there is none. ``how``, here and below: digits and scale, see :func:`fixed`."""
    return "" if pd.isna(low) else f" [{fixed(low, *how)}, {fixed(high, *how)}]"


def mean(row: Any, *how: Any) -> str:
    """The mean."""
    return fixed(row["mean"], *how)


def spread(
    row: Any,
    *how: Any,
    error: str = "standard_error",
) -> str:
    """The mean and, where there are several values, beside it their standard error."""
    around = "" if pd.isna(row[error]) else f" ± {fixed(row[error], *how)}"
    return mean(row, *how) + around


deviation = partial(spread, error="standard_deviation")  # beside the mean the standard deviation over seeds


def bounded(row: Any, *how: Any) -> str:
    """The mean of shares or the median of all else, and its 95 % interval."""
    return fixed(row["estimate"], *how) + between(row["low"], row["high"], *how)


def counted(row: Any) -> str:
    """How many runs there are."""
    return str(row["n"])


def displayed(
    table: DataFrame,
    by: dict[str, str],
    columns: Mapping[str, Any],
) -> DataFrame:
    """A table of :func:`statistics.over` as people read it: a row for each combination of ``by``, with titles.

    ``columns`` are by title a quantity, and a function that writes a row's statistics with its further arguments.
    Labels that are the same everywhere are left out but the method's.
    """
    names = [name for name in by if name == "method" or table[name].nunique(dropna=False) > 1]
    shown = table[names].drop_duplicates()
    for title, (quantity, show, *how) in columns.items():
        rows = table[table["quantity"] == quantity]
        if not rows.empty:
            texts = rows.apply(show, axis=1, args=how)
            shown = shown.merge(
                rows[names].assign(**{title: texts}),
                on=names,
                how="left",
            )
    shown = shown.astype(object).fillna(DASH)
    return shown.rename(columns=by).set_index([by[name] for name in names])


def rows_of(frame: DataFrame) -> list[list[str]]:
    """The rows of a displayed table, labels first, see :func:`sparse`."""
    rows = frame.reset_index(allow_duplicates=True)
    return sparse(rows.to_numpy(), frame.index.nlevels)


def sparse(rows: Any, labels: int) -> list[list[str]]:
    """Rows as texts; so many ``labels`` of each but the last are left out where they are as in the row above."""
    table = DataFrame(rows).map(str)
    first = table.iloc[:, : labels - 1]
    repeated = first.eq(first.shift()).cummin(axis=1)
    table[first.columns] = first.mask(repeated, "")
    return table.to_numpy().tolist()


def terminal(title: str, frame: DataFrame, note: str | None = None) -> Table:
    """A displayed table for a terminal, 80 columns wide: of its first columns as many as fit, means alone.

    ``note``: what stands below it.
    """
    frame = frame.map(lambda text: re.split(r" ±| \[", text)[0])
    labels = min(40, max(len(" | ".join(map(str, np.atleast_1d(key)))) for key in frame.index))
    wide = [3 + max(len(str(name)), *map(len, frame[name])) for name in frame]
    frame = frame.loc[:, labels + 4 + np.cumsum(wide) <= WIDTH]  # with the borders of the labels
    printed = Table(title=title, title_justify="left", caption=note, caption_justify="left", width=WIDTH)
    for name in frame.index.names:
        printed.add_column(str(name), overflow="fold")
    for name in frame.columns:
        printed.add_column(str(name), justify="right", no_wrap=True)
    for row in rows_of(frame):
        printed.add_row(*row)
    return printed


def plain(tables: Any) -> list[str]:
    """Tables for a terminal as lines of plain text, the same on every machine; brackets are no mark-up."""
    console = Console(
        width=WIDTH,
        record=True,
        file=io.StringIO(),
        markup=False,
        emoji=False,
        highlight=False,
        force_jupyter=False,
    )
    console.print(tables)
    return [line.rstrip() for line in console.export_text().splitlines()]


def listed(items: Iterable[Any]) -> str:
    """1, 2 and 3."""
    texts = [str(item) for item in items]
    if len(texts) < 2:
        return texts[0] if texts else "none"
    return f"{', '.join(texts[:-1])} and {texts[-1]}"


def spans(numbers: Iterable[int]) -> str:
    """Seeds in order, three and more in a row as '970 to 972'."""
    values = np.unique([*numbers])
    gaps = np.flatnonzero(np.diff(values) > 1)
    texts = []
    for row in np.split(values, gaps + 1):
        texts += [f"{row[0]} to {row[-1]}"] if len(row) > 2 else [*row]
    return listed(texts)


def picture(image: Any) -> str:
    """An observation uint8 (H, W, C) as the source of an ``img``, see :func:`pictures.encoded`."""
    return source(pictures.encoded(image), "webp")


def source(data: bytes, kind: str) -> str:
    """A picture's file as the source of an ``img``."""
    return f"data:image/{kind};base64,{b64encode(data).decode()}"


def digest(text: str) -> str:
    """A script or a style of the page, as a browser's policy names it."""
    hashed = sha256(text.encode()).digest()
    return f"'sha256-{b64encode(hashed).decode()}'"


@cache
def templates(folder: Path) -> jinja2.Environment:
    """All templates; they may call whatever is in this module. Pages escape every text but our style and script."""
    environment = jinja2.Environment(
        loader=jinja2.FileSystemLoader(folder),
        autoescape=jinja2.select_autoescape(),
        undefined=jinja2.StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    environment.globals |= globals() | {"version": versions().get("hypogoal", "unknown")}
    return environment


def words_of(context: Mapping[str, Any]) -> Any:
    """What a question's template sets, and its macros; figures are not drawn for it."""
    template = templates(TEMPLATES).get_template(f"{context['name']}.html")
    return template.make_module(
        {
            **context,
            "figures": [],
        }
    )


def render(template: str, /, **context: Any) -> str:
    """A template's text. A page, of ``title`` and ``sections``, is one HTML file that needs nothing else.

    A section is what its template is given, with ``name``, its id, ``title``, and whether it is ``folded``;
    ``template``: where that is not called as the section.
    """
    return templates(TEMPLATES).get_template(template).render(context)


def lines_of(template: str, /, **context: Any) -> list[str]:
    """What a template of lines says."""
    return [line for line in render(template, **context).splitlines() if line]


def write(folder: Path, text: str, figures: Iterable[Drawn]) -> None:
    """Write a page, ``index.html``, and those of the figures that are drawn in it as files beside it."""
    (folder / "index.html").write_text(text, encoding="utf-8")
    (folder / "figures").mkdir()
    for drawn in figures:
        if "svg" not in vars(drawn):  # nobody has looked at it
            continue
        path = folder / "figures" / f"{slug(drawn.name)}.svg"
        path.write_bytes(drawn.svg)
