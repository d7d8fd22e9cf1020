"""The kit of pages: sections made of blocks, plain dictionaries that a template draws (Spec F7).

A table is said once, as columns, and drawn here for the page and for the terminal.
"""

import base64
import json
import re
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from hashlib import sha256
from importlib import resources
from typing import Any, NamedTuple

import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray
from rich.table import Table

from hypogoal.core.errors import UserError
from hypogoal.evaluation.judging import Judgement, Work
from hypogoal.evaluation.numbers import STUDENT
from hypogoal.evaluation.pictures import STATES, image_png, reduced
from hypogoal.evaluation.plots import COLOURS, slug, to_svg
from hypogoal.evaluation.table import EVALUATE_AGAIN, Pairs, Row

Block = dict[str, Any]
WIDTH = 79  # of tables in a terminal
Entry = Mapping[str, Any]
# What a browser may do with the page. Attributes of style are matplotlib's; they run and fetch nothing.
POLICY = (
    "default-src 'none'; script-src {script}; style-src-elem {style}; style-src-attr 'unsafe-inline'; "
    "img-src data:; base-uri 'none'; form-action 'none'"
)
CAPTION = (
    "Pairs of runs that share {shared}. P: the probability of improvement, the share of pairs in which the first is "
    "better, a tie counting half, with its 95 % interval (Student's t, cut at 0 and 1); 0.5: neither is. An interval "
    "without width means that every pair came out alike, not certainty: see the sign test (two-sided, ties left out). "
    "n: how many {units} everything is over, each of which counts once, by its mean. Difference: mean of first − "
    "second, with its 95 % interval (Student's t)."
)
DIGITS = {"length": 0, "success": 2, "near": 2, "distance, best member": 1}  # decimals of a difference; else 3
INTERVALS = (
    "95 % intervals: of 2 to 7 {units} the mean and Student's t; of more the interquartile mean and a bootstrap (2,000 "
    "resamples); of one there is none."
)


@dataclass(frozen=True)
class Material:
    """What a page is made from."""

    metrics: Mapping[str, Any]  # what ``metrics.json`` holds
    arrays: Mapping[str, NDArray[Any]]  # what ``arrays.h5`` holds, by name
    # Filled while the page is made, to be written as files too.
    figures: dict[str, Figure] = field(default_factory=dict)
    drawings: dict[str, str] = field(default_factory=dict)  # the figures' SVG
    films: Sequence[Block] = ()  # of episodes, see :func:`film`

    def comparisons(self, name: str) -> list[Entry]:
        """One method against the others."""
        return list(self.metrics["comparisons"][name])

    def within(self, folder: str) -> dict[str, NDArray[Any]]:
        """The arrays of a folder, by their names in it."""
        start = f"{folder}/"
        return {name.removeprefix(start): values for name, values in self.arrays.items() if name.startswith(start)}

    def termination_states(self, path: str, option: int) -> tuple[NDArray[np.uint8] | None, str]:
        """The states in which an option of an artefact ends, as an overlay, and how many; None and "" if unknown."""
        image, counts = self.arrays.get(f"terminations/{path}/{option}"), self.arrays.get(f"{STATES}/{path}/counts")
        if image is None or counts is None:
            return image, ""
        return image, f"{counts[option]:,} state{'' if counts[option] == 1 else 's'}"

    def of_numbers(self) -> bool:
        """Whether observations are no pictures."""
        return any(name.startswith("saliency/") and name.endswith("/features") for name in self.arrays)

    def of_ladders(self) -> bool:
        """Whether the run has anything of labelled ladders."""
        return bool(self.metrics["rooms"] or self.metrics["distance"]["options"])

    def of_agents(self) -> bool:
        """Whether it has agents; one with neither, an ensemble alone, say, is taken for one whose are still to come."""
        return bool(self.metrics["agents"]) or not self.of_ladders()


@dataclass(frozen=True)
class Drawn:
    """A figure, or what it would have needed."""

    name: str  # the file's name in a report, and the id on the page
    label: str  # what it shows
    figure: Figure | None  # None where it cannot be drawn
    caption: str = ""  # with intervals
    runs: str = ""  # and seeds that it is of, a list that may be long
    missing: str = ""  # which artefact would be needed
    folded: str = ""  # what is shown of it on the page until asked for
    file: str = ""  # the file's name among the paper's figures, where that is another
    heading: str = ""  # above it on the page

    @property
    def stem(self) -> str:
        """The file's name among the paper's figures, without its ending."""
        return self.file or self.name


