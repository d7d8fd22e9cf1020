"""Artefacts: folders with a ``manifest.json``, written beside their final name and renamed at the end.

A folder with a manifest is complete (Spec A8). The manifest records kind, format version, the full resolved
configuration, the seed, the sha256 of every file and of every input's manifest, package versions, time and memory.
"""

import contextlib
import hashlib
import os
import platform
import time
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from importlib import metadata
from pathlib import Path
from typing import Any, Self

from hypogoal.core import drafts
from hypogoal.core.config import as_dict
from hypogoal.core.errors import UserError
from hypogoal.core.files import MAX_NAME_BYTES, inside, open_file, read_json, visible
from hypogoal.core.manifests import (
    AGAIN,
    FORMAT_VERSION,
    MANIFEST,
    TOOK,
    check_writable,
    digest_of,
    read_manifest,
    sealed,
)

DATA, ARRAYS = "data", "arrays"  # kinds of outputs that are files: HDF5 and .npz
# How a file of a kind begins, and what is in its first bytes, even if the rest is cut off.
SIGNATURES = {DATA: (b"\x89HDF\r\n\x1a\n", b"sub_goals"), ARRAYS: (b"PK\3\4", b"observations.npy")}
TO_FILL_IN = "labels.csv"  # a table that people change: the manifest does not list it
DEPTH = 3  # levels of folders below a run that are searched for artefacts
THE_FILE = "the file is"
PIECE = 1 << 20  # bytes hashed at once
FRONT = 1 << 16  # bytes of a file that are looked at for its kind
AWAY = "Move it away, or choose another --out."
PACKAGES = (
    "hypogoal", "torch", "numpy", "gymnasium", "minigrid", "ale-py", "opencv-python-headless", "captum", "h5py",
    "safetensors", "stable-baselines3",
)  # fmt: skip


@dataclass(frozen=True)
class Artefact:
    """A complete artefact: its folder and its manifest."""

    path: Path
    manifest: dict[str, Any]

    @property
    def kind(self) -> str:
        """ensemble, options, meta, baseline, evaluation, report, comparison, audit or recorded-audit."""
        return str(self.manifest["kind"])

    @property
    def config(self) -> dict[str, Any]:
        """The resolved configuration that made it; a missing key is a ``UserError``."""
        return Settings(self.manifest["config"], self.path)

    @property
    def seed(self) -> int:
        """The seed that made it."""
        return int(self.manifest["seed"])

    def whole(self) -> Self:
        """This artefact; a ``UserError`` if a file is not as in the manifest. Takes some ms per MB."""
        if faults := check_files(self):
            raise UserError(f"the artefact is damaged ({faults[0]})", self.path, AGAIN)
        return self

    def input(self, kind: str) -> Path:
        """The input of ``kind``, at its relative or its recorded path; a ``UserError`` if gone or changed."""
        for entry in self.manifest["inputs"]:
            if entry["kind"] == kind:
                path, fault = find_input(self.path, entry)
                if path is None:
                    source = f"the {kind} that {self.path} was made from"
                    raise UserError(f"{source} is {fault}", entry["path"], "Restore it.")
                return path
        raise UserError(f"{self.path} was not made from any {kind}", self.path / MANIFEST, "Is it the right artefact?")


class Settings(dict[str, Any]):
    """A manifest's configuration: a missing key is a ``UserError``."""

    def __init__(self, values: dict[str, Any], path: Path):
        super().__init__(values)
        self._path = path

    def __missing__(self, key: str) -> Any:
        raise UserError(f"the manifest's configuration has no {key!r}", self._path / MANIFEST, AGAIN)


def sha256_of(path: Path) -> str:
    """The sha256 of a regular file as hexadecimal digits, read up to its size when opened; else a ``UserError``."""
    digest = hashlib.sha256()
    with open_file(path, THE_FILE, AGAIN) as file:
        while piece := file.read(PIECE):
            digest.update(piece)
    return digest.hexdigest()


def versions() -> dict[str, str]:
    """Versions of Python and of the packages that determine an artefact's numbers."""
    installed = {"python": platform.python_version()}
    for name in PACKAGES:
        with contextlib.suppress(metadata.PackageNotFoundError):
            installed[name] = metadata.version(name)
    return installed


def claim(out: Path, *, kind: str, inputs: Iterable[Path] = (), force: bool = False, resume: bool = False) -> Path:
    """Check, before any work, that ``out`` may be written as a ``kind``: an artefact's, ``data`` or ``arrays``.

    A ``UserError`` if its name is too long; it is or contains an input; it exists without ``force`` or is of another
    kind; another process writes it; or it is unfinished and neither ``force`` nor ``resume`` is given. With ``resume``
    a complete output passes: ``create_artefact`` compares it.
    """
    place = out.resolve()
    if len(os.fsencode(place.name)) > MAX_NAME_BYTES:  # the draft's name is longer
        raise UserError(f"the output's name is longer than {MAX_NAME_BYTES} bytes", out, "Choose a shorter one.")
    for path in inputs:
        if path.resolve().is_relative_to(place):
            raise UserError("the output would replace an input", path, "Choose another --out.")
    if out.exists():
        if not resume:  # only the stage knows whether a complete output was made with the requested settings
            drafts.check_replaceable(out, force=force)
        check_kind(out, kind)
    out = drafts.place_of(out)
    check_parent(out)
    drafts.check_free(out, force=force, resume=resume)
    drafts.sweep_up(out.parent)
    return out


