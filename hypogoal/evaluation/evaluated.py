"""An evaluation as its readers need it: numbers and arrays, each damaged file told in one line (Spec A5, G2)."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from numpy.typing import NDArray

from hypogoal.core.artefacts import MANIFEST, Artefact, file_fault, find_artefacts, sha256_of
from hypogoal.core.errors import UserError
from hypogoal.core.files import plain_name, read_json
from hypogoal.core.hdf5 import Foreign, open_hdf5, read_array, walk
from hypogoal.evaluation.found import find

AGAIN = "Evaluate the run again."
PARTS = ("agents", "ensembles", "hypotheses", "rooms", "distance", "saliency", "selection", "settings", "provenance")


@dataclass(frozen=True)
class Evaluated:
    """A run that was evaluated: ``metrics`` of ``metrics.json``, ``arrays`` of ``arrays.h5`` by name."""

    source: Artefact
    metrics: Mapping[str, Any]
    arrays: Mapping[str, NDArray[Any]]


@contextlib.contextmanager
def fitting(where: object) -> Iterator[None]:
    """Drawing an evaluation, whose numbers are a file's: what does not fit is told in one line."""
    try:
        yield
    except (LookupError, TypeError, ValueError, AttributeError, ArithmeticError) as error:
        raise UserError("the evaluation does not fit this hypogoal, or is damaged", where, AGAIN) from error


def read_evaluation(run: Path, start: str = "") -> Evaluated:
    """The evaluation of a run: that in ``run/evaluation`` where there are several.

    Args:
        run: a folder with an evaluation artefact in it.
        start: of the arrays only those whose names begin so.

    What was made since is among ``missing``.

    Raises:
        UserError: the run was not evaluated, or the evaluation is damaged.
    """
    found = find_artefacts(run, "evaluation")
    if not found:
        raise UserError("this run was not evaluated", run, f"First run: hypogoal evaluate {run}")
    source = next((artefact for artefact in found if artefact.path == run / "evaluation"), found[0])
    source.whole()
    metrics = _metrics(source.path / "metrics.json")
    metrics["missing"] = [*metrics.get("missing", ()), *_since(run, source)]
    return Evaluated(source, metrics, _arrays(source.path / "arrays.h5", start))


def read_numbers(source: Artefact) -> Mapping[str, Any]:
    """``metrics.json`` of an evaluation artefact.

    Raises:
        UserError: it is damaged.
    """
    path = source.path / "metrics.json"
    fault = file_fault(source.path, path.name, source.manifest["files"].get(path.name, ""))
    if fault:
        raise UserError(f"the evaluation's file is {fault}", path, AGAIN)
    return _metrics(path)


def _since(run: Path, source: Artefact) -> list[str]:
    """A line for each artefact of the run that the evaluation does not know: it was made, or made again, since."""
    known = {entry["sha256"] for entry in source.manifest["inputs"]}
    try:
        found = find(run)
    except UserError:  # evaluations may lie where nothing else does
        return []
    names = [found.name(one) for one in found.everything() if sha256_of(one.path / MANIFEST) not in known]
    return [f"{name}: made since this evaluation ('hypogoal evaluate {run} --force' reads it)" for name in names]


def _metrics(path: Path) -> dict[str, Any]:
    metrics = read_json(path, "the evaluation is", AGAIN)
    if not isinstance(metrics, dict):
        raise UserError("the evaluation is damaged", path, AGAIN)
    lacking = [part for part in PARTS if part not in metrics]
    if lacking:
        raise UserError(f"evaluated by an older hypogoal (no {', '.join(lacking)})", path, AGAIN)
    for name in _sub_goals(metrics):
        if not plain_name(name):
            raise UserError(f"a sub-goal in the evaluation has a name that is none, {name!r}", path, AGAIN)
    return metrics


def _sub_goals(part: Any) -> Iterator[Any]:
    if isinstance(part, dict):
        yield from [part["sub_goal"]] if "sub_goal" in part else []
    for inner in part.values() if isinstance(part, dict) else part if isinstance(part, list) else ():
        yield from _sub_goals(inner)


def _arrays(path: Path, start: str) -> dict[str, NDArray[Any]]:
    with open_hdf5(path, "the evaluation's arrays", AGAIN) as file:
        try:
            return {name: read_array(file, name, "uibfS") for name in walk(file) if name.startswith(start)}
        except Foreign as error:
            raise UserError(f"the evaluation's arrays are damaged ({error})", path, AGAIN) from None