class Column(NamedTuple):
    """A column of tables: its title, a row's cell, whether it is a number, and of what it is shown once only."""

    title: str
    of: Callable[[Any], Any]
    number: bool = False
    once: Callable[[Any], Any] | None = None


def label(title: str, key: Any, *, once: Any = None) -> Column:
    """A column of text; ``key`` is the entry's key, several with dots between, or a function of the entry.

    A cell is left empty where ``once`` of the entry, or with True the cell itself, is what it was in the row above.
    """
    content = key if callable(key) else partial(at, key=key)
    return Column(title, content, once=content if once is True else once)


def number(title: str, key: Any, show: Callable[..., Any] = str, *more: Any) -> Column:
    """A column of numbers: ``show(what the entry has there, *more)``; key as of :func:`label`."""
    content = label(title, key).of
    return Column(title, lambda entry: show(content(entry), *more), True)


def at(entry: Any, key: str) -> Any:
    """``entry["a"]["b"]`` for ``a.b``; None where the entry is None."""
    for part in key.split("."):
        entry = None if entry is None else entry[part]
    return entry


def table(
    columns: Sequence[Column],
    entries: Iterable[Any],
    *,
    caption: str = "",
    heading: str = "",
    folded: str = "",
    wrap: bool = False,
    tight: bool = False,
    main: Callable[[Any], bool] = lambda entry: False,
) -> Block:
    """A table for the page: a row per entry.

    Long texts are broken where ``wrap``; columns are nearer to each other where ``tight``; ``main`` rows stand out.
    """
    rows: list[dict[str, Any]] = []
    before: list[Any] = [rows] * len(columns)  # which no entry has
    for entry in entries:
        now = [column.once and column.once(entry) for column in columns]
        fresh = [column.once is None or mark != old for column, mark, old in zip(columns, now, before, strict=True)]
        cells = [column.of(entry) if new else "" for column, new in zip(columns, fresh, strict=True)]
        first = any(new and column.once for column, new in zip(columns, fresh, strict=True))
        rows.append({"cells": cells, "mark": "main" if main(entry) else "first" if first else ""})
        before = now
    return {
        "kind": "table",
        "columns": [{"name": column.title, "number": column.number} for column in columns],
        "rows": rows,
        "caption": caption,
        "heading": heading,
        "folded": folded,
        "class": "wrap" if wrap else "tight" if tight else "",
    }


def terminal(title: str, columns: Sequence[Column], entries: Iterable[Any]) -> Table:
    """The same table for a terminal, 79 columns wide; a line between groups of rows."""
    printed = Table(title=title, title_justify="left", width=WIDTH)
    for column in columns:
        how: dict[str, Any] = (
            {"justify": "right", "no_wrap": True} if column.number else {"ratio": 1, "overflow": "fold"}
        )
        printed.add_column(column.title, **how)
    for index, row in enumerate(table(columns, entries)["rows"]):
        if index and row["mark"]:
            printed.add_section()
        printed.add_row(*(str(cell["text"] if isinstance(cell, dict) else cell) for cell in row["cells"]))
    return printed


def section(
    identity: str,
    title: str,
    paragraphs: Iterable[str],
    blocks: Iterable[Block],
    missing: Iterable[str] = (),
    *,
    folded: bool = False,
) -> Block:
    """A section of the page; until asked for only its title where ``folded``."""
    return {
        "id": identity,
        "title": title,
        "paragraphs": [text for text in paragraphs if text],
        "blocks": list(blocks),
        "missing": list(missing),
        "folded": folded,
    }


def shown(material: Material, drawn: Drawn) -> Block:
    """A figure on the page; it is added to the material's ``figures`` by the :func:`slug` of its name."""
    name, svg = slug(drawn.name), ""
    if drawn.figure is not None:
        material.figures[name] = drawn.figure
        svg = material.drawings[name] = to_svg(drawn.figure, name)
        svg = re.sub(r"<style.*?</style>", "", svg, flags=re.S)  # the page allows its own alone, which says the same
        for colour, variable in COLOURS.items():
            svg = svg.replace(colour, f"var(--{variable})")
    texts = {key: getattr(drawn, key) for key in ("label", "caption", "runs", "missing", "folded", "heading")}
    return {"kind": "figure", "id": f"figure-{name}", "svg": svg, **texts}


def pick(rows: Iterable[Entry], key: str, value: Any) -> Entry:
    """The first of the rows with this value; a ``LookupError`` where none has it."""
    for row in rows:
        if row[key] == value:
            return row
    raise LookupError(f"nothing whose {key!r} is {value!r}")


