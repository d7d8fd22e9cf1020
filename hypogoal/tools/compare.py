"""Spec F5, F7: several evaluated runs side by side, as one page and its numbers."""

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from hypogoal.core.artefacts import create, versions
from hypogoal.core.errors import UserError
from hypogoal.evaluation.numbers import plain
from hypogoal.evaluation.run import evaluation_of, fitting, read_evaluation
from hypogoal.evaluation.table import read_rows

TABLES = ("agents", "hypotheses", "rooms", "distance")


def compare(runs: Sequence[Path], out: Path, *, force: bool = False) -> Path:
    """Compare evaluated runs, the others with the first, in an artefact with ``figures/*.svg``; returns its page.

    Fewer than two runs, one twice, or runs that were not evaluated or cannot be compared are a ``UserError``.
    """
    from hypogoal.evaluation import compare as beside
    from hypogoal.evaluation.page import Material, draw_page
    from hypogoal.evaluation.provenance import domains_of
    from hypogoal.evaluation.questions import meanings

    if len({run.resolve() for run in runs}) < max(2, len(runs)):
        where = " ".join(map(str, runs))
        raise UserError("a comparison takes two or more different runs", where, "Name each run once.")
    sources = [evaluation_of(run) for run in runs]
    inputs = [source.path for source in sources]
    with create(out, kind="comparison", config={}, seed=0, inputs=inputs, force=force) as draft:
        labels = beside.labels_of([run.resolve().as_posix() for run in runs])
        evaluations = {label: read_evaluation(run, "curves/") for label, run in zip(labels, runs, strict=True)}
        metrics = {label: evaluation.metrics for label, evaluation in evaluations.items()}
        rows = {label: read_rows(evaluation.source.path / "numbers.csv") for label, evaluation in evaluations.items()}
        with fitting(" ".join(map(str, runs))):
            reason = beside.why_not(metrics)
            if reason is not None:
                raise UserError(
                    "these runs cannot be compared", reason, "Choose runs of one experiment, evaluated alike."
                )
            named = zip(labels, runs, strict=True)
            comparison = {
                "runs": [{"label": label, "path": str(run), **_about(metrics[label])} for label, run in named],
                "domains": domains_of(metrics[labels[0]]),
                "shared": beside.shared(metrics),
                "differences": beside.differences(metrics),
                "comparisons": plain(beside.compare_runs(rows)),
                **{table: {label: of_run[table] for label, of_run in metrics.items()} for table in TABLES},
                "quantities": meanings(),
            }
            material = Material(comparison, {})
            arrays = {label: evaluation.arrays for label, evaluation in evaluations.items()}
            sections = beside.compared_sections(metrics, arrays, comparison, material)
            version = versions().get("hypogoal", "unknown")
            title = f"hypogoal: {len(runs)} runs compared"
            page = draw_page(title, f"{', '.join(labels)}; hypogoal {version}", sections, version)
        text = json.dumps(comparison, indent=1, allow_nan=False) + "\n"
        (draft.files / "index.html").write_text(page, encoding="utf-8")
        (draft.files / "metrics.json").write_text(text, encoding="utf-8")
        (draft.files / "figures").mkdir()
        for name, drawing in material.drawings.items():
            (draft.files / "figures" / f"{name}.svg").write_text(drawing, encoding="utf-8")
    return out / "index.html"


def _about(metrics: Mapping[str, Any]) -> dict[str, Any]:
    """What a run is made of."""
    artefacts = metrics["provenance"]["artefacts"]
    layouts = {artefact["config"]["layout_seed"] for artefact in artefacts if "layout_seed" in artefact["config"]}
    seeds = sorted({artefact["seed"] for artefact in artefacts})
    return {"artefacts": len(artefacts), "seeds": seeds, "layout_seeds": sorted(layouts)}
