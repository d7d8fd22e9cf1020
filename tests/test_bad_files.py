"""Files that are missing, damaged, of another kind or newer: one line, exit code 2, nothing left behind (Spec G2)."""

import json
from collections.abc import Callable
from itertools import product
from pathlib import Path

import h5py
import numpy as np
import pytest
from command_line import fails, refuses, run, settings
from PIL import Image

from hypogoal.core.artefacts import MANIFEST
from tests.attacks.fuzz import CHANGES, Sandbox, outcome_of

PICTURE = b"\x89PNG\r\n\x1a\n" + bytes(range(200))
# File of a run -> the command that reads it.
READERS = {
    "data.h5": "train-ensemble {run}/data.h5 --out {out}",
    "ensemble/manifest.json": "train-options {run}/ensemble --out {out}",
    "ensemble/left-end.safetensors": "train-options {run}/ensemble --out {out}",
    "options/options.safetensors": "train-meta {run}/ensemble --options {run}/options --out {out}",
    "meta/meta.safetensors": "report {run} --force --videos 1",
    "meta/episodes.csv": "evaluate {run} --out {out}",
    "meta/choices.csv": "evaluate {run} --out {out}",
    "meta/layout.json": "evaluate {run} --out {out}",
    "options-more/visited.h5": "train-ensemble {run}/data.h5 --unlabelled {run}/options-more --out {out}",
    "evaluation/run.json": "report {run} --force",
    "evaluation/arrays.h5": "report {run} --force",
    "evaluation/film.gif": "report {run} --force",
    "own/preset.toml": "train-ensemble {run}/data.h5 --preset {run}/own/preset.toml --out {out}",
    "own/experiment.toml": "run {run}/own/experiment.toml --out {out} --dry-run",
    "own/arrays.npz": "import {run}/own/arrays.npz --out {out}",
    "own/pictures/positive/0.png": "import {run}/own/pictures --out {out}",
}
TEXTS = (".json", ".csv", ".toml")
Damage = Callable[[Path], object]
DAMAGES: dict[str, Damage] = {
    "missing": Path.unlink,
    "cut off": lambda path: path.write_bytes(path.read_bytes()[: path.stat().st_size // 2]),
    "empty": lambda path: path.write_bytes(b""),
    "of another kind": lambda path: path.write_bytes(PICTURE if path.suffix != ".png" else b"step\n1\n"),
    "no UTF-8": lambda path: path.write_bytes(b"\xff" + path.read_bytes()),
}
# Of a file that a manifest lists every change is found in the same way, by its hash.
OF_LISTED = ("missing", "cut off")
# What a cut text may still be, and what is not looked for by its name.
HARMLESS = {("own/preset.toml", "empty"), ("own/pictures/positive/0.png", "missing"), ("own/preset.toml", "cut off")}


@pytest.fixture
def there(corridor_copy: Path) -> Path:
    """A run, and beside its stages what people bring of their own."""
    own = corridor_copy / "own"
    own.mkdir()
    (own / "preset.toml").write_text("[train-ensemble]\nmembers = 2\nsteps = 2\ndiversity_weight = 0.01\n")
    (own / "experiment.toml").write_text(
        'format = 1\nevaluate = false\n[[cells]]\nname = "data"\ncommand = "collect doorkey"\n'
    )
    states = np.arange(20 * 3).reshape(20, 3).astype(np.float32)
    np.savez(own / "arrays.npz", observations=states, labels=np.arange(20) < 10, unlabelled=states)
    for number, kind in enumerate(("negative", "positive", "unlabelled")):
        (own / "pictures" / kind).mkdir(parents=True)
        for index in range(4):
            picture = np.full((20, 20, 3), 40 * number + index, np.uint8)
            Image.fromarray(picture).save(own / "pictures" / kind / f"{index}.png")
    return corridor_copy


def words_for(name: str, there: Path) -> list[str]:
    out = there.parent / "out" / "made"
    out.parent.mkdir(exist_ok=True)
    return [*READERS[name].format(run=there, out=out).split(), "-q"]


def cases() -> list[tuple[str, str]]:
    """Each file with each damage that is one of its own."""
    found = []
    for name, damage in product(READERS, DAMAGES):
        is_listed = not name.startswith("own/") and not name.endswith((MANIFEST, "data.h5"))
        if is_listed and damage not in OF_LISTED:
            continue
        if damage == "no UTF-8" and not name.endswith(TEXTS):
            continue
        if (name, damage) not in HARMLESS:
            found.append((name, damage))
    return found


@pytest.mark.parametrize(("name", "damage"), cases())
def test_a_bad_file_is_one_line(there: Path, name: str, damage: str) -> None:
    """Spec A8, G2: which file it is, for the stage that reads it, and for ``verify`` if a manifest knows it."""
    path = there / name
    DAMAGES[damage](path)
    refuses(path.name if damage != "missing" else "", *words_for(name, there))
    known = damage != "missing" or path.name not in (MANIFEST, "data.h5")  # of a copy's input the original is there
    if "own" not in name and known:
        assert path.name in fails("verify", path.parent if path.suffix != ".h5" else there).out


@pytest.mark.parametrize("name", ["data.h5", "ensemble/manifest.json", "own/experiment.toml"])
def test_a_newer_file_is_one_line(there: Path, name: str) -> None:
    """Spec G2: what to do is to upgrade."""
    path = there / name
    if path.suffix == ".h5":
        with h5py.File(path, "a") as file:
            file.attrs["format"] = 99
    elif path.name == MANIFEST:
        path.write_text(json.dumps(json.loads(path.read_text()) | {"format": 99}))
    else:
        path.write_text(path.read_text().replace("format = 1", "format = 99"))
    refuses("format", *words_for(name, there))


@pytest.mark.parametrize("name", ["own/preset.toml", "own/experiment.toml"])
def test_a_byte_order_mark_is_read(there: Path, name: str) -> None:
    """What some editors put first in a text."""
    path = there / name
    path.write_bytes(b"\xef\xbb\xbf" + path.read_bytes())
    run(*words_for(name, there), *(settings("workers=1") if "preset" in name else []))


LAST = {"csv": 13}  # case, else the fifth; the first is 1, since case 0 takes seconds


@pytest.fixture
def box(corridor_run: Path, tmp_path: Path) -> Sandbox:
    return Sandbox(corridor_run, tmp_path)


@pytest.mark.parametrize("name", CHANGES)
def test_every_case_is_read_or_refused(box: Sandbox, name: str) -> None:
    """Spec G2: nothing but ``UserError`` of one line, and nothing outside the output is touched."""
    outcomes = {outcome_of(box, name, case) for case in range(1, LAST.get(name, 5) + 1)}
    assert "refused" in outcomes and outcomes <= {"accepted", "refused"}