def picture(image: NDArray[np.uint8]) -> str:
    """An observation as base64 PNG, see :func:`reduced`; of a stack (H, W, C) with C other than 3 the last frame."""
    if image.ndim == 3 and image.shape[2] != 3:
        image = image[..., -1]
    return encoded(image_png(reduced(image)))


def film(gif: bytes, caption: str) -> Block:
    """A moving picture."""
    return {"kind": "film", "gif": encoded(gif), "caption": caption}


def encoded(png: bytes) -> str:
    """A picture's file as base64."""
    return base64.b64encode(png).decode("ascii")


def texts(packed: Any) -> list[str]:
    """A JSON list of texts out of the arrays."""
    raw = packed.item() if isinstance(packed, np.ndarray) else packed
    try:
        return list(json.loads(raw))
    except (ValueError, TypeError) as error:
        raise UserError(f"a list of texts is damaged ({error})", None, EVALUATE_AGAIN) from None


def method_of(entries: Sequence[Entry]) -> Callable[[Entry], str]:
    """An entry's method, with its sub-goal where the entries are of several."""
    several = len({entry["sub_goal"] for entry in entries}) > 1
    return lambda entry: f"{entry['method']} ({entry['sub_goal']})" if several else str(entry["method"])


def facts(folded: str, rows: Iterable[tuple[str, str]], *, heading: str = "") -> Block:
    """A list of names and texts, folded until asked for."""
    return {"kind": "facts", "folded": folded, "rows": list(rows), "heading": heading}


def cell(text: str, small: str = "") -> dict[str, str]:
    """A cell with a small remark beside its text."""
    return {"text": text, "small": small, "class": ""}


def listed(items: Sequence[Any]) -> str:
    """1, 2 and 3."""
    texts = [str(item) for item in items]
    return texts[0] if len(texts) == 1 else f"{', '.join(texts[:-1])} and {texts[-1]}" if texts else "none"


def spans(numbers: Iterable[int]) -> str:
    """Seeds in order, three and more in a row as '970 to 972'."""
    rows: list[list[int]] = []
    for seed in sorted(numbers):
        if rows and seed == rows[-1][-1] + 1:
            rows[-1].append(seed)
        else:
            rows.append([seed])
    return listed([text for row in rows for text in (row if len(row) < 3 else [f"{row[0]} to {row[-1]}"])])


def fixed(value: float | None, digits: int) -> str:
    """A number with a fixed number of decimals; a dash where there is none."""
    return "–" if value is None else f"{value:.{digits}f}"


def percent(value: float | None) -> str:
    """0.953 -> '95 %'; a dash for None."""
    return "–" if value is None else f"{100 * value:.0f} %"


def thousands(value: float | None) -> str:
    """123456 -> '123 k'; a dash for None."""
    return "–" if value is None else f"{value / 1000:.0f} k"


def spread(aggregated: Entry | None, digits: int, scale: float = 1.0, error: str = "standard_error") -> dict[str, str]:
    """Mean, and beside it the standard error where there are several runs; a dash where there is none."""
    if aggregated is None or aggregated["mean"] is None:
        return cell("–")
    mean, wide = aggregated["mean"], aggregated.get(error)
    return cell(fixed(scale * mean, digits), "" if wide is None else f"± {scale * wide:.{digits}f}")


deviation = partial(spread, error="standard_deviation")  # mean, and beside it the standard deviation over seeds


def interval(aggregated: Entry | None, digits: int, scale: float = 1.0) -> str:
    """The mean or the interquartile mean, whichever the 95 % interval beside it is of."""
    if aggregated is None or aggregated["iqm"] is None:
        return "–"
    value = aggregated["mean" if STUDENT in aggregated["interval_over"] else "iqm"]
    low, high = aggregated["interval"]
    around = "" if low is None else f" [{scale * low:.{digits}f}, {scale * high:.{digits}f}]"
    return f"{scale * value:.{digits}f}{around}"


def verdict(probability: float, says: bool, truth: bool) -> dict[str, str]:
    """A member's prediction on a card: marked where it is wrong."""
    prediction = label_of(says)
    return {"class": prediction if says == truth else "wrong", "text": f"{prediction} {probability:.2f}"}


def label_of(positive: bool) -> str:
    """A label or a prediction in words."""
    return "positive" if positive else "negative"


