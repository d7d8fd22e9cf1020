"""What a page and a terminal's tables are made from: results, how numbers are written, templates, pictures (Spec F7).

Every sentence is in ``templates/``; a question gives its template what it computed.
"""

import base64
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property, partial
from hashlib import sha256
from pathlib import Path
from typing import Any

import jinja2
import numpy as np
import pandas as pd
from markupsafe import Markup
from matplotlib.figure import Figure
from numpy.typing import NDArray
from rich.table import Table

from hypogoal.core.artefacts import versions
from hypogoal.evaluation.house import BOOTSTRAP_FROM
from hypogoal.evaluation.pictures import encoded
from hypogoal.evaluation.plots import to_file

WIDTH = 80  # of tables in a terminal
DASH = "–"
TEMPLATES = Path(__file__).with_name("templates")
# What a browser may do with the page: run our own script, show pictures that are in it.
POLICY = (
    "default-src 'none'; script-src {script}; style-src {style}; img-src data:; base-uri 'none'; form-action 'none'"
)
Show = Callable[[Any], str]  # of a row of ``house.over``


@dataclass(frozen=True)
class Drawn:
    """A figure; ``name`` is its file's, and the id on the page."""

    name: str
    label: str  # what it shows
    figure: Figure
    about: Mapping[str, Any] = field(default_factory=dict)  # for its caption

    @cached_property
    def svg(self) -> bytes:
        """Its file."""
        return to_file(self.figure, "svg")


@dataclass(frozen=True)
class Results:
    """An evaluated run: what ``numbers.csv``, ``run.json`` and ``arrays.h5`` hold."""

    numbers: pd.DataFrame
    facts: Mapping[str, Any]
    arrays: Mapping[str, NDArray[Any]] = field(default_factory=dict)

    def of(self, **fields: Any) -> pd.DataFrame:
        """The numbers whose columns have these values; a list: any of them."""
        rows = self.numbers
        for name, value in fields.items():
            rows = rows[rows[name].isin(value if isinstance(value, list) else [value])]
        return rows

    def within(self, folder: str) -> dict[str, NDArray[Any]]:
        """The arrays of a folder, by their names in it."""
        start = f"{folder}/"
        return {name.removeprefix(start): values for name, values in self.arrays.items() if name.startswith(start)}


def fixed(value: Any, digits: int = 2, scale: float = 1.0) -> str:
    """A number with a fixed number of decimals; a dash where there is none."""
    return DASH if pd.isna(value) else f"{scale * value:.{digits}f}"


def percent(value: Any) -> str:
    """0.953 -> '95 %'; a dash where there is none."""
    return DASH if pd.isna(value) else f"{100 * value:.0f} %"


def between(low: Any, high: Any, digits: int, scale: float = 1.0) -> str:
    """An interval; nothing where there is none."""
    return "" if pd.isna(low) else f" [{scale * low:.{digits}f}, {scale * high:.{digits}f}]"


def mean(digits: int = 2, scale: float = 1.0) -> Show:
    """Writes the mean."""
    return lambda row: fixed(row["mean"], digits, scale)


def spread(digits: int = 2, scale: float = 1.0, error: str = "standard_error") -> Show:
    """Writes the mean and, where there are several values, beside it their standard error."""

    def show(row: Any) -> str:
        wide = row[error]
        around = "" if pd.isna(wide) else f" ± {scale * wide:.{digits}f}"
        return fixed(row["mean"], digits, scale) + around

    return show


deviation = partial(spread, error="standard_deviation")  # beside the mean the standard deviation over seeds


def bounded(digits: int = 2, scale: float = 1.0) -> Show:
    """Writes the mean or the interquartile mean, whichever the 95 % interval beside it is of."""

    def show(row: Any) -> str:
        value = row["mean"] if row["units"] < BOOTSTRAP_FROM else row["iqm"]
        return fixed(value, digits, scale) + between(row["low"], row["high"], digits, scale)

    return show


def counted(row: Any) -> str:
    """Writes how many runs there are."""
    return str(row["n"])


def displayed(
    table: pd.DataFrame,
    by: Mapping[str, str],
    columns: Mapping[str, tuple[str, Show]],
) -> pd.DataFrame:
    """A table of :func:`house.over` as people read it: a row for each combination of ``by``, whose titles it gives.

    ``columns`` are by title a quantity and how its statistics are written. Labels that are
    the same everywhere are left out but the method's.
    """
    names = [name for name in by if name == "method" or table[name].nunique(dropna=False) > 1]
    shown = table[names].drop_duplicates()
    for title, (quantity, show) in columns.items():
        rows = table[table["quantity"] == quantity]
        texts = rows[names].assign(**{title: [show(row) for _, row in rows.iterrows()]})
        if len(texts):
            shown = shown.merge(texts, on=names, how="left")
    shown = shown.astype(object).where(shown.notna(), DASH)
    return shown.rename(columns=dict(by)).set_index([by[name] for name in names])


