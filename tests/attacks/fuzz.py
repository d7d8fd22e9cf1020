"""Spec G2: thousands of damaged files, read by what reads them.

``python -m tests.attacks.fuzz RUN [--cases 5000] [--format json]`` damages files of a whole run, a
case at a time, and counts. A case fails when something else than success or a ``UserError`` of one line comes
of it, when it takes longer than ``SECONDS``, or when a file outside its output changes.
"""

from __future__ import annotations

import argparse
import contextlib
import faulthandler
import io
import json
import random
import shutil
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Callable
from functools import partial
from pathlib import Path

import hypogoal
from hypogoal import cli
from hypogoal.core.artefacts import MANIFEST, sha256_of
from hypogoal.core.config import MODELS
from hypogoal.core.errors import UserError
from hypogoal.experiments.named import EXPERIMENTS
from tests.attacks import mutations
from tests.attacks.kills import TOY

SECONDS = 300.0  # of the clock: the machine may be busy
CHANGES: dict[str, Callable[[bytes, random.Random], bytes]] = {
    "json": mutations.json_changed,
    "jsonl": mutations.bytes_changed,
    "csv": mutations.table_changed,
    "safetensors": mutations.weights_changed,
    "h5": mutations.hdf5_changed,
    "toml": mutations.toml_changed,
}
PRESET = Path(cli.__file__).with_name("presets") / "doorkey" / "demo.toml"
Call = Callable[[], object]


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
        calls += [partial(command, "verify", run), partial(command, "show", run)]
        calls.append(partial(command, "evaluate", run, "--out", box.out / "evaluation", "-q"))
    if case % 50 == 0:
        few = ("--set", "steps=20", "--set", "workers=1", "-q")
        calls.append(partial(command, "report", run, "--force"))
        calls.append(partial(command, "train-ensemble", run / "data.h5", "--out", box.out / "ensemble", *few))
    return calls


def damaged_file(name: str, box: Sandbox, rng: random.Random, case: int) -> list[Call]:
    """One file of a format is damaged; the manifest mostly says that it was so from the start."""
    path = rng.choice(sorted(box.run.rglob(f"*.{name}")))
    path.write_bytes(CHANGES[name](path.read_bytes(), rng))
    manifest = path.parent / MANIFEST
    if path.name != MANIFEST and manifest.exists() and rng.random() < 0.9:
        content = json.loads(manifest.read_bytes())
        content["files"][path.name] = sha256_of(path)
        manifest.write_text(json.dumps(content), encoding="utf-8")
    return readers(box, path, case)


def damaged_toml(box: Sandbox, rng: random.Random, case: int) -> list[Call]:
    """A preset, for every stage and experiment; an experiment."""
    path, out = box.out / "own.toml", ("--out", box.out / "run", "--dry-run")
    path.write_bytes(CHANGES["toml"](PRESET.read_bytes() if case % 2 else TOY.encode(), rng))
    if case % 2 == 0:
        return [partial(command, "run", path, *out)]
    calls: list[Call] = [partial(command, "config", stage, "--preset", path) for stage in MODELS]
    return calls + [partial(command, "run", name, "--preset", path, *out) for name in EXPERIMENTS]


def outcome_of(box: Sandbox, name: str, case: int) -> str:
    """``accepted``, ``refused``, or what was wrong."""
    box.fresh()
    begun = time.monotonic()
    rng = random.Random(f"{name} {case}")
    try:
        calls = damaged_toml(box, rng, case) if name == "toml" else damaged_file(name, box, rng, case)
        outcome = "accepted" if is_accepted(calls) else "refused"
    except Exception as error:  # noqa: BLE001 - that nothing else escapes is what is tested
        outcome = f"{type(error).__name__}: {error}"
    if box.look() != box.before:
        outcome = "a file outside the output was changed"
    seconds = time.monotonic() - begun
    return outcome if seconds < SECONDS else f"took {seconds:.0f} s"


def main() -> int:
    """Run the fuzz; exit code 1 when a case failed."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("run", type=Path)
    parser.add_argument("--cases", type=int, default=5000)
    parser.add_argument("--format", action="append", choices=CHANGES)
    given = parser.parse_args()
    faulthandler.enable()  # a library may crash on damaged bytes
    failed = 0
    with tempfile.TemporaryDirectory() as folder:
        box = Sandbox(given.run, Path(folder))
        for name in given.format or CHANGES:
            counts: Counter[str] = Counter()
            for case in range(given.cases):
                outcome = outcome_of(box, name, case)
                counts[outcome] += 1
                if outcome not in ("accepted", "refused"):
                    failed += 1
                    print(f"{name} case {case}: {outcome}", file=sys.stderr, flush=True)
            print(f"{name}: {counts['accepted']} accepted, {counts['refused']} refused", flush=True)
    print(f"{failed} failed")
    return bool(failed)


if __name__ == "__main__":
    sys.exit(main())