def comparison_tables(
    rows: Sequence[Entry], shared: str, units: str = "seeds", digits: Mapping[str, int] = DIGITS
) -> list[Block]:
    """The table of one method against the others, pair by pair, where there are pairs (Spec F5).

    Rows are of ``numbers.pairs``. ``shared``: what pairs share; ``units``: what is independent; ``digits``: decimals.
    """
    compared = [entry for entry in rows if entry["n"]]
    if not compared:
        return []
    firsts = {entry["first"] for entry in compared}
    names = ["quantity"]
    names += ["where"] if any(entry["where"] for entry in compared) else []
    names += ["first"] if len(firsts) > 1 else []

    def quantity(entry: Entry) -> str:
        return str(entry["quantity"]).replace("_", " ") + ("" if entry["higher"] else " (lower is better)")

    def difference(entry: Entry) -> dict[str, str]:
        places = max(digits.get(entry["quantity"], 3), 1)  # may be small where the numbers are not
        value = entry["difference"]
        signed = "–" if value is None else f"{round(value, places) + 0.0:+.{places}f}"  # + 0.0: no "-0"
        return cell(signed, _between(entry["difference_interval"], places))

    titles = {"quantity": ("quantity", quantity), "where": ("of", "where"), "first": ("first", "first")}
    columns = [
        *(label(*titles[name], once=lambda entry: [entry[key] for key in names]) for name in names),
        label("second", "second"),
        number("P(first better)", lambda e: cell(fixed(e["probability"], 2), _between(e["interval"], 2)), dict),
        number("won–lost–tied", lambda e: f"{e['wins']}–{e['n'] - e['wins'] - e['ties']}–{e['ties']}"),
        number("sign test p", lambda e: cell(fixed(e["sign_test"], 3), f"n = {e['units']}"), dict),
        number("difference", difference, dict),
    ]
    caption = CAPTION.format(shared=shared, units=units)
    title = f"Seed by seed: {firsts.pop()} against the others" if len(firsts) == 1 else "Seed by seed"
    return [table(columns, compared, tight=True, heading=title, caption=caption)]


def _between(bounds: Sequence[float | None], digits: int) -> str:
    low, high = bounds
    return "" if low is None or high is None else f"[{low:.{digits}f}, {high:.{digits}f}]"


def draw_page(
    title: str, subtitle: str, sections: Sequence[Block], version: str, lead: Mapping[str, Any] | None = None
) -> str:
    """Sections as one HTML file that needs nothing else; ``lead``: task, verdict, baselines and films above.

    Every text is escaped but our own style and script and matplotlib's drawings; the page's policy lets nothing else
    run or be fetched.
    """
    import jinja2

    loader = jinja2.PackageLoader("hypogoal.evaluation", "templates")
    environment = jinja2.Environment(loader=loader, autoescape=True, undefined=jinja2.StrictUndefined)
    css, script = packaged("templates/report.css"), packaged("templates/explorer.js")
    return environment.get_template("report.html").render(
        title=title,
        subtitle=subtitle,
        version=version,
        policy=POLICY.format(script=_digest(script), style=_digest(css)),
        css=css,
        script=script,
        sections=sections,
        lead=lead or {},
        footer=f"Made by hypogoal {version}. This page is one file and needs no network.",
    )


def packaged(name: str) -> str:
    """The text of a file that comes with the evaluation."""
    return resources.files("hypogoal.evaluation").joinpath(name).read_text(encoding="utf-8")


def _digest(text: str) -> str:
    """A script or a style of the page, as a policy names it."""
    return f"'sha256-{base64.b64encode(sha256(text.encode()).digest()).decode()}'"


@dataclass(frozen=True)
class Question:
    """One question of the paper, whole: its rows, and all that derives from them. Unused fields keep these defaults."""

    # The rows of one sub-goal's members, as each ensemble is judged.
    look: Callable[[Work, Judgement], Iterable[Row]] = lambda work, judgement: ()
    rows: Callable[[Work], Iterable[Row]] = lambda work: ()  # all others; earlier ones are in ``work.rows``
    view: Callable[[Work], dict[str, Any]] = lambda work: {}  # its parts of ``metrics.json``, made from ``work.rows``
    pairs: Pairs | None = None  # which methods are compared with each other
    missing: Callable[[Work], list[str]] = lambda work: []  # a line for everything that the run has no artefacts for
    # Unit and meaning of its quantities, if they are not in ``quantities.toml``.
    meanings: Mapping[str, tuple[str, str]] = field(default_factory=dict)
    summary: Callable[[Entry], list[Table]] = lambda metrics: []  # tables for a terminal
    sections: Callable[[Material], list[Block]] = lambda material: []  # those that the run has anything for
    figures: Callable[[Material], Iterable[Drawn]] = lambda material: ()  # for a paper
    needed: Mapping[str, str] = field(default_factory=dict)  # what each figure needs, by its name
