"""The kind, results and integrity of a path, for ``hypogoal show`` and ``hypogoal verify`` (Spec A8, G2).

Verifying reads everything: schema, sizes, sha256, numbers, and whether the recorded inputs are unchanged. Nothing
outside the requested folder is read.
"""

import contextlib
import shlex
from collections.abc import Callable, Iterator, Mapping
from functools import partial
from pathlib import Path
from typing import Any

from rich.console import Group
from rich.table import Table

from hypogoal.core.artefacts import (
    AGAIN,
    LOG,
    MANIFEST,
    Artefact,
)
from hypogoal.core.errors import UserError
from hypogoal.core.files import json_lines, read_end, read_json, read_text, replacing, visible
from hypogoal.core.own_code import command
from hypogoal.core.tensors import load_tensors
from hypogoal.core.terminal import drawn
from hypogoal.data import SPLITS, open_dataset, reading
from hypogoal.domains.base import installed_domain
from hypogoal.observations import PICTURE, type_text

# The numbers of logs and their titles, in the order in which they are shown.
RESULTS = {"labelled": "labelled loss"}
RESULTS |= {name: name for name in ("success", "length", "reached", "terminated", "duration", "episodes")}
EVALUATION = "evaluation"  # an artefact's kind, and its folder in a run


def describe_path(path: Path) -> dict[str, Any]:
    """Kind, configuration, inputs and numbers of a data file, an artefact, or every artefact of a run."""
    parts = [_describe_part(part) for part in _parts(path)]
    return parts[0] if parts[0]["path"] == str(path) else {"kind": "run", "path": str(path), "artefacts": parts}


def _describe_part(path: Path) -> dict[str, Any]:
    if path.is_file():
        dataset = open_dataset(path)
        details: dict[str, Any] = {"domain": dataset.domain, "observation_shape": list(dataset.observation_shape)}
        details |= {"observation_dtype": type_text(dataset.observation_dtype)}
        return {"kind": "data", "path": str(path), "counts": dataset.counts(), **details, "config": dataset.config}
    artefact = Artefact(path)
    keys = ("kind", "result", "inputs", "seed", "config", "command", "took", "versions", "format", "files")
    details = {"path": str(path), **artefact.manifest.model_dump(), "result": result_of(path)}
    return {key: details.get(key) for key in ("path", *keys)}


def result_of(path: Path) -> dict[str, float]:
    """The last numbers of an artefact's log, if any: means over sub-goals."""
    last: dict[str, dict[str, Any]] = {}
    for line in json_lines(read_end(path / LOG)):
        last[str(line.get("sub_goal"))] = line
    results = {}
    for name, title in RESULTS.items():
        values: list[Any] = [value for value in (line.get(name) for line in last.values()) if _is_number(value)]
        if values:
            results[title] = sum(values) / len(values)
    return results


def _is_number(value: Any) -> bool:
    return type(value) in (int, float) and abs(value) < 1e300


def numbers_in(kind: str, path: Path) -> dict[str, Any]:
    """The numbers of a data file or of an artefact's folder of a ``kind``; for a training its last logged numbers."""
    if kind == "data":
        return open_dataset(path).counts()
    if kind in (EVALUATION, "comparison"):
        return dict(read_json(path / "metrics.json", "the numbers are", AGAIN))
    return dict(result_of(path))


def outcome(kind: str, path: Path) -> list[str]:
    """The results, from :func:`numbers_in`, as lines; none if there are no numbers."""
    numbers = numbers_in(kind, path)
    if kind == "data":
        return count_lines(numbers)
    if kind == EVALUATION:
        return drawn(summary_of(numbers, path), 100).splitlines()
    if kind == "comparison":
        from hypogoal.evaluation.compare import winners

        return winners(numbers["comparisons"])
    return [f"{name}: {value:.4g}" for name, value in numbers.items()]


def count_lines(counts: Mapping[str, Any]) -> list[str]:
    """The numbers of states of a data file."""
    rows = [(split, goal, *row.values()) for split in SPLITS for goal, row in counts[split].items()]
    text = [
        f"{split:9s} {goal:20s} {states:7d} states {positives:7d} positives" for split, goal, states, positives in rows
    ]
    return [*text, f"unlabelled                     {counts['unlabelled']:7d} states"]


