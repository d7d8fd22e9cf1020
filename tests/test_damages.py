"""One table of damages: what is wrong with a file is one line, for ``verify`` and for the stage that reads it."""

from __future__ import annotations

import json
import struct
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import torch
from command_line import fails, refuses
from safetensors.torch import save_file
from toy_data import fill, reseal, write

from hypogoal.core.artefacts import create_artefact, sha256_of
from hypogoal.core.errors import UserError
from hypogoal.core.manifests import MANIFEST
from hypogoal.core.tensors import load_tensors


def faults_told(path: Path) -> str:
    """What ``verify`` prints of something that is not whole."""
    said = fails("verify", path)
    assert said.err == ""
    return said.out


# Keys of a manifest, or all of its text, and the words for what is wrong with it.
MANIFESTS: list[tuple[dict[str, Any] | str, str]] = [
    ({"format": 99}, "newer"),
    ({"files": 3}, "'files'"),
    ({"files": {"a": 3}}, "'files'"),
    ({"kind": None}, "'kind'"),
    ({"inputs": [{"path": 3}]}, "'inputs'"),
    ({"inputs": [{"path": "\0", "relative": "", "kind": "", "sha256": ""}]}, "'inputs'"),
    ({"config": {"members": 10**9}}, "'members'"),
    ({"config": {"sub_goals": ["../x"]}}, "'sub_goals'"),
    ({"config": {"observation_shape": [10**9, 2, 3]}}, "'observation_shape'"),
    ({"seed": -1}, "'seed'"),
    ({"seed": True}, "'seed'"),
    ("", "not valid JSON"),
    ("[]", "not a JSON object"),
    ("{", "not valid JSON"),
    ('{"a": NaN}', "not valid JSON"),
    ("[" * 10**6, "not valid JSON"),
    ('{"a": ' * 40 + "1" + "}" * 40, "not valid JSON"),
    ('{"a": "\\ud800"}', "not valid JSON"),
    ("9" * 10_000, "not valid JSON"),
    ("\xff", "not valid JSON"),
]
ENSEMBLE = {"sub_goals": ["one"], "members": 1}


def ensemble(out: Path) -> Path:
    """An ensemble with all its files and nothing in them."""
    with create_artefact(out, kind="ensemble", config=ENSEMBLE, seed=0) as folder:
        fill(folder, "ensemble", ENSEMBLE)
    return out


@pytest.mark.parametrize(("change", "words"), MANIFESTS, ids=range(len(MANIFESTS)))
def test_manifests(tmp_path: Path, change: dict[str, Any] | str, words: str) -> None:
    """Spec A8, G2."""
    out = ensemble(tmp_path / "ensemble")
    if isinstance(change, dict):
        reseal(out, **change)
    else:
        (out / MANIFEST).write_text(change, encoding="latin-1")
    assert words in faults_told(out)
    refuses(words, "show", out)
    refuses(words, "train-options", out, "--out", tmp_path / "out" / "options", "-q")


def header(length: int) -> bytes:
    """Weights whose header says that it is so long."""
    return struct.pack("<Q", length)


def typed(kind: str, bits: int) -> bytes:
    """Weights of one type."""
    text = json.dumps({"x": {"dtype": kind, "shape": [8], "data_offsets": [0, bits]}}).encode()
    return header(len(text)) + text + bytes(bits)


# Bits of the eight numbers of each type that nobody writes.
TYPES = {"F4": 4, "F8_E4M3": 8, "F8_E5M2": 8, "F8_E4M3FNUZ": 8, "F8_E5M2FNUZ": 8, "F8_E8M0": 8, "F6_E2M3": 6,
         "BF16": 16, "F16": 16, "C64": 64, "I8": 8, "I16": 16, "U16": 16, "U32": 32, "U64": 64, "XX": 8}  # fmt: skip
WEIGHTS = {kind: typed(kind, bits) for kind, bits in TYPES.items()}
WEIGHTS |= {str(length): header(length) for length in (0, 10, 2**31, 2**63, 2**64 - 1)}


@pytest.mark.parametrize("case", WEIGHTS)
def test_weights(tmp_path: Path, case: str) -> None:
    """Spec G2: lengths are claims, types are those that we write; ``verify`` goes on to what else is wrong."""
    save_file({"a": torch.zeros(4)}, tmp_path / "a.safetensors")
    start = WEIGHTS[case]
    rest = (tmp_path / "a.safetensors").read_bytes()[8:] if len(start) == 8 else b""
    out = tmp_path / "ensemble"
    with create_artefact(out, kind="ensemble", config=ENSEMBLE, seed=0) as folder:
        fill(folder, "ensemble", ENSEMBLE)
        (folder / "one.safetensors").write_bytes(start + rest)
        (folder / "metrics.jsonl").write_text("[" * 100_000)
    told = faults_told(out).splitlines()
    assert len(told) == 2 and all(line.isprintable() for line in told)
    assert sum("one.safetensors" in line and ("of type torch." in line or "are damaged" in line) for line in told) == 1
    with pytest.raises(UserError, match=r"are not kept|are damaged"):
        load_tensors(out / "one.safetensors")


