"""Outputs in the making. Each output is made in a hidden draft, which is renamed when it is whole.

The draft of ``NAME`` is the folder ``.NAME.partial/``. It has ``files/`` (the future output), ``checkpoint/`` (see
``core.checkpoints``), ``begun.json`` (what was asked for) and ``lock``, which the working process holds.
"""

import contextlib
import json
import os
import shutil
import sys
import time
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from filelock import FileLock, Timeout, lock_descriptor

from hypogoal.core.artefacts import (
    DATA,
    MANIFEST,
    TO_FILL_IN,
    Artefact,
    Input,
    Manifest,
    kind_of,
    manifest_of,
    open_artefact,
    read_manifest,
    sha256_of,
    versions,
)
from hypogoal.core.checkpoints import ANEW, Checkpoints
from hypogoal.core.errors import Complete, UserError
from hypogoal.core.files import replace_text, sync

PATIENCE_SECONDS = 2.0  # to wait for the lock, because a process that is just ending may still hold it
NO_RESULT = ("workers",)  # settings that change no result


class Draft:
    """An output in the making, which :func:`create` gives to be filled.

    Attributes:
        files: the folder to fill. A data file is written into this folder under the output's name.
    """

    def __init__(self, out: Path):
        self.out = out.resolve()
        self.folder = self.out.with_name(f".{self.out.name}.partial")
        self.files = self.folder / "files"
        self.begun = self.folder / "begun.json"
        self.checkpoint = self.folder / "checkpoint"
        self.lock = self.folder / "lock"

    def checkpoints(self, name: str = "stage") -> Checkpoints:
        """Return the checkpoints named ``name``."""
        return Checkpoints(self.checkpoint / f"{name}.safetensors")

    @property
    def is_resumable(self) -> bool:
        """Whether there is a checkpoint from which to continue."""
        return self.begun.is_file() and any(self.checkpoint.glob("*.safetensors"))

    @property
    def is_locked(self) -> bool:
        """Whether a process is working on the draft."""
        try:
            with self.lock.open("r+b") as file:
                return not lock_descriptor(file.fileno(), blocking=False)
        except OSError:
            return False

    @contextlib.contextmanager
    def locked(self) -> Iterator[None]:
        """Hold the lock within the block. Raises ``UserError`` if another process holds the lock.

        At the end of the block, the draft is removed if it has neither a checkpoint nor a finished output.
        """
        lock = FileLock(self.lock, timeout=PATIENCE_SECONDS)
        is_new = not self.folder.exists()
        self.folder.mkdir(parents=True, exist_ok=True)
        try:
            lock.acquire()
        except (Timeout, FileNotFoundError):  # the file is not found if its owner has just removed the folder
            do = "Wait until it is done, or choose another --out."
            raise UserError("another process is writing this", self.out, do) from None
        except OSError as error:
            if error.filename:
                raise
            if is_new:
                shutil.rmtree(self.folder)
            do = "Choose an --out on another disk, or mount this one with locks (flock)."
            raise UserError(f"no file can be locked here ({error.strerror})", self.out.parent, do) from None
        try:
            yield
        finally:
            if not self.is_resumable and not (self.files / MANIFEST).is_file():
                self._clear()
                shutil.rmtree(self.folder, ignore_errors=True)  # after all else, because the lock is in it
            lock.release()

    def begin(self, wanted: Manifest) -> None:
        """Remove what an earlier process left, and begin anew."""
        self._clear()
        self.files.mkdir()
        replace_text(self.begun, wanted.text())

    def _clear(self) -> None:
        self.begun.unlink(missing_ok=True)  # first, because a draft without this file is never resumed
        for folder in (self.checkpoint, self.files):
            shutil.rmtree(folder, ignore_errors=True)


@contextlib.contextmanager
def create(
    out: Path,
    *,
    kind: str,
    config: Mapping[str, Any],
    seed: int,
    inputs: Sequence[Path] = (),
    force: bool = False,
    resume: bool = False,
) -> Iterator[Draft]:
    """Give a draft to fill. When the block ends, write the draft's manifest and move the draft to ``out``.

    If the block raises, ``out`` stays as it was, and the draft stays if it has a checkpoint. An output of kind ``DATA``
    is the one file in ``draft.files``, without a manifest.

    Args:
        out: the path of the output.
        kind: the kind of the output.
        config: what determines the output, beside ``seed``, ``inputs`` and versions. Keys that are added in the block
            are in the manifest.
        seed: the seed of the output.
        inputs: the artefacts and files from which the output is made.
        force: whether an existing output or draft is replaced.
        resume: whether an unfinished draft is continued.

    Raises:
        UserError: if ``out`` exists and ``force`` is not given, is of another kind or none of hypogoal's, would replace
            an input, or is being written by another process. Also if the draft of ``out`` has a checkpoint and neither
            ``force`` nor ``resume`` is given, or if the draft was begun with other settings, seed, inputs or versions.
        Complete: if ``resume`` is given, and the output is complete and was made with the settings, seed and inputs
            given.
    """
    started = time.monotonic()
    draft = Draft(out)
    wanted = Manifest(
        kind=kind,
        config=dict(config),
        seed=seed,
        inputs=[_input(path, draft.out) for path in inputs],
        versions=versions(),
        command=_command(),
    )
    with draft.locked():
        _put_in_place(draft)  # in case that a process was killed while it put the output in place
        if not _continues(draft, wanted, force=force, resume=resume):
            draft.begin(wanted)
        try:
            yield draft
            wanted.config = dict(config)
            wanted.took = {"seconds": round(time.monotonic() - started, 1)}
            _finish(draft, wanted)
        except BaseException as error:
            is_useless = isinstance(error, UserError) and error.do == ANEW  # the draft cannot be continued
            if draft.is_resumable and not is_useless:
                error.add_note("the last checkpoint is kept: give the same command with --resume to continue")
            raise