def check_kind(out: Path, kind: str) -> None:
    """Refuse (``UserError``) to replace anything but an empty folder or an output, whole or damaged, of the same kind.

    A mistyped ``--out`` with ``--force`` may hit months of work, or files that are not hypogoal's.
    """
    if out.is_dir():
        if not any(out.iterdir()):
            return
        if not (out / MANIFEST).is_file():
            raise UserError(f"the existing output is not of kind {kind!r}: a folder without a manifest", out, AWAY)
        existing = _manifest_kind(out)
        if existing != kind:
            reason = f"it is of kind {existing!r}" if existing else "its manifest cannot be read"
            raise UserError(f"the existing output is not of kind {kind!r}: {reason}", out, AWAY)
        return
    if not begins_as(out, kind):
        raise UserError(f"the existing output is not of kind {kind!r}: another file", out, AWAY)


def begins_as(path: Path, kind: str, do: str = AWAY) -> bool:
    """Whether a file begins as those of a kind, data or arrays; ``do`` is the advice where it cannot be read."""
    with open_file(path, THE_FILE, do) as file:
        begin = file.read(FRONT)
    signature, content = SIGNATURES.get(kind, (b"", b""))
    return bool(signature) and begin.startswith(signature) and content in begin


def _manifest_kind(folder: Path) -> str:
    """The kind in a manifest, whatever else is wrong with it; empty if it cannot be read."""
    with contextlib.suppress(UserError):
        manifest = read_json(folder / MANIFEST, "the manifest is", "")
        if isinstance(manifest, dict) and "format" in manifest and isinstance(manifest.get("kind"), str):
            return str(manifest["kind"])
    return ""


def check_parent(out: Path) -> None:
    """Refuse (``UserError``) an output whose folder cannot be made or written to."""
    parent = next(folder for folder in out.absolute().parents if folder.exists())
    if not parent.is_dir():
        raise UserError("the output's folder cannot be made, a file is in the way", parent, "Choose another --out.")
    if not os.access(parent, os.W_OK):
        raise UserError("no permission to write", parent, "Choose another --out.")


@contextlib.contextmanager
def create_artefact(
    out: Path,
    *,
    kind: str,
    config: Any,
    seed: int,
    inputs: Sequence[Path] = (),
    force: bool = False,
    resume: bool = False,
) -> Iterator[Path]:
    """A folder to fill; at the end its manifest is written and it is renamed to ``out``.

    ``config`` is the resolved configuration, a dataclass or a dict; ``inputs`` are the artefact folders or data files
    that were read. ``checkpoints_of`` finds the checkpoints beside the folder. If the block raises, ``out`` stays as it
    was, and the folder is removed unless it has a checkpoint.

    Raises:
        UserError: see :func:`claim`, or the unfinished output has another configuration, seed or inputs.
        Complete: with ``resume``, the output is complete and was made with the same ones.
    """
    started = time.monotonic()
    inputs = [Path(path) for path in inputs]
    requested, out = out, claim(out, kind=kind, inputs=inputs, force=force, resume=resume)
    config = config if isinstance(config, dict) else as_dict(config)
    header = {"kind": kind, "format": FORMAT_VERSION, "config": config, "seed": seed}
    entries = [_input_entry(path, out) for path in inputs]
    check_writable({**header, "inputs": entries, "files": {}}, out)
    identity = {**header, "inputs": [entry["sha256"] for entry in entries], "versions": versions()}
    if resume and out.exists() and not drafts.unfinished(out):
        manifest = open_artefact(out, kind).manifest
        hashes = [entry["sha256"] for entry in manifest["inputs"]]
        raise drafts.check_complete({**manifest, "inputs": hashes}, identity, requested)
    with drafts.draft(out, identity, force=force, resume=resume) as work:
        yield work.files
        written = sorted(file for file in work.files.rglob("*") if file.is_file() and file.name != TO_FILL_IN)
        files = {file.relative_to(work.files).as_posix(): sha256_of(file) for file in written}
        manifest = {**header, "inputs": entries, "files": files, "versions": versions(), "command": work.command}
        manifest[TOOK] = {"seconds": round(time.monotonic() - started, 1), "memory": peak_memory()}
        (work.files / MANIFEST).write_bytes(sealed(manifest))
        drafts.put_in_place(work.files, out)