def cut(data: bytes) -> bytes:
    return data[: len(data) // 2]


def garbled(data: bytes) -> bytes:
    return b"step,wrong\n1\n"


# File of a run -> what is done to it, and the command that reads it; every one is in a manifest.
FILES: list[tuple[str, Callable[[bytes], bytes], str]] = [
    ("ensemble/left-end.safetensors", cut, "train-options {run}/ensemble --out {out}"),
    ("options/options.safetensors", cut, "train-meta {run}/ensemble --options {run}/options --out {out}"),
    ("meta/meta.safetensors", cut, "report {run} --force --videos 1"),
    ("meta/episodes.csv", garbled, "evaluate {run} --out {out}"),
    ("meta/choices.csv", garbled, "evaluate {run} --out {out}"),
    ("meta/exploits.csv", garbled, "evaluate {run} --out {out}"),
    ("meta/layout.json", garbled, "evaluate {run} --out {out}"),
    ("options-more/visited.h5", cut, "train-ensemble {run}/data.h5 --unlabelled {run}/options-more --out {out}"),
    ("evaluation/metrics.json", garbled, "report {run} --force"),
    ("evaluation/arrays.h5", cut, "report {run} --force"),
]


@pytest.mark.parametrize(("name", "damage", "command"), FILES)
def test_files_of_a_run(corridor_copy: Path, name: str, damage: Callable[[bytes], bytes], command: str) -> None:
    """Spec A8, G2: both where the manifest tells that it is changed and where it does not; nothing is left behind."""
    path = corridor_copy / name
    path.write_bytes(damage(path.read_bytes()))
    artefact = path.parent
    assert f"{path.name}: changed since it was written" in faults_told(artefact)
    words = command.format(run=corridor_copy, out=corridor_copy.parent / "out" / "made").split()
    refuses(path.name, *words, "-q")
    files = json.loads((artefact / MANIFEST).read_bytes())["files"]
    reseal(artefact, files=files | {path.name: sha256_of(path)})
    assert path.name in faults_told(artefact)
    refuses(path.name, *words, "-q")


# A TOML file's text -> words for what is wrong with it, as a preset and as an experiment.
BROKEN_TOML = {
    "a = " + "[" * 100_000: "not valid TOML",
    "a = " + "9" * 5_000: "not valid TOML",
    "\0": "not valid TOML",
    # Of 300 kB of keys within keys tomllib would make nothing in an hour.
    "a." * 1000 + "a = 1": "not valid TOML (more than 256 dots in line 1)",
    "[" + '".".' * 1000 + "a]": "not valid TOML (more than 256 dots in line 1)",
    "x = {" + "a . " * 1000 + "a = 1}": "not valid TOML (more than 256 dots in line 1)",
    # Python reads hexadecimals of any length, and prints decimals of 4,300 digits at most.
    f"[run]\nlayout_seeds = [0x{'f' * 9999}]": "not valid TOML (Exceeds the limit",
    "[settings.a]\nvalue = [0x" + "f" * 500 + "]": "not valid TOML",
    "[settings.a]\nvalue = 9007199254740992": "not valid TOML",
    "[settings.a]\nvalue = -9007199254740992": "not valid TOML",
    "[train-ensemble]\nmembers = " + "9" * 400: "not valid TOML",
    "train-ensemble = 3": "",
    "# " + "x" * 2**20: "",
}


@pytest.mark.parametrize("text", BROKEN_TOML, ids=range(len(BROKEN_TOML)))
def test_toml_files(tmp_path: Path, text: str) -> None:
    """Spec G2: odd depths and sizes, one rule for presets and experiments; numbers have the bounds of JSON's."""
    path, words = tmp_path / "own.toml", BROKEN_TOML[text]
    path.write_text(text)
    train = ["train-ensemble", write(tmp_path / "data.h5", domain="doorkey"), "--out", tmp_path / "out"]
    assert len(refuses(words, *train, "--preset", path)) < 1000
    assert len(refuses(words, "sweep", path, "--out", tmp_path / "out", "--dry-run")) < 1000


@pytest.mark.parametrize("value", ["1979-05-27", "{a = 1}", "inf", "[[1]]"])
def test_values_of_a_preset(tmp_path: Path, value: str) -> None:
    """Spec G2: types that no setting has."""
    path = tmp_path / "own.toml"
    path.write_text(f"[train-ensemble]\nmembers = {value}\n")
    train = ["train-ensemble", write(tmp_path / "data.h5", domain="doorkey"), "--out", tmp_path / "out"]
    refuses("wrong type of value: members=", *train, "--preset", path)
