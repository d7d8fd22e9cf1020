"""An evaluation as its readers need it: numbers and arrays, each damaged file told in one line (Spec A5, G2)."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from numpy.typing import NDArray

from hypogoal.core.artefacts import Artefact, find_artefacts
from hypogoal.core.errors import UserError
from hypogoal.core.files import read_json
from hypogoal.core.hdf5 import Foreign, open_hdf5, read_array, walk

AGAIN = "Evaluate the run again."
PARTS = ("agents", "ensembles", "hypotheses", "rooms", "distance", "saliency", "selection", "settings", "provenance")


@dataclass(frozen=True)
class Evaluated:
    """A run that was evaluated: ``metrics`` of ``metrics.json``, ``arrays`` of ``arrays.h5`` by name."""

    source: Artefact
    metrics: Mapping[str, Any]
    arrays: Mapping[str, NDArray[Any]]


def read_evaluation(run: Path, start: str = "") -> Evaluated:
    """The evaluation of a run: that in ``run/evaluation`` where there are several.

    Args:
        run: a folder with an evaluation artefact in it.
        start: of the arrays only those whose names begin so.

    Raises:
        UserError: the run was not evaluated, or the evaluation is damaged.
    """
    found = find_artefacts(run, "evaluation")
    if not found:
        raise UserError("this run was not evaluated", run, f"First run: hypogoal evaluate {run}")
    source = next((artefact for artefact in found if artefact.path == run / "evaluation"), found[0])
    source.whole()
    return Evaluated(source, _metrics(source.path / "metrics.json"), _arrays(source.path / "arrays.h5", start))


def _metrics(path: Path) -> dict[str, Any]:
    metrics = read_json(path, "the evaluation is", AGAIN)
    if not isinstance(metrics, dict):
        raise UserError("the evaluation is damaged", path, AGAIN)
    lacking = [part for part in PARTS if part not in metrics]
    if lacking:
        raise UserError(f"evaluated by an older hypogoal (no {', '.join(lacking)})", path, AGAIN)
    return metrics


def _arrays(path: Path, start: str) -> dict[str, NDArray[Any]]:
    with open_hdf5(path, "the evaluation's arrays", AGAIN) as file:
        try:
            return {name: read_array(file, name, "uibfS") for name in walk(file) if name.startswith(start)}
        except Foreign as error:
            raise UserError(f"the evaluation's arrays are damaged ({error})", path, AGAIN) from None