def numbers_of(path: Path) -> Mapping[str, Any] | None:
    """The contents of ``metrics.json`` of an evaluation, or of a run's; None if none, damaged a ``UserError``."""
    from hypogoal.evaluation.run import read_numbers

    for folder in (path, path / EVALUATION):
        if (folder / MANIFEST).is_file():
            artefact = Artefact(folder)
            return read_numbers(artefact) if artefact.kind == EVALUATION else None
    return None


def summary_of(numbers: Mapping[str, Any], path: Path) -> Table | Group:
    """The headline numbers, from :func:`numbers_of`, as tables; a ``UserError`` if they are damaged."""
    from hypogoal.evaluation.questions import summary_table

    try:
        return summary_table(numbers)
    except (LookupError, TypeError, ValueError, AttributeError):
        raise UserError("the evaluation is damaged", path, "Evaluate the run again.") from None


def lines(details: dict[str, Any]) -> list[str]:
    """A description as text, one fact per line, the result first."""
    if details["kind"] == "run":
        return [line for part in details["artefacts"] for line in lines(part)[:1]]
    numbers = (details.get("result") or {}).items()
    result = ", ".join(f"{name} {value:.0f}" if value >= 1_000 else f"{name} {value:.4g}" for name, value in numbers)
    text = [f"{details['path']}: {details['kind']}" + (f"; {result}" if result else "")]
    for key, value in details.items():
        if isinstance(value, dict) and key != "result":
            text += [f"{key}:", *(f"  {name}: {_typed(item)}" for name, item in value.items())]
        elif key == "command" and value:
            text.append(f"{key}: {shlex.join(value)}")
        elif key == "inputs" and value:
            text += [f"{key}:", *(f"  {item['kind']} {item['path']}" for item in value)]
        elif key not in ("path", "kind", "result") and value is not None:
            text.append(f"{key}: {value}")
    return text


def _typed(value: Any) -> str:
    """A setting as one would type it: lists with commas."""
    if isinstance(value, dict):
        return ", ".join(f"{name}={_typed(item)}" for name, item in value.items())
    return ",".join(map(str, value)) if isinstance(value, list) else str(value)


def write_contact_sheets(path: Path, folder: Path) -> list[Path]:
    """Draw a data file's labelled and held-out states, one picture per room and label, to check labels by eye.

    The files are ``labelled/room-01-positives.png`` and so on in ``folder``, in a folder per sub-goal if there are
    several. A path that is no data file and states that are not pictures are a ``UserError``.
    """
    from PIL import Image

    from hypogoal.evaluation.pictures import contact_sheets

    if not path.is_file():
        raise UserError("contact sheets need a data file", path, "Give the .h5 file of the states.")
    dataset = open_dataset(path)
    if dataset.observation_dtype != PICTURE or len(dataset.observation_shape) != 3:
        actual = f"{type_text(dataset.observation_dtype)} {dataset.observation_shape}"
        do = f"Read them as arrays: {command('export', path, '--out', path.stem + '.npz')}"
        raise UserError("the states are not pictures", actual, do)
    domain = installed_domain(dataset.domain)
    kinds = domain.kinds if domain else ()
    written = []
    for split in SPLITS:
        for sub_goal in dataset.sub_goals:
            place = folder / split / (sub_goal if len(dataset.sub_goals) > 1 else "")
            for name, sheet in contact_sheets(getattr(dataset, split)(sub_goal), kinds).items():
                place.mkdir(parents=True, exist_ok=True)
                written.append(place / f"{name}.png")
                with replacing(written[-1]) as fresh:
                    Image.fromarray(sheet).save(fresh, format="png")
    return written


def parts_of(run: Path) -> list[Path]:
    """The data files and artefacts of a run; a ``UserError`` if there are none."""
    if not run.is_dir():
        raise UserError("no such file or folder", run, "Check the path.")
    artefacts = [manifest.parent for manifest in visible(run, MANIFEST)]
    data = [file for file in visible(run, "*.h5") if file.parent not in artefacts]
    if not artefacts and not data:
        raise UserError("no artefact and no data file here", run, "Give what a stage wrote.")
    return [*data, *artefacts]


