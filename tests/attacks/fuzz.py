"""Spec G2: thousands of damaged files, read by what reads them.

``python -m tests.attacks.fuzz RUN [--cases 5000]`` damages files of a whole run, a case at a time, and counts. A case
fails when something else than success or a ``UserError`` of one line comes of it, or another file changes.
"""

import argparse
import contextlib
import faulthandler
import io
import json
import random
import shutil
import sys
import tempfile
from collections import Counter
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from typing import Any

import h5py
import numpy as np

import hypogoal
from hypogoal import cli
from hypogoal.core.artefacts import MANIFEST, sha256_of
from hypogoal.core.errors import UserError

Call = Callable[[], object]
Rng = random.Random
ODD = ["", "x" * 300, "\n", "ünï", "NaN", "1,2", "../x", "module:object", 0, -1, 2, 10_000, 0.5, float("nan"),
       float("inf"), None, True, [], {}, [[]], {"a": {}}, [1, "a", None]]  # fmt: skip


def bytes_changed(data: bytes, rng: Rng) -> bytes:
    """One to four small changes anywhere, or a cut."""
    changed = bytearray(data)
    for _ in range(rng.choice((1, 1, 2, 4))):
        at = rng.randrange(max(1, min(len(changed), rng.choice((2048, len(changed))))))
        size = rng.choice((1, 8, 64, 512))
        kind = rng.randrange(4)
        if kind == 0:
            changed[at : at + 1] = bytes([rng.randrange(256)])
        elif kind == 1:
            del changed[at : at + size]
        elif kind == 2:
            changed[at:at] = changed[at : at + size]
        else:
            del changed[at:]
    return bytes(changed)


def tree_changed(tree: Any, rng: Rng) -> bytes:
    """A JSON file of which one to three values are replaced, removed or added."""
    for _ in range(rng.choice((1, 1, 2, 3))):
        places = list(places_in(tree))
        if not places:
            break
        holder, key = rng.choice(places)
        odd = json.loads(json.dumps(rng.choice(ODD)))  # a copy: it may be changed in turn
        kind = rng.randrange(4)
        if kind <= 1:
            holder[key] = odd
        elif kind == 2:
            del holder[key]
        elif isinstance(holder, dict):
            holder[f"{key}_"] = odd
        else:
            holder.append(odd)
    return json.dumps(tree).encode()


def places_in(tree: Any) -> Iterator[tuple[Any, Any]]:
    """Each list or object within a JSON value, with each of its keys."""
    if not isinstance(tree, dict | list):
        return
    for key in tree if isinstance(tree, dict) else range(len(tree)):
        yield tree, key
        yield from places_in(tree[key])


def json_changed(data: bytes, rng: Rng) -> bytes:
    return tree_changed(json.loads(data), rng)


def cell_changed(data: bytes, rng: Rng) -> bytes:
    """A cell of a CSV file."""
    rows = [line.split(",") for line in data.decode().splitlines()]
    row = rng.choice(rows)
    row[rng.randrange(len(row))] = str(rng.choice(ODD))
    return "\n".join(",".join(cells) for cells in rows).encode() + b"\n"


def header_changed(data: bytes, rng: Rng) -> bytes:
    """A safetensors file's header, or the length that it says to have."""
    size = int.from_bytes(data[:8], "little")
    if rng.random() < 0.2:
        length = rng.choice((0, 1, size - 1, size + 1, 2**31, 2**63, 2**64 - 1))
        return length.to_bytes(8, "little") + data[8:]
    header = data[8 : 8 + size]
    if rng.random() < 0.3:  # another type of as many bytes
        return data[:8] + header.replace(b"F32", rng.choice((b"I32", b"U32"))) + data[8 + size :]
    text = json_changed(header, rng)
    return len(text).to_bytes(8, "little") + text + data[8 + size :]


