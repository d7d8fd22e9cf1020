"""Outputs that are complete: folders with a ``manifest.json``, and data files.

``core.drafts`` makes outputs.
"""

import contextlib
import hashlib
import json
import os
import platform
from importlib import metadata
from pathlib import Path
from typing import Any, Literal

from pydantic import BaseModel

from hypogoal.core.checkpoints import ANEW
from hypogoal.core.errors import UserError
from hypogoal.core.files import reading

MANIFEST = "manifest.json"
LOG = "metrics.jsonl"
SUMMARY = "summary.txt"  # what `evaluate` and `compare` print
TO_FILL_IN = "labels.csv"  # a table that the manifest does not list, because people change it
DATA = "data"  # the kind of an output that is an HDF5 file
AGAIN = "Make the artefact again."
PACKAGES = (
    "hypogoal", "torch", "numpy", "gymnasium", "minigrid", "ale-py", "opencv-python-headless", "captum", "h5py",
    "safetensors", "stable-baselines3",
)  # fmt: skip


class Input(BaseModel):
    """What an artefact was made from: an artefact or a file, with its :func:`sha256_of`."""

    kind: str
    path: str  # as the user gave it
    relative: str  # the path from the artefact's folder
    sha256: str


class Manifest(BaseModel):
    """A record of what made an artefact, and of what the artefact holds."""

    kind: str
    format: Literal[3] = 3
    config: dict[str, Any]
    seed: int
    inputs: list[Input] = []
    files: dict[str, str] = {}  # path within the folder -> sha256
    versions: dict[str, str] = {}
    command: list[str] = []
    took: dict[str, Any] = {}  # seconds, which is all in which two runs of a command differ

    def text(self, *left_out: str) -> str:
        """Return the manifest as JSON, without the fields ``left_out``."""
        content = self.model_dump(exclude={*left_out})
        return json.dumps(content, indent=1, allow_nan=False) + "\n"


class Settings(dict[str, Any]):
    """The configuration in a manifest. Looking up a missing key raises ``UserError``."""

    def __missing__(self, key: str) -> Any:
        raise UserError("the manifest's configuration lacks a setting", key, AGAIN)


class Artefact:
    """A complete artefact: its folder and its manifest. The manifest is read and checked, the other files are not.

    Attributes:
        kind: ensemble, options, meta, baseline, evaluation, report, comparison, audit, recorded-audit, hub, episodes.
        config: the resolved configuration that made the artefact.
        seed: the seed that made the artefact.
    """

    def __init__(self, path: Path):
        self.path = path
        if not path.exists():
            raise UserError("no such artefact", path, "Check the path, or run the stage that makes it.")
        if not (path / MANIFEST).is_file():
            raise UserError(f"no artefact here (no {MANIFEST})", path, "Give the folder that a stage wrote.")
        self.manifest = read_manifest(path / MANIFEST, AGAIN)
        self.kind = self.manifest.kind
        self.config = Settings(self.manifest.config)
        self.seed = self.manifest.seed

    def input(self, kind: str) -> Path:
        """Return the path of the input of kind ``kind``.

        Raises ``UserError`` if there is no such input, or if it is missing or was changed.
        """
        for entry in self.manifest.inputs:
            if entry.kind == kind:
                place = self.place_of(entry)
                if fault := _fault(place, entry.sha256):
                    raise UserError(f"the {kind} that {self.path} was made from is {fault}", entry.path, "Restore it.")
                return place
        raise UserError(f"{self.path} was not made from any {kind}", self.path / MANIFEST, "Is it the right artefact?")

    def place_of(self, entry: Input) -> Path:
        """Return the path of an input: its relative path or, if nothing is there, its recorded path."""
        relative, recorded = self.path / entry.relative, Path(entry.path)
        moved_alone = recorded.exists() and not relative.exists()
        return (recorded if moved_alone else relative).resolve()

    def faults(self, within: Path | None = None) -> list[str]:
        """Return a line for each file and each input that is missing or changed.

        With ``within``, only inputs in that folder are checked.
        """
        checks = [(name, self.path / name, digest) for name, digest in self.manifest.files.items()]
        for entry in self.manifest.inputs:
            place = self.place_of(entry)
            if within is None or place.is_relative_to(within):
                checks.append((f"its input {entry.path} ({entry.kind})", place, entry.sha256))
        lines = []
        for name, place, digest in checks:
            if fault := _fault(place, digest):
                lines.append(f"{name} is {fault}")
        return lines


def _fault(path: Path, digest: str) -> str:
    """Return what is wrong with a file or an artefact whose sha256 was ``digest``. The text is empty if nothing is."""
    if not path.exists():
        return "missing"
    try:
        return "" if sha256_of(path) == digest else "changed since it was written"
    except (OSError, UserError) as error:
        return f"unreadable ({error})"


def read_manifest(path: Path, do: str) -> Manifest:
    """Return the manifest in a file. Raises ``UserError``, which says to ``do`` something, if there is none."""
    with reading(path, do, "the manifest"):
        text = path.read_text(encoding="utf-8-sig")
        return Manifest.model_validate_json(text)


def open_artefact(path: Path, *kinds: str) -> Artefact:
    """Return the complete artefact in the folder ``path``, after a check of its files, which takes some ms per MB.

    Raises ``UserError`` if there is no artefact, if it is none of ``kinds``, or if its files are not as they were
    written. Without ``kinds``, an artefact of any kind is returned.
    """
    artefact = Artefact(path)
    if kinds and artefact.kind not in kinds:
        fault = f"this is a {artefact.kind!r} artefact, but {' or '.join(kinds)} is needed"
        raise UserError(fault, path, "Give the right folder.")
    for fault in artefact.faults(within=path):
        raise UserError(f"the artefact is damaged ({fault})", path, AGAIN)
    return artefact


def sha256_of(path: Path) -> str:
    """Return the sha256 of a file, or of an artefact's manifest.

    For an artefact's folder, the sha256 is that of what the manifest says, without white space and without ``took``.
    """
    if path.is_dir():
        text = Artefact(path).manifest.text("took")
        return hashlib.sha256(text.encode()).hexdigest()
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def versions() -> dict[str, str]:
    """Return the versions of Python and of the packages that determine an artefact's numbers, by name."""
    installed = {"python": platform.python_version()}
    for name in PACKAGES:
        with contextlib.suppress(metadata.PackageNotFoundError):
            installed[name] = metadata.version(name)
    return installed


def manifest_of(out: Path) -> Manifest:
    """Return the manifest of an output, which is a folder or an HDF5 file."""
    if out.is_dir():
        return Artefact(out).manifest
    import h5py

    with reading(out, ANEW, "the data file"), h5py.File(out) as file:
        domain = file.attrs["domain"]
        name = domain if isinstance(domain, str) else domain.decode()
        config = json.loads(file.attrs["config"]) | {"domain": name}
        return Manifest(kind=DATA, config=config, seed=int(file.attrs["seed"]))


def kind_of(out: Path) -> str | None:
    """Return the kind of an output.

    The kind is empty if the output is damaged or none of hypogoal's. It is None if nothing is there.
    """
    if not out.exists() or (out.is_dir() and not os.listdir(out)):
        return None
    try:
        return manifest_of(out).kind
    except UserError:
        return ""