def peak_memory() -> int:
    """The most bytes of memory that this process or one of its children has held; 0 where the system does not say."""
    try:
        import resource
    except ImportError:  # Windows
        return 0
    kilobytes = [resource.getrusage(who).ru_maxrss for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN)]
    return 1024 * max(kilobytes)


def _input_entry(path: Path, out: Path) -> dict[str, str]:
    kind = open_artefact(path).kind if path.is_dir() else DATA
    digest = digest_of(path / MANIFEST) if path.is_dir() else sha256_of(path)
    try:
        relative = os.path.relpath(path.absolute(), out.absolute())
    except ValueError:  # Windows: on another drive
        relative = str(path.absolute())
    return {"path": str(path), "relative": relative, "kind": kind, "sha256": digest}


def open_artefact(path: Path, kind: str | Sequence[str] | None = None) -> Artefact:
    """A complete artefact of ``kind`` (one, several, or None for any).

    A path that is missing or no artefact, a damaged manifest, another kind or a newer format is a ``UserError``.
    """
    manifest_path = path / MANIFEST
    if not path.exists():
        raise UserError("no such artefact", path, "Check the path, or run the stage that makes it.")
    if not path.is_dir() or not manifest_path.is_file():
        raise UserError(f"not an artefact (no {MANIFEST})", path, "Give the folder that a stage wrote.")
    manifest = read_manifest(manifest_path)
    kinds = (kind,) if isinstance(kind, str) else kind
    if kinds is not None and manifest["kind"] not in kinds:
        fault = f"this is a {manifest['kind']!r} artefact, but {' or '.join(kinds)} is needed"
        raise UserError(fault, path, "Give the right folder.")
    return Artefact(path, manifest)


def find_artefacts(run: Path, kind: str) -> list[Artefact]:
    """All complete artefacts of ``kind`` below ``run`` (and ``run`` itself), sorted by path."""
    if not run.is_dir():
        raise UserError("no such run", run, "Give the folder of a run.")
    near = [path.parent for path in visible(run, MANIFEST) if len(path.relative_to(run).parts) <= DEPTH + 1]
    return [artefact for artefact in map(open_artefact, near) if artefact.kind == kind]


def check_files(artefact: Artefact) -> list[str]:
    """One line for each file of the artefact that is missing or changed."""
    return [f"{name}: {fault}" for name, fault in file_faults(artefact).items()]


def file_faults(artefact: Artefact) -> dict[str, str]:
    """What is wrong with the files that an artefact's manifest lists, by name."""
    listed = artefact.manifest["files"].items()
    return {name: fault for name, digest in listed if (fault := file_fault(artefact.path, name, digest))}


def extra_files(artefact: Artefact) -> list[str]:
    """Files in the artefact's folder that its manifest should list; artefacts and drafts within are ignored."""
    listed, present = {MANIFEST, *artefact.manifest["files"]}, []
    for place, folders, names in os.walk(artefact.path):
        inner = [Path(place, name) for name in folders if not name.endswith(drafts.PARTIAL)]
        inner = [path for path in inner if not (path / MANIFEST).exists()]
        folders[:] = sorted(path.name for path in inner if not path.is_symlink())
        files = [*(Path(place, name) for name in names), *(path for path in inner if path.is_symlink())]
        present += [path.relative_to(artefact.path).as_posix() for path in sorted(files)]
    return [name for name in present if name not in listed and Path(name).name != TO_FILL_IN]


def file_fault(folder: Path, name: str, digest: str) -> str:
    """What is wrong with a file of an artefact; empty if it is whole."""
    path = inside(folder, name)
    if path is None:
        return "outside the artefact"
    if not path.is_file():
        return "missing"
    try:
        return "" if sha256_of(path) == digest else "changed since it was written"
    except UserError as error:
        return _of_file(error)


def find_input(folder: Path, entry: dict[str, str], *, beside: bool = False) -> tuple[Path | None, str]:
    """The path of an input recorded in ``folder``'s manifest, and ""; or None and what is wrong.

    It is looked for at its relative path, then, unless ``beside``, at its recorded path. A stranger may have written
    these paths: they are only read from, and only a file with the recorded sha256 is accepted.
    """
    fault = "gone"
    for candidate in (folder / entry["relative"], *(() if beside else (Path(entry["path"]),))):
        is_data = entry["kind"] == DATA
        target = candidate if is_data else candidate / MANIFEST
        try:
            if not target.is_file():
                continue
            digest = sha256_of(target) if is_data else digest_of(target)
            if digest == entry["sha256"]:
                return candidate.resolve(), ""
            fault = "changed since"
        except UserError as error:
            fault = _of_file(error)
        except OSError:
            continue
    return None, fault


def _of_file(error: UserError) -> str:
    """What is wrong with a file that :func:`sha256_of` refuses."""
    return error.what.removeprefix(f"{THE_FILE} ")
