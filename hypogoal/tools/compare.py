"""Spec F5, F7: several evaluated runs side by side, as one page and its numbers."""

import json
from collections.abc import Sequence
from pathlib import Path

from hypogoal.core.artefacts import create, versions
from hypogoal.core.errors import UserError
from hypogoal.evaluation import compare as beside
from hypogoal.evaluation.page import Material, draw_page
from hypogoal.evaluation.run import evaluation_of, fitting, read_evaluation
from hypogoal.evaluation.table import read_rows


def compare(runs: Sequence[Path], out: Path, *, force: bool = False) -> Path:
    """Compare evaluated runs, the others with the first, in an artefact with ``figures/*.svg``; returns its page.

    Fewer than two runs, one twice, or runs that were not evaluated or cannot be compared are a ``UserError``.
    """
    where = " ".join(map(str, runs))
    places = {run.resolve() for run in runs}
    if len(places) < max(2, len(runs)):
        raise UserError("a comparison takes two or more different runs", where, "Name each run once.")
    inputs = [evaluation_of(run).path for run in runs]
    with create(
        out,
        kind="comparison",
        config={},
        seed=0,
        inputs=inputs,
        force=force,
    ) as draft:
        labels = beside.labels_of([run.resolve().as_posix() for run in runs])
        metrics, arrays, rows = {}, {}, {}
        for label, run in zip(labels, runs, strict=True):
            evaluation = read_evaluation(run, "curves/")
            metrics[label] = evaluation.metrics
            arrays[label] = evaluation.arrays
            rows[label] = read_rows(evaluation.source.path / "numbers.csv")
        with fitting(where):
            reason = beside.why_not(metrics)
            if reason is not None:
                do = "Choose runs of one experiment, evaluated alike."
                raise UserError("these runs cannot be compared", reason, do)
            comparison = beside.comparison_of(runs, metrics, rows)
            material = Material(comparison, {})
            sections = beside.compared_sections(
                metrics,
                arrays,
                comparison,
                material,
            )
            version = versions().get("hypogoal", "unknown")
            subtitle = f"{', '.join(labels)}; hypogoal {version}"
            page = draw_page(f"hypogoal: {len(runs)} runs compared", subtitle, sections, version)
        text = json.dumps(comparison, indent=1, allow_nan=False)
        (draft.files / "index.html").write_text(page, encoding="utf-8")
        (draft.files / "metrics.json").write_text(text + "\n", encoding="utf-8")
        figures = draft.files / "figures"
        figures.mkdir()
        for name, drawing in material.drawings.items():
            (figures / f"{name}.svg").write_text(drawing, encoding="utf-8")
    return out / "index.html"
