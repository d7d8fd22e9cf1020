"""Spec A5, F7: draw an evaluated run as one self-contained HTML page, and its figures as files."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from numpy.typing import NDArray

from hypogoal.core.artefacts import Artefact, claim, create_artefact, find_artefacts, versions
from hypogoal.core.errors import UserError
from hypogoal.core.files import read_json
from hypogoal.core.hdf5 import Foreign, open_hdf5, read_array, walk

AGAIN = "Evaluate the run again."


def report(run: Path, *, force: bool = False) -> Path:
    """Draw the report of an evaluated run.

    Args:
        run: a folder with an evaluation artefact in it; that in ``run/evaluation`` where there are several.
        force: replace an existing report.

    Returns:
        The page, ``run/report/index.html``. Beside it ``figures/*.svg`` and ``figures/*.png``.

    Raises:
        UserError: the run was not evaluated, the evaluation is damaged, or the report exists.
    """
    from hypogoal.evaluation.figures import to_png
    from hypogoal.evaluation.page import Material, render

    out = run / "report"
    source = _evaluation_of(run)
    claim(out, force=force)
    material = Material(_metrics(source.whole()), _arrays(source.path / "arrays.h5"))
    try:
        page = render(material, versions().get("hypogoal", "unknown"))
    except (KeyError, IndexError, TypeError, ValueError, AttributeError, ArithmeticError) as error:
        raise UserError("the evaluation does not fit this hypogoal, or is damaged", source.path, AGAIN) from error
    with create_artefact(out, kind="report", config={}, seed=0, inputs=[source.path], force=force) as folder:
        (folder / "index.html").write_text(page, encoding="utf-8")
        (folder / "figures").mkdir()
        for name, figure in material.figures.items():
            (folder / "figures" / f"{name}.svg").write_text(material.drawings[name], encoding="utf-8")
            (folder / "figures" / f"{name}.png").write_bytes(to_png(figure))
    return out / "index.html"


def _evaluation_of(run: Path) -> Artefact:
    found = find_artefacts(run, "evaluation")
    if not found:
        raise UserError("this run was not evaluated", run, f"First run: hypogoal evaluate {run}")
    preferred = [artefact for artefact in found if artefact.path == run / "evaluation"]
    return (preferred or found)[0]


def _metrics(source: Artefact) -> dict[str, Any]:
    path = source.path / "metrics.json"
    metrics = read_json(path, "the evaluation is", AGAIN)
    if not isinstance(metrics, dict):
        raise UserError("the evaluation is damaged", path, AGAIN)
    return metrics


def _arrays(path: Path) -> dict[str, NDArray[Any]]:
    with open_hdf5(path, "the evaluation's arrays", AGAIN) as file:
        try:
            return {name: read_array(file, name, "uibfT") for name in walk(file)}
        except Foreign as error:
            raise UserError(f"the evaluation's arrays are damaged ({error})", path, AGAIN) from None
