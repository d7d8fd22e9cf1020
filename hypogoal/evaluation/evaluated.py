"""An evaluation as its readers need it: numbers and arrays, each damaged file told in one line (Spec A5, G2)."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from hypogoal.core.artefacts import Artefact, find_artefacts
from hypogoal.core.errors import UserError

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
    return Evaluated(source, _metrics(source.path / "metrics.json"), _arrays(source.path / "arrays.h5", start))


def _metrics(path: Path) -> dict[str, Any]:
    try:
        metrics = dict(json.loads(path.read_text(encoding="utf-8")))
    except (OSError, ValueError, TypeError):
        raise UserError("missing or damaged", path, "Evaluate the run again.") from None
    lacking = [part for part in PARTS if part not in metrics]
    if lacking:
        raise UserError(f"evaluated by an older hypogoal (no {', '.join(lacking)})", path, "Evaluate the run again.")
    return metrics


def _arrays(path: Path, start: str) -> dict[str, NDArray[Any]]:
    import h5py

    arrays: dict[str, NDArray[Any]] = {}

    def read(name: str, item: Any) -> None:
        if isinstance(item, h5py.Dataset) and name.startswith(start):
            arrays[name] = np.asarray(item[()])

    try:
        with h5py.File(path, "r") as file:
            file.visititems(read)
    except OSError:
        raise UserError("missing or damaged", path, "Evaluate the run again.") from None
    return arrays