def pairs_displayed(pairs: pd.DataFrame, digits: Mapping[str, int]) -> pd.DataFrame:
    """Pairs of :func:`house.pairs` as people read them; ``digits`` are a quantity's decimals, else 3."""
    if pairs.empty:
        return pd.DataFrame()
    rows = []
    for _, pair in pairs.iterrows():
        places = digits.get(pair["quantity"], 3)
        difference = DASH if pd.isna(pair["difference"]) else f"{round(pair['difference'], places) + 0.0:+.{places}f}"
        rows.append(
            {
                "quantity": pair["quantity"].replace("_", " ") + ("" if pair["higher"] else " (lower is better)"),
                "N": DASH if pd.isna(pair["N"]) else str(pair["N"]),
                "first": pair["first"],
                "second": pair["second"],
                "P(first better)": fixed(pair["probability"])
                + between(pair["probability_low"], pair["probability_high"], 2),
                "won–lost–tied": f"{pair['wins']}–{pair['n'] - pair['wins'] - pair['ties']}–{pair['ties']}",
                "sign test p": fixed(pair["sign_test"], 3),
                "n": str(pair["units"]),
                "difference": difference + between(pair["difference_low"], pair["difference_high"], places),
            }
        )
    shown = pd.DataFrame(rows)
    if pairs["N"].isna().all():
        del shown["N"]
    return shown.set_index([name for name in ("quantity", "N", "first", "second") if name in shown])


def rows_of(frame: pd.DataFrame) -> Iterable[list[str]]:
    """The rows of a displayed table: labels, left out where they are as in the row above, then numbers."""
    before: tuple[Any, ...] = ()
    for key, numbers in zip(frame.index, frame.to_numpy(), strict=True):
        labels = key if isinstance(key, tuple) else (key,)
        same = 0
        while before and same < len(labels) - 1 and labels[same] == before[same]:
            same += 1
        before = labels
        yield [*[""] * same, *map(str, labels[same:]), *map(str, numbers)]


def terminal(title: str, frame: pd.DataFrame) -> Table:
    """A displayed table for a terminal, 80 columns wide: of its first columns as many as fit, means alone."""
    frame = frame.map(lambda text: text.partition(" ±")[0].partition(" [")[0])
    labels = min(40, max(len(" | ".join(map(str, np.atleast_1d(key)))) for key in frame.index))
    wide = [3 + max(len(str(name)), *map(len, frame[name])) for name in frame]
    frame = frame.loc[:, labels + 4 + np.cumsum(wide) <= WIDTH]  # with the borders of the labels
    printed = Table(title=title, title_justify="left", width=WIDTH)
    for name in frame.index.names:
        printed.add_column(str(name), overflow="fold")
    for name in frame.columns:
        printed.add_column(str(name), justify="right", no_wrap=True)
    for row in rows_of(frame):
        printed.add_row(*row)
    return printed


def listed(items: Iterable[Any]) -> str:
    """1, 2 and 3."""
    texts = [str(item) for item in items]
    if len(texts) < 2:
        return texts[0] if texts else "none"
    return f"{', '.join(texts[:-1])} and {texts[-1]}"


def spans(numbers: Iterable[int]) -> str:
    """Seeds in order, three and more in a row as '970 to 972'."""
    rows: list[list[int]] = []
    for number in sorted(set(numbers)):
        if rows and number == rows[-1][-1] + 1:
            rows[-1].append(number)
        else:
            rows.append([number])
    texts: list[Any] = []
    for row in rows:
        texts += [f"{row[0]} to {row[-1]}"] if len(row) > 2 else row
    return listed(texts)


def picture(image: NDArray[np.uint8]) -> str:
    """An observation as the source of an ``img``; of a stack of grey frames the last."""
    return source(encoded(image), "webp")


def source(data: bytes, kind: str) -> str:
    """A picture's file as the source of an ``img``."""
    return f"data:image/{kind};base64,{base64.b64encode(data).decode('ascii')}"


def svg(drawn: Drawn) -> str:
    """A figure as the source of an ``img``."""
    return source(drawn.svg, "svg+xml")


def packaged(name: str) -> str:
    """The text of a file beside the templates."""
    return (TEMPLATES / name).read_text(encoding="utf-8")


def templates() -> jinja2.Environment:
    """All templates. Every text is escaped but our own style and script."""
    loader = jinja2.FileSystemLoader(TEMPLATES)
    environment = jinja2.Environment(
        loader=loader, autoescape=True, undefined=jinja2.StrictUndefined, trim_blocks=True, lstrip_blocks=True
    )
    tools = (rows_of, listed, spans, picture, svg, fixed, percent, mean, spread, bounded, counted, displayed)
    environment.globals |= {function.__name__: function for function in tools}
    environment.globals |= {"deviation": deviation, "pairs_displayed": pairs_displayed}
    return environment


def section(name: str, context: Mapping[str, Any]) -> Markup:
    """A question's part of a page, from its template."""
    return Markup(templates().get_template(f"{name}.html").render(context))


def module(name: str, context: Mapping[str, Any]) -> Any:
    """What a question's template sets, and its macros."""
    return templates().get_template(f"{name}.html").make_module(dict(context))


def caption(words: Any, drawn: Drawn) -> str:
    """A figure's caption, a macro in its question's template, see :func:`module`."""
    return " ".join(Markup(words.caption(drawn)).unescape().split())


def draw_page(title: str, sections: Sequence[tuple[str, str, Markup, bool]], template: str, **lead: Any) -> str:
    """Sections (id, title, part, folded) as one HTML file that needs nothing else; ``lead``: what stands above them."""
    css, script = packaged("report.css"), packaged("gallery.js")
    policy = POLICY.format(script=_digest(script), style=_digest(css))
    context = {"title": title, "sections": sections, "policy": policy, "css": css, "script": script}
    version = versions().get("hypogoal", "unknown")
    return templates().get_template(template).render(context | lead, version=version)


def _digest(text: str) -> str:
    """A script or a style of the page, as a policy names it."""
    return f"'sha256-{base64.b64encode(sha256(text.encode()).digest()).decode()}'"