def _command() -> list[str]:
    """Return the command of this process, without ``--resume``, which changes no result."""
    program = Path(sys.argv[0]).name
    words = ["hypogoal" if program == "__main__.py" else program, *sys.argv[1:]]
    return [word for word in words if word != "--resume"]


def _input(path: Path, out: Path) -> Input:
    if path.resolve().is_relative_to(out):
        raise UserError("the output would replace an input", path, "Choose another --out.")
    kind = Artefact(path).kind if path.is_dir() else DATA
    relative = os.path.relpath(path.resolve(), out)
    return Input(kind=kind, path=str(path), relative=relative, sha256=sha256_of(path))


def _continues(draft: Draft, wanted: Manifest, *, force: bool, resume: bool) -> bool:
    """Return whether the draft is continued rather than begun anew.

    Raises ``UserError`` if ``out`` may not be written.
    """
    out, kind = draft.out, kind_of(draft.out)
    if kind not in (None, wanted.kind):
        do = "Move it away, or choose another --out."
        raise UserError(f"what is there is not of kind {wanted.kind!r}, or damaged", out, do)
    if draft.is_resumable and resume:
        begun = read_manifest(draft.begun, ANEW)
        _refuse_other(begun, wanted, "the unfinished output was begun")
        return True
    if draft.is_resumable and not force:
        raise UserError("an unfinished output exists", out, "Give --resume to continue it, or --force to begin anew.")
    if kind and resume:
        if kind != DATA:
            open_artefact(out)  # raises UserError if files were changed
        complete = manifest_of(out).model_copy(update={"versions": {}})  # versions do not matter for a complete output
        _refuse_other(complete, wanted, "the complete output was made")
        raise Complete(f"{out} is complete already")
    if kind and not force:
        raise UserError("the output exists already", out, "Choose another --out, or give --force to replace it.")
    return False


def _refuse_other(before: Manifest, now: Manifest, subject: str) -> None:
    """Raise ``UserError`` if the manifests differ in a setting that both have, in seed, inputs or versions."""
    old, new = _identity(before), _identity(now)
    for key, value in old.items():
        if key in new and json.dumps(value) != json.dumps(new[key]):
            other = "other inputs" if key == "inputs" else f"{key}={value}, not {new[key]}"
            raise UserError(f"{subject} with {other}", None, ANEW)


def _identity(manifest: Manifest) -> dict[str, Any]:
    """Return everything that determines an output, by name."""
    inputs = [entry.sha256 for entry in manifest.inputs]
    identity = {"seed": manifest.seed, "inputs": inputs, **manifest.versions, **manifest.config}
    return {key: value for key, value in identity.items() if key not in NO_RESULT}


def _finish(draft: Draft, manifest: Manifest) -> None:
    """Write the manifest of what is in the draft, and put the output in place."""
    files = [path for path in sorted(draft.files.rglob("*")) if path.is_file() and path.name != TO_FILL_IN]
    for path in files:
        sync(path)
        manifest.files[path.relative_to(draft.files).as_posix()] = sha256_of(path)
    if manifest.kind == DATA:
        [data] = files
        data.replace(draft.out)
        sync(draft.out.parent)
        shutil.rmtree(draft.checkpoint, ignore_errors=True)
    else:
        replace_text(draft.files / MANIFEST, manifest.text())
        _put_in_place(draft)


def _put_in_place(draft: Draft) -> None:
    """Rename a finished folder to the output. What was there before is moved aside first and removed last."""
    old = draft.folder / "old"
    if (draft.files / MANIFEST).is_file():
        shutil.rmtree(draft.checkpoint, ignore_errors=True)
        if draft.out.exists():
            draft.out.rename(old)
        draft.files.rename(draft.out)
        sync(draft.out.parent)
    shutil.rmtree(old, ignore_errors=True)
