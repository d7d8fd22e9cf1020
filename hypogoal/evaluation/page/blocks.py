"""What a page is made of: plain dictionaries that the template draws."""

from __future__ import annotations

import base64
import json
import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray

from hypogoal.evaluation.figures import COLOURS, slug, to_svg
from hypogoal.evaluation.pictures import image_png, reduced

Block = dict[str, Any]


@dataclass(frozen=True)
class Material:
    """What a page is made from.

    Attributes:
        metrics: what ``metrics.json`` holds.
        arrays: what ``arrays.h5`` holds, by name.
        figures: filled while the page is made, to be written as files too; ``drawings`` with their SVG.
    """

    metrics: Mapping[str, Any]
    arrays: Mapping[str, NDArray[Any]]
    figures: dict[str, Figure] = field(default_factory=dict)
    drawings: dict[str, str] = field(default_factory=dict)

    def agents(self) -> list[Mapping[str, Any]]:
        """Every agent's numbers, in the report's order."""
        return list(self.metrics["agents"])

    def comparisons(self, of: str) -> list[Mapping[str, Any]]:
        """One method against the others; none in evaluations from before there were any."""
        return list(self.metrics.get("comparisons", {}).get(of, ()))


def section(
    identity: str,
    title: str,
    paragraphs: Iterable[str],
    blocks: Iterable[Block],
    missing: Iterable[str] = (),
) -> Block:
    """A section of the page."""
    return {
        "id": identity,
        "title": title,
        "paragraphs": [text for text in paragraphs if text],
        "blocks": list(blocks),
        "missing": list(missing),
    }


def table(
    columns: Sequence[str],
    rows: Sequence[Mapping[str, Any]],
    *,
    texts: int = 1,
    caption: str = "",
    heading: str = "",
    folded: str = "",
    wrap: bool = False,
    tight: bool = False,
) -> Block:
    """A table; the first ``texts`` columns are text, the others numbers.

    Long texts are broken where ``wrap``; columns are nearer to each other where ``tight``.
    """
    named = [{"name": name, "number": index >= texts} for index, name in enumerate(columns)]
    return {
        "kind": "table",
        "columns": named,
        "rows": list(rows),
        "caption": caption,
        "heading": heading,
        "folded": folded,
        "class": "wrap" if wrap else "tight" if tight else "",
    }


def row(*cells: Any, mark: str = "") -> dict[str, Any]:
    """A row of a table; a cell is text or made by :func:`cell`."""
    return {"cells": list(cells), "mark": mark}


def cell(text: str, small: str = "", mark: str = "") -> dict[str, str]:
    """A cell with a small remark beside its text."""
    return {"text": text, "small": small, "class": mark}


def figure(
    material: Material,
    name: str,
    label: str,
    drawn: Figure | None,
    caption: str = "",
    missing: str = "",
    folded: str = "",
) -> Block:
    """A figure, or what it would have needed.

    Args:
        material: the figure is added to its ``figures``.
        name: its :func:`slug` is the file's name and the id on the page.
        label: what it shows.
        drawn: None where it cannot be drawn.
        caption: with seeds and intervals.
        missing: which artefact would be needed.
        folded: what is shown of it until asked for.
    """
    name, svg = slug(name), ""
    if drawn is not None:
        material.figures[name] = drawn
        svg = material.drawings[name] = to_svg(drawn, name)
        svg = re.sub(r"<style.*?</style>", "", svg, flags=re.S)  # the page allows its own alone, which says the same
        for colour, variable in COLOURS.items():
            svg = svg.replace(colour, f"var(--{variable})")
    return {
        "kind": "figure",
        "id": f"figure-{name}",
        "label": label,
        "svg": svg,
        "caption": caption,
        "missing": missing,
        "folded": folded,
    }


def pick(rows: Iterable[Mapping[str, Any]], key: str, value: Any) -> Mapping[str, Any]:
    """The first of the rows with this value.

    Raises:
        LookupError: none has it.
    """
    for one in rows:
        if one[key] == value:
            return one
    raise LookupError(f"nothing whose {key!r} is {value!r}")


def picture(image: NDArray[np.uint8]) -> str:
    """An observation as base64 PNG, see :func:`reduced`; of a stack (H, W, C) with C other than 3 the last frame."""
    if image.ndim == 3 and image.shape[2] != 3:
        image = image[..., -1]
    return base64.b64encode(image_png(reduced(image))).decode("ascii")


def texts(packed: Any) -> list[str]:
    """A JSON list of texts out of the arrays."""
    raw = packed.item() if isinstance(packed, np.ndarray) else packed
    return list(json.loads(raw.decode() if isinstance(raw, bytes) else raw))


def facts(folded: str, rows: Iterable[tuple[str, str]], *, heading: str = "", opened: bool = False) -> Block:
    """A list of names and texts, folded until asked for."""
    return {"kind": "facts", "folded": folded, "rows": list(rows), "heading": heading, "open": opened}


def listed(items: Sequence[Any]) -> str:
    """1, 2 and 3."""
    texts = [str(item) for item in items]
    return texts[0] if len(texts) == 1 else f"{', '.join(texts[:-1])} and {texts[-1]}" if texts else "none"


def fixed(value: float | None, digits: int) -> str:
    """A number with a fixed number of decimals; a dash where there is none."""
    return "–" if value is None else f"{value:.{digits}f}"


def spread(aggregated: Mapping[str, Any], digits: int, scale: float = 1.0) -> dict[str, str]:
    """Mean, and beside it the standard error where there are several runs."""
    mean, error = aggregated["mean"], aggregated["standard_error"]
    if mean is None:
        return cell("–")
    return cell(fixed(scale * mean, digits), f"± {scale * error:.{digits}f}" if error is not None else "")


def deviation(aggregated: Mapping[str, Any], digits: int, scale: float = 1.0) -> dict[str, str]:
    """Mean, and beside it the standard deviation over seeds where there are several."""
    mean, wide = aggregated["mean"], aggregated["standard_deviation"]
    if mean is None:
        return cell("–")
    return cell(fixed(scale * mean, digits), f"± {scale * wide:.{digits}f}" if wide is not None else "")


def interval(aggregated: Mapping[str, Any], digits: int, scale: float = 1.0) -> str:
    """Interquartile mean and its 95 % interval."""
    if aggregated["iqm"] is None:
        return "–"
    low, high = aggregated["interval"]
    around = "" if low is None else f" [{scale * low:.{digits}f}, {scale * high:.{digits}f}]"
    return f"{scale * aggregated['iqm']:.{digits}f}{around}"
