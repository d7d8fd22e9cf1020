"""Spec H1: the benchmark's table, and a page that shows what each member owns and the states it is surest of."""

import dataclasses
from collections.abc import Iterable, Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from rich.table import Table

from hypogoal.core.artefacts import versions
from hypogoal.core.files import replace_text
from hypogoal.evaluation import page
from hypogoal.evaluation.numbers import grouped, student_interval
from hypogoal.evaluation.pictures import image_png
from hypogoal.evaluation.plots import INK, drawing, slug
from hypogoal.which_feature import scores
from hypogoal.which_feature.run import Cell, WhichFeatureConfig, copies, shared
from hypogoal.which_feature.states import crossed_states

TITLE = "WhichFeature"
PAPER = "white"  # text on dark colours of a heat map


@dataclasses.dataclass(frozen=True)
class Line:
    """What the seeds of one entry at one mix came to; each number as a float (seeds,), see :func:`summary`."""

    entry: str
    mix: float
    coverage: NDArray[np.float64]
    best: NDArray[np.float64]
    same: NDArray[np.float64]
    gap: NDArray[np.float64]
    labels: NDArray[np.float64]


def summary(cells: Iterable[Cell], high: float, low: float) -> list[Line]:
    """Entries, mix by mix, those that cover most first; ``high`` and ``low`` are of ``scores.owned``.

    For each entry and mix, by seed: coverage; the highest ranking of a factor by any member, mean over factors;
    redundancy; calibration gap; labels needed, mean over the factors that are covered (NaN without any).
    """
    lines = []
    for (mix, entry), some in grouped(cells, lambda cell: (cell.mix, cell.entry)).items():
        by_seed = []
        for cell in sorted(some, key=lambda cell: cell.seed):
            ranked, covered = cell.ranking, scores.owned(cell.ranking, high, low).any(axis=0)
            gap = scores.calibration_gap(ranked, cell.balanced_accuracy, cell.at_best)
            labels = float(cell.labels[covered].mean()) if covered.any() else np.nan
            by_seed.append((covered.mean(), ranked.max(axis=0).mean(), scores.redundancy(ranked), gap, labels))
        lines.append(Line(entry, mix, *np.array(by_seed, dtype=np.float64).T))
    return sorted(lines, key=lambda line: (line.mix, -line.coverage.mean(), -line.best.mean(), line.entry))


def told(values: NDArray[np.float64]) -> str:
    """Mean and Student's 95 % interval over seeds; fewer than three are shown one by one; a dash for none."""
    known = values[~np.isnan(values)]
    if len(known) < 3:
        return ", ".join(f"{value:.2f}" for value in known) or "–"
    low, high = student_interval(known)
    return f"{known.mean():.2f} ± {(high - low) / 2:.2f}"


def _mean(values: NDArray[np.float64]) -> str:
    known = values[~np.isnan(values)]
    return f"{known.mean():.2f}" if len(known) else "–"


COLUMNS = (
    page.label("entry", lambda line: line.entry),
    page.number("mix", lambda line: line.mix, "{:g}".format),
    page.number("seeds", lambda line: len(line.coverage)),
    page.number("coverage", lambda line: line.coverage, told),
    page.number("best", lambda line: line.best, _mean),
    page.number("same", lambda line: line.same, _mean),
    page.number("gap", lambda line: line.gap, _mean),
    page.number("labels", lambda line: line.labels, _mean),
)


def table_of(cells: Iterable[Cell], config: WhichFeatureConfig) -> Table:
    """The table for a terminal."""
    return page.terminal(TITLE, COLUMNS, summary(cells, config.high, config.low))


def write(path: Path, cells: Sequence[Cell], config: WhichFeatureConfig) -> None:
    """The page: the table, and of each entry what its members own, in the cell whose mix is nearest to 0.5."""
    material = page.Material({}, {})
    caption = (
        f"Coverage: the share of features that some member ranks by (at least {config.high:g}) while it ranks by no "
        f"other (at most {config.low:g}); mean and Student's 95 % interval over seeds, fewer than three one by one. "
        "Best: the highest ranking of a feature, mean over features. Same: the share of pairs of members with the same "
        "best feature. Gap: what the threshold of 0.5 costs in balanced accuracy. Labels: needed until the right "
        "member is known, mean over the features that are covered."
    )
    table = page.table(COLUMNS, summary(cells, config.high, config.low), caption=caption)
    sections = [page.section("summary", "What is covered", [], [table])]
    for entry, some in grouped(cells, lambda cell: cell.entry).items():
        cell = min(some, key=lambda cell: (abs(cell.mix - 0.5), cell.seed))
        paragraphs = [f"Mix {cell.mix:g}, seed {cell.seed}."]
        sections.append(page.section(slug(entry), entry, paragraphs, _members(material, cell, config.factors)))
    settings = [(name, str(value)) for name, value in shared(config).items()]
    sections.append(page.section("settings", "Settings", [], [page.facts("What all entries share", settings)]))
    version = versions().get("hypogoal", "unknown")
    replace_text(path, page.draw_page(TITLE, "Features planted, found or not", sections, version))


def _members(material: page.Material, cell: Cell, names: Sequence[str]) -> list[page.Block]:
    """Each member's ranking of each factor as a heat map, and the test states that it is surest of."""
    members, factors = cell.ranking.shape
    with drawing(0.6 + 0.35 * members, 1) as (figure, axes):
        axes.imshow(cell.ranking, vmin=0.0, vmax=1.0, cmap="PuOr", aspect="auto")
        axes.set_xticks(range(factors), names)
        axes.set_yticks(range(members), [f"member {member}" for member in range(members)])
        axes.grid(visible=False)
        for member, factor in np.ndindex(members, factors):
            value = cell.ranking[member, factor]
            colour = INK if 0.2 < value < 0.8 else PAPER
            axes.text(factor, member, f"{value:.2f}", ha="center", va="center", color=colour)
    label = f"What members of {cell.entry} rank by"
    caption = "Area under the ROC curve of each feature on states in which all features are crossed; 0.5 is chance."
    drawn = page.Drawn(f"owned-{cell.entry}", label, figure, caption)
    states = crossed_states(copies(names), cell.seed, names).observations[..., -3:]

    def square(member: int, side: int) -> dict[str, str]:
        upper, lower = states[cell.surest[member, side]].reshape(2, 2, *states.shape[1:])
        picture = np.vstack([np.hstack(list(upper)), np.hstack(list(lower))])
        return {"png": page.encoded(image_png(picture)), "alt": f"states that member {member} is surest of"}

    columns = (
        page.label("member", str),
        page.label("surest yes", lambda member: square(member, 0)),
        page.label("surest no", lambda member: square(member, 1)),
    )
    return [page.shown(material, drawn), page.table(columns, range(members))]
