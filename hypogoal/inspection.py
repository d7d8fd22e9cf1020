"""What is at a path: the answers of ``hypogoal show``."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from hypogoal.core.artefacts import MANIFEST, open_artefact
from hypogoal.core.errors import UserError
from hypogoal.dataset import SPLITS, open_dataset
from hypogoal.domains.base import installed_domain

if TYPE_CHECKING:
    from rich.console import Group
    from rich.table import Table

EVALUATION = "evaluation"  # an artefact's kind, and its folder in a run


def describe_path(path: Path) -> dict[str, Any]:
    """Kind, configuration, inputs and numbers of a data file, an artefact, or every artefact of a run."""
    if path.is_file() or (path / MANIFEST).is_file():
        return _describe_part(path)
    return {"kind": "run", "path": str(path), "artefacts": [_describe_part(part) for part in parts_of(path)]}


def _describe_part(path: Path) -> dict[str, Any]:
    if path.is_file():
        dataset = open_dataset(path)
        about = {"domain": dataset.domain, "observation_shape": list(dataset.observation_shape)}
        return {
            "kind": "data",
            "path": str(path),
            **about,
            "config": dataset.config,
            "counts": dataset.counts(),
        }
    artefact = open_artefact(path)
    keys = ("kind", "format", "seed", "config", "inputs", "files", "versions", "command")
    return {"path": str(path), **{key: artefact.manifest.get(key) for key in keys}}


def numbers_of(path: Path) -> Mapping[str, Any] | None:
    """What ``metrics.json`` holds of an evaluation, or of a run's own; None where there is none.

    Raises:
        UserError: it is damaged.
    """
    from hypogoal.evaluation.run import read_numbers

    for folder in (path, path / EVALUATION):
        if (folder / MANIFEST).is_file():
            artefact = open_artefact(folder)
            return read_numbers(artefact) if artefact.kind == EVALUATION else None
    return None


def summary_of(numbers: Mapping[str, Any], path: Path) -> Table | Group:
    """The headline numbers of an evaluation as tables.

    Args:
        numbers: what :func:`numbers_of` found.
        path: where, for the message.

    Raises:
        UserError: they are not what ``evaluate`` writes.
    """
    from hypogoal.evaluation.questions import summary_table

    try:
        return summary_table(numbers)
    except (LookupError, TypeError, ValueError, AttributeError):
        raise UserError("the evaluation is damaged", path, "Evaluate the run again.") from None


def lines(about: dict[str, Any]) -> list[str]:
    """A description as text, a line a fact."""
    if about["kind"] == "run":
        return [f"{part['path']}: {part['kind']}" for part in about["artefacts"]]
    text = [f"{about['path']}: {about['kind']}"]
    for key, value in about.items():
        if key in ("path", "kind") or value is None:
            continue
        if isinstance(value, dict):
            text.append(f"{key}:")
            text.extend(f"  {name}: {item}" for name, item in value.items())
        elif key == "inputs" and value:
            text.append(f"{key}:")
            text.extend(f"  {item['kind']} {item['path']}" for item in value)
        else:
            text.append(f"{key}: {value}")
    return text


def write_contact_sheets(path: Path, folder: Path) -> list[Path]:
    """Pictures of a data file's labelled and held-out states, for each room and label one, to check labels by eye.

    Args:
        path: the data file.
        folder: where ``labelled/room-01-positives.png`` and so on are written; by sub-goal too where there are several.

    Returns:
        The pictures written.

    Raises:
        UserError: not a data file, its states are no pictures, or the folder cannot be written to.
    """
    from PIL import Image

    from hypogoal.evaluation.pictures import contact_sheets

    if not path.is_file():
        raise UserError("contact sheets are of data files", path, "Give the .h5 file that 'hypogoal collect' wrote.")
    dataset = open_dataset(path)
    if len(dataset.observation_shape) != 3:
        raise UserError("the states are no pictures", f"observation shape {dataset.observation_shape}")
    kinds = kinds_of(dataset.domain)
    written = []
    for split in SPLITS:
        for sub_goal in dataset.sub_goals:
            place = folder / split / (sub_goal if len(dataset.sub_goals) > 1 else "")
            for name, sheet in contact_sheets(getattr(dataset, split)(sub_goal), kinds).items():
                file = place / f"{name}.png"
                try:
                    place.mkdir(parents=True, exist_ok=True)
                    Image.fromarray(sheet).save(file)
                except OSError as error:
                    reason = error.strerror or str(error)
                    raise UserError(
                        f"the picture cannot be written ({reason})", file, "Choose another folder."
                    ) from None
                written.append(file)
    return written


def kinds_of(domain: str) -> Sequence[str]:
    """What the values of the origin ``kind`` mean in a domain; nothing where it is not installed or has no kinds."""
    found = installed_domain(domain)
    return found.kinds if found else ()


def parts_of(run: Path) -> list[Path]:
    """The data files and artefacts of a run.

    Raises:
        UserError: there is none.
    """
    if not run.is_dir():
        raise UserError("no such file or folder", run, "Check the path.")
    artefacts = [manifest.parent for manifest in sorted(run.rglob(MANIFEST)) if not _hidden(manifest, run)]
    data = [file for file in sorted(run.rglob("*.h5")) if file.parent not in artefacts and not _hidden(file, run)]
    if not artefacts and not data:
        raise UserError("no artefact and no data file here", run, "Give what a stage wrote.")
    return [*data, *artefacts]


def _hidden(path: Path, run: Path) -> bool:
    return any(part.startswith(".") for part in path.relative_to(run).parts)