def dataset_changed(data: bytes, rng: Rng) -> bytes:
    """An attribute of an HDF5 file, or nothing, fewer states, other shapes or types in a dataset's place."""
    stored = io.BytesIO(data)
    with h5py.File(stored, "r+") as file:
        names: list[str] = []
        file.visit(names.append)
        if file.attrs and rng.random() < 0.4:
            file.attrs[rng.choice(sorted(file.attrs))] = rng.choice([7, -1, 0.5, "[[]]", "null", "../x"])
            return stored.getvalue()
        name = rng.choice(names)
        values = np.atleast_1d(file[name][()]) if isinstance(file[name], h5py.Dataset) else np.zeros(3)
        others: list[Any] = [
            None, values[:0], values[: len(values) // 2], 1, values[..., None], np.full(values.shape, 0.5),
            np.full(values.shape[:1], np.nan), "a text", h5py.Empty("u1"),
        ]  # fmt: skip
        del file[name]
        other = rng.choice(others)
        if other is not None:
            file[name] = other
    return stored.getvalue()


# Format -> what is changed in its files, besides any bytes.
CHANGES: dict[str, Callable[[bytes, Rng], bytes]] = {
    "json": json_changed,
    "jsonl": bytes_changed,
    "csv": cell_changed,
    "safetensors": header_changed,
    "h5": dataset_changed,
}


class Sandbox:
    """A copy of a whole run, of which cases damage a copy; everything but ``out`` must stay as it is."""

    def __init__(self, whole: Path, root: Path):
        self.whole, self.run, self.out = root / "whole", root / "run", root / "out"
        shutil.copytree(whole, self.whole)
        self.before = self.look()

    def look(self) -> dict[Path, tuple[int, int]]:
        """Size and time of the last change of what no case may change."""
        return {path: (path.stat().st_size, path.stat().st_mtime_ns) for path in self.whole.rglob("*")}

    def fresh(self) -> None:
        """The whole run again, and an empty output."""
        for folder in (self.run, self.out):
            shutil.rmtree(folder, ignore_errors=True)
        shutil.copytree(self.whole, self.run)
        self.out.mkdir()


def command(*words: object) -> None:
    """Run a command that must succeed or refuse; raises ``UserError`` where it refuses."""
    said = io.StringIO()
    with contextlib.redirect_stdout(io.StringIO()), contextlib.redirect_stderr(said):
        code = cli.main([str(word) for word in words])
    if code == 2:
        raise UserError(said.getvalue().strip())
    if code:
        raise AssertionError(f"{words[0]} ended with {code}: {said.getvalue()[-300:]}")


def is_accepted(calls: list[Call]) -> bool:
    """Whether all calls succeed; a ``UserError`` of one line is no failure."""
    accepted = True
    for call in calls:
        try:
            call()
        except UserError as error:
            accepted = False
            if "\n" in str(error) or not str(error).isprintable():
                raise AssertionError(f"not one printable line: {str(error)!r}") from None
    return accepted


def readers(box: Sandbox, path: Path, case: int) -> list[Call]:
    """What reads a file of the run; commands that take long at times."""
    run, artefact = box.run, path.parent
    calls: list[Call] = [partial(command, "verify", artefact), partial(command, "show", artefact)]
    if artefact.name == "ensemble":
        calls.append(partial(hypogoal.load_ensemble, artefact, "left-end"))
    if artefact.name.startswith(("options", "meta")):
        calls.append(partial(hypogoal.load_options, artefact))
    if case % 10 == 0:
        calls.append(partial(command, "evaluate", run, "--out", box.out / "evaluation", "-q"))
        calls.append(partial(command, "report", run, "--force"))
    return calls


def damaged_file(name: str, box: Sandbox, rng: Rng, case: int) -> list[Call]:
    """One file of a format is damaged; the manifest mostly says that it was so from the start."""
    path = rng.choice(sorted(box.run.rglob(f"*.{name}")))
    change = CHANGES[name] if rng.random() < 0.6 else bytes_changed
    path.write_bytes(change(path.read_bytes(), rng))
    manifest = path.parent / MANIFEST
    if path.name != MANIFEST and manifest.exists() and rng.random() < 0.9:
        content = json.loads(manifest.read_bytes())
        content["files"][path.name] = sha256_of(path)
        manifest.write_text(json.dumps(content), encoding="utf-8")
    return readers(box, path, case)


def outcome_of(box: Sandbox, name: str, case: int) -> str:
    """``accepted``, ``refused``, or what was wrong."""
    box.fresh()
    rng = random.Random(f"{name} {case}")
    try:
        outcome = "accepted" if is_accepted(damaged_file(name, box, rng, case)) else "refused"
    except Exception as error:  # noqa: BLE001 - that nothing else escapes is what is tested
        outcome = f"{type(error).__name__}: {error}"
    return outcome if box.look() == box.before else "a file outside the output was changed"


def main() -> int:
    """Run the fuzz; exit code 1 when a case failed."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("run", type=Path)
    parser.add_argument("--cases", type=int, default=5000)
    given = parser.parse_args()
    faulthandler.enable()  # a library may crash on damaged bytes
    failed = 0
    with tempfile.TemporaryDirectory() as folder:
        box = Sandbox(given.run, Path(folder))
        for name in CHANGES:
            outcomes = Counter(outcome_of(box, name, case) for case in range(given.cases))
            faults = outcomes.keys() - {"accepted", "refused"}
            failed += len(faults)
            print(f"{name}: {outcomes['accepted']} accepted, {outcomes['refused']} refused", *faults, sep="\n  ")
    return bool(failed)


if __name__ == "__main__":
    sys.exit(main())