def faults_of(path: Path) -> list[str]:
    """One line for each fault of a data file, an artefact or a run; none if it is whole."""
    try:
        parts = _parts(path)
    except UserError as error:
        return [str(error)]
    faults: list[str] = []
    for part in parts:
        try:
            for fault in _artefact_faults(Artefact(part), path) if part.is_dir() else _data_faults(part):
                faults.append(f"{part}: {fault}")
        except UserError as error:  # for example a manifest that is a folder
            faults.append(str(error))
    return faults


def notes_of(path: Path) -> list[str]:
    """One line for each oddity that is no fault and that only the user can judge."""
    notes: list[str] = []
    with contextlib.suppress(UserError):
        for part in filter(Path.is_dir, _parts(path)):
            with contextlib.suppress(UserError):
                notes += _notes_of(Artefact(part), path)
    return notes


def is_made(path: Path) -> bool:
    """Whether there is a data file or a complete artefact at or below a path."""
    return path.is_file() or bool([*visible(path, MANIFEST), *visible(path, "*.h5")])


def _parts(path: Path) -> list[Path]:
    return [path] if path.is_file() or (path / MANIFEST).is_file() else parts_of(path)


def _notes_of(artefact: Artefact, folder: Path) -> Iterator[str]:
    path = artefact.path
    for entry in artefact.manifest.inputs:
        if not (artefact.path / entry.relative).resolve().is_relative_to(folder.resolve()):
            yield f"{path}: its input {entry.path} ({entry.kind}) lies outside, not checked"


def _data_faults(path: Path) -> Iterator[str]:
    dataset = open_dataset(path)
    readers: list[Callable[[], object]] = [dataset.unlabelled, dataset.unlabelled_origins]
    readers += [partial(getattr(dataset, split), goal) for split in SPLITS for goal in dataset.sub_goals]
    for read in readers:
        yield from _fault(read)


def _artefact_faults(artefact: Artefact, folder: Path) -> Iterator[str]:
    faults = artefact.file_faults()
    yield from (f"{name}: {fault}" for name, fault in faults.items())
    bad = {*faults}
    for name in artefact.manifest.files:
        if name not in bad and (check := CONTENTS.get(Path(name).suffix)) is not None:
            for fault in _fault(partial(check, artefact.path / name)):
                bad.add(name)
                yield fault
    for entry in artefact.manifest.inputs:
        within = (artefact.path / entry.relative).resolve().is_relative_to(folder.resolve())
        if within and (fault := artefact.input_fault(entry)):
            yield f"its input {entry.path} ({entry.kind}) is {fault}"
    if artefact.kind == "ensemble":  # last, since its files may be missing
        for sub_goal in artefact.config["sub_goals"]:
            if f"{sub_goal}.safetensors" not in bad:
                yield from _fault(partial(_check_members, artefact, sub_goal))


def _check_members(artefact: Artefact, sub_goal: str) -> None:
    """Refuse (``UserError``) weights that do not fit the manifest, and thresholds that are not probabilities."""
    from hypogoal.hypotheses.ensemble import read_ensemble

    thresholds = read_ensemble(artefact.path, artefact.config, sub_goal).thresholds
    if not ((thresholds >= 0) & (thresholds <= 1)).all():
        raise UserError(f"{sub_goal}: thresholds that are not probabilities: {thresholds.tolist()}")


def _fault(read: Callable[[], object]) -> Iterator[str]:
    try:
        read()
    except UserError as error:
        yield str(error)


def _read_table(path: Path) -> None:
    from hypogoal.options.tables import read_table

    read_table(path, ("value",) if path.name == "numbers.csv" else None)  # its other columns are texts


def _read_lines(path: Path) -> None:
    """Read JSON, one object per line; a number that was not known yet may be NaN."""
    for number, line in enumerate(read_text(path, "the log is", AGAIN).splitlines(), 1):
        if not [*json_lines([line])]:
            raise UserError(f"line {number} is not a JSON object", path, AGAIN)


def _read_arrays(path: Path) -> None:
    with reading(path, "the file of arrays", AGAIN) as file:
        names: list[str] = []
        file.visit(names.append)
        for name in names:
            if hasattr(file[name], "shape"):
                file[name][()]


CONTENTS: dict[str, Callable[[Path], object]] = {
    ".safetensors": load_tensors,
    ".csv": _read_table,
    ".json": lambda path: read_json(path, "the file is", AGAIN),
    ".jsonl": _read_lines,
    ".h5": _read_arrays,
}
