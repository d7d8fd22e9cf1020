"""What stands at an output's place: ``--force`` replaces only what the stage itself makes there (Spec A6, G2).

A wrong ``--out`` is one slip of the hand; what it hits may be months of work, or nothing of ours.
"""

from __future__ import annotations

import contextlib
import zipfile
from pathlib import Path

from hypogoal.core.errors import UserError
from hypogoal.core.files import read_json
from hypogoal.core.hdf5 import Busy, open_hdf5
from hypogoal.core.manifests import MANIFEST, MAX_MANIFEST_BYTES

DATA, ARRAYS = "data", "arrays"  # the kinds of outputs that are files: HDF5 and .npz
HDF5 = b"\x89HDF\r\n\x1a\n"
FRONT = 1 << 16  # bytes in which the attributes of a file of ours begin
AWAY = "Move it away, or choose another --out."


def check_kind(out: Path, kind: str) -> None:
    """Check that what is there is an empty folder, or of the kind that is to be made: whole or damaged.

    Raises:
        UserError: it is something else.
    """
    if out.is_dir():
        if not any(out.iterdir()):
            return
        if not (out / MANIFEST).is_file():
            raise UserError(f"what stands there is not of kind {kind!r}: a folder that has no manifest", out, AWAY)
        found = _manifest_kind(out)
        if found != kind:
            what = f"it is of kind {found!r}" if found else "its manifest cannot be read"
            raise UserError(f"what stands there is not of kind {kind!r}: {what}", out, AWAY)
    elif not (out.is_file() and {DATA: _is_data, ARRAYS: _is_arrays}.get(kind, lambda path: False)(out)):
        raise UserError(f"what stands there is not of kind {kind!r}: another file", out, AWAY)


def _manifest_kind(folder: Path) -> str:
    """The kind that a manifest says, whatever else is wrong with it; empty where it cannot be read."""
    with contextlib.suppress(UserError):
        manifest = read_json(folder / MANIFEST, "the manifest is", "", MAX_MANIFEST_BYTES)
        if isinstance(manifest, dict) and "format" in manifest and isinstance(manifest.get("kind"), str):
            return str(manifest["kind"])
    return ""


def _is_data(path: Path) -> bool:
    """Whether a file is one of collected states: HDF5 with names of sub-goals, which stand in front if it is cut off.

    Raises:
        Busy: another program writes it.
    """
    with path.open("rb") as raw:
        begin = raw.read(FRONT)
    if not begin.startswith(HDF5):
        return False
    try:
        with open_hdf5(path, "the file", AWAY) as file:
            return "sub_goals" in file.attrs
    except Busy:
        raise
    except UserError:
        return b"sub_goals" in begin


def _is_arrays(path: Path) -> bool:
    try:
        with zipfile.ZipFile(path) as file:
            return "observations.npy" in file.namelist()
    except (OSError, zipfile.BadZipFile):
        return False
