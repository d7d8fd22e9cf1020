"""What a page and a terminal's tables are made from: results, how numbers are written, templates, pictures.

Every sentence is in ``templates/``. A question gives its template the numbers that it computed.
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

WIDTH = 80  # columns of a table in a terminal
DASH = "–"
TEMPLATES = Path(__file__).with_name("templates")


@dataclass(frozen=True)
class Drawn:
    """A figure, which is drawn when somebody looks at it. ``name`` is the name of its file, and its id on the page."""

    name: str
    label: str  # what the figure shows
    draw: Callable[[], Figure]
    about: Mapping[str, Any] = field(default_factory=dict)  # for the caption

    @cached_property
    def figure(self) -> Figure:
        """The figure, drawn."""
        with styled():
            return self.draw()

    @cached_property
    def svg(self) -> bytes:
        """The figure's SVG file."""
        return to_file(self.figure, "svg")


def fixed(
    value: Any,
    digits: int = 2,
    scale: float = 1.0,
    sign: str = "",
) -> str:
    """Return ``scale * value`` with ``digits`` decimals, or a dash if ``value`` is missing.

    ``sign`` is Python's format of a sign.
    """
    return DASH if pd.isna(value) else f"{scale * value:{sign}.{digits}f}"


def percent(value: Any) -> str:
    """Return a share as a percentage: 0.953 gives '95 %'."""
    return f"{fixed(value, 0, 100)} %"


def between(
    low: Any,
    high: Any,
    *how: Any,
) -> str:
    """Return an interval in brackets, or an empty text if ``low`` is missing.

    ``how``, here and in the functions below: the digits and the scale, see :func:`fixed`.
    """
    return "" if pd.isna(low) else f" [{fixed(low, *how)}, {fixed(high, *how)}]"


def mean(row: Any, *how: Any) -> str:
    """Return the mean of a row of statistics."""
    return fixed(row["mean"], *how)


def spread(
    row: Any,
    *how: Any,
    error: str = "standard_error",
) -> str:
    """Return the mean and, if a row has several values, their standard error beside it."""
    around = "" if pd.isna(row[error]) else f" ± {fixed(row[error], *how)}"
    return mean(row, *how) + around


deviation = partial(spread, error="standard_deviation")  # the mean with the standard deviation over seeds


def bounded(row: Any, *how: Any) -> str:
    """Return the estimate of a row, the mean of shares or the median of all else, with its 95 % interval."""
    return fixed(row["estimate"], *how) + between(row["low"], row["high"], *how)


def counted(row: Any) -> str:
    """Return how many runs a row has."""
    return str(row["n"])


def displayed(
    table: DataFrame,
    by: dict[str, str],
    columns: Mapping[str, Any],
) -> DataFrame:
    """Return a table of :func:`statistics.over` as people read it: a row for each combination of ``by``, with titles.

    ``columns`` are, by title, a quantity and a function that writes a row's statistics, with the further arguments of
    the function. A label that has one value in all rows is left out, except the method.
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
    """Return the rows of a displayed table, labels first, see :func:`sparse`."""
    rows = frame.reset_index(allow_duplicates=True)
    return sparse(rows.to_numpy(), frame.index.nlevels)


def sparse(rows: Any, labels: int) -> list[list[str]]:
    """Return rows as texts. A label that repeats the row above is empty.

    The first ``labels`` columns are labels; the last label is always written.
    """
    table = DataFrame(rows).map(str)
    first = table.iloc[:, : labels - 1]
    repeated = first.eq(first.shift()).cummin(axis=1)
    table[first.columns] = first.mask(repeated, "")
    return table.to_numpy().tolist()


def terminal(title: str, frame: DataFrame, note: str | None = None) -> Table:
    """Return a displayed table for a terminal, 80 columns wide.

    The table has as many of the first columns as fit, and means without what is beside them. ``note`` stands below it.
    """
    frame = frame.map(lambda text: re.split(r" ±| \[", text)[0])
    labels = min(40, max(len(" | ".join(map(str, np.atleast_1d(key)))) for key in frame.index))
    wide = [3 + max(len(str(name)), *map(len, frame[name])) for name in frame]
    frame = frame.loc[:, labels + 4 + np.cumsum(wide) <= WIDTH]  # 4 columns are the borders of the labels
    printed = Table(title=title, title_justify="left", caption=note, caption_justify="left", width=WIDTH)
    for name in frame.index.names:
        printed.add_column(str(name), overflow="fold")
    for name in frame.columns:
        printed.add_column(str(name), justify="right", no_wrap=True)
    for row in rows_of(frame):
        printed.add_row(*row)
    return printed


def plain(tables: Any) -> list[str]:
    """Return tables for a terminal as lines of plain text, which do not depend on the machine.

    Brackets in the tables are no mark-up.
    """
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
    """Return the items as a list in words, such as '1, 2 and 3'. Without items, return 'none'."""
    texts = [str(item) for item in items]
    if len(texts) < 2:
        return texts[0] if texts else "none"
    return f"{', '.join(texts[:-1])} and {texts[-1]}"


def spans(numbers: Iterable[int]) -> str:
    """Return seeds in order, in words. Three or more in a row are written as '970 to 972'."""
    values = np.unique([*numbers])
    gaps = np.flatnonzero(np.diff(values) > 1)
    texts = []
    for row in np.split(values, gaps + 1):
        texts += [f"{row[0]} to {row[-1]}"] if len(row) > 2 else [*row]
    return listed(texts)


def picture(image: Any) -> str:
    """Return an observation, uint8 (H, W, C), as the source of an ``img``, see :func:`pictures.encoded`."""
    return source(pictures.encoded(image), "webp")


def source(data: bytes, kind: str) -> str:
    """Return the content of a picture's file as the source of an ``img``."""
    return f"data:image/{kind};base64,{b64encode(data).decode()}"


def digest(text: str) -> str:
    """Return the hash by which a browser's content policy allows a script or a style of the page."""
    hashed = sha256(text.encode()).digest()
    return f"'sha256-{b64encode(hashed).decode()}'"


@cache
def templates(folder: Path) -> jinja2.Environment:
    """Return the environment of all templates, which may call whatever is in this module.

    Pages escape every text except our style and script.
    """
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
    """Return what a question's template sets, and its macros. No figures are drawn for this."""
    template = templates(TEMPLATES).get_template(f"{context['name']}.html")
    return template.make_module(
        {
            **context,
            "figures": [],
        }
    )


def render(template: str, /, **context: Any) -> str:
    """Return the text of a template. A page, of ``title`` and ``sections``, is one HTML file that needs nothing else.

    A section is what its template is given, with ``name`` (its id), ``title``, and whether it is ``folded``. If a
    section's template does not have the section's name, ``template`` names it.
    """
    return templates(TEMPLATES).get_template(template).render(context)


def lines_of(template: str, /, **context: Any) -> list[str]:
    """Return the lines of a template's text that are not empty."""
    return [line for line in render(template, **context).splitlines() if line]


def write(folder: Path, text: str, figures: Iterable[Drawn]) -> None:
    """Write a page, ``index.html``, and beside it a file of each figure that was drawn in the page."""
    (folder / "index.html").write_text(text, encoding="utf-8")
    (folder / "figures").mkdir()
    for drawn in figures:
        if "svg" not in vars(drawn):  # the page did not draw the figure
            continue
        path = folder / "figures" / f"{slug(drawn.name)}.svg"
        path.write_bytes(drawn.svg)
