"""Is it whole: the answers of ``hypogoal verify`` (Spec A8, G2).

Everything is read: schema, sizes, sha256, numbers, and whether the inputs recorded are still what they were.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator
from pathlib import Path

from hypogoal.core.artefacts import MANIFEST, Artefact, file_fault, find_input, open_artefact
from hypogoal.core.errors import UserError
from hypogoal.core.files import read_json, read_text
from hypogoal.core.hdf5 import Foreign, open_hdf5, read_array, walk
from hypogoal.core.tensors import load_tensors
from hypogoal.dataset import SPLITS, open_dataset
from hypogoal.inspection import parts_of

AGAIN = "Make the artefact again."


def faults_of(path: Path) -> list[str]:
    """One line for each thing that is wrong with a data file, an artefact or a run; none when it is whole."""
    try:
        run = path.is_dir() and not (path / MANIFEST).is_file()
        return [fault for part in (parts_of(path) if run else [path]) for fault in _faults_of_part(part)]
    except UserError as error:
        return [str(error)]


def _faults_of_part(path: Path) -> list[str]:
    """Those of one data file or artefact; a manifest that is a folder or a device is a fault of its own."""
    try:
        faults = _artefact_faults(open_artefact(path)) if path.is_dir() else _data_faults(path)
        return [f"{path}: {fault}" for fault in faults]
    except UserError as error:
        return [str(error)]


def _data_faults(path: Path) -> Iterator[str]:
    dataset = open_dataset(path)
    yield from (f"{part} was cut off, the rest was saved" for part in dataset.lost)
    readers: list[tuple[str, Callable[[], object]]] = [
        (f"{split}/{sub_goal}", lambda split=split, sub_goal=sub_goal: getattr(dataset, split)(sub_goal))  # type: ignore[misc]
        for split in SPLITS
        for sub_goal in dataset.sub_goals
    ]
    readers += [("unlabelled", dataset.unlabelled), ("unlabelled", dataset.unlabelled_origins)]
    for part, read in readers:
        if not {part, part.partition("/")[0]} & {*dataset.lost}:
            yield from _fault(read)


def _artefact_faults(artefact: Artefact) -> Iterator[str]:
    for name, digest in artefact.manifest["files"].items():
        fault = file_fault(artefact.path, name, digest)
        if fault:
            yield f"{name}: {fault}"
        elif (check := CONTENTS.get(Path(name).suffix)) is not None:
            yield from _fault(lambda name=name, check=check: check(artefact.path / name))  # type: ignore[misc]
    if artefact.kind == "ensemble":
        yield from (fault for sub_goal in artefact.config["sub_goals"] for fault in _member_faults(artefact, sub_goal))
    for entry in artefact.manifest["inputs"]:
        path, fault = find_input(artefact.path, entry)
        if path is None:
            yield f"its input {entry['path']} ({entry['kind']}) is {fault}"


def _member_faults(artefact: Artefact, sub_goal: str) -> Iterator[str]:
    """Whether weights fit what the manifest says of them, and thresholds are probabilities."""
    from hypogoal.hypotheses.storage import read_ensemble

    try:
        thresholds = read_ensemble(artefact.path, artefact.config, sub_goal).thresholds
    except UserError as error:
        yield str(error)
        return
    if not ((thresholds >= 0) & (thresholds <= 1)).all():
        yield f"{sub_goal}: thresholds that are no probabilities: {thresholds.tolist()}"


def _fault(read: Callable[[], object]) -> Iterator[str]:
    try:
        read()
    except UserError as error:
        yield str(error)


def _read_table(path: Path) -> None:
    from hypogoal.evaluation.run import read_table

    read_table(path)


def _read_lines(path: Path) -> None:
    """JSON, one object a line; a number that was not there yet may be NaN."""
    for number, line in enumerate(read_text(path, "the log is", AGAIN).splitlines(), 1):
        try:
            fits = isinstance(json.loads(line), dict)
        except (ValueError, RecursionError):
            fits = False
        if not fits:
            raise UserError(f"line {number} is no JSON object", path, AGAIN)


def _read_arrays(path: Path) -> None:
    with open_hdf5(path, "the file of arrays", AGAIN) as file:
        try:
            for name in walk(file):
                read_array(file, name, "uibfS")
        except Foreign as error:
            raise UserError(f"the file of arrays is damaged ({error})", path, AGAIN) from None


CONTENTS: dict[str, Callable[[Path], object]] = {
    ".safetensors": load_tensors,
    ".csv": _read_table,
    ".json": lambda path: read_json(path, "the file is", AGAIN),
    ".jsonl": _read_lines,
    ".h5": _read_arrays,
}
