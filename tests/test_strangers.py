"""Files of strangers that would not end, numbers that are none, words that lead out of a run (Spec G2)."""

import hashlib
import json
import os
from collections.abc import Iterator
from math import nan
from pathlib import Path
from typing import Any

import pytest
import torch
from command_line import refuses
from toy_data import fill, reseal, write

from hypogoal.cli import main
from hypogoal.core.artefacts import create_artefact, find_input, open_artefact, sha256_of
from hypogoal.core.errors import UserError
from hypogoal.core.files import json_lines, parse_json, read_bytes, read_json
from hypogoal.core.own_code import allow
from hypogoal.core.tensors import save_tensors
from hypogoal.experiments.cells import Cell, Plan
from hypogoal.experiments.planning import make_plan
from hypogoal.experiments.records import LOGS, PLAN, log_of, open_log, read_plan, write_plan
from hypogoal.experiments.toml_file import read_toml
from hypogoal.hypotheses.networks import load_network

ENDLESS = ("/proc/self/pagemap", "/proc/cpuinfo", "/sys/fs/cgroup/cgroup.procs")
SMALL = {"sub_goals": ["one"], "members": 1}


@pytest.mark.parametrize("path", [path for path in map(Path, ENDLESS) if path.exists()])
def test_no_more_is_read_than_a_files_size(tmp_path: Path, path: Path) -> None:
    """Spec G2: the kernel's files have a size of 0 and may never end; of 275 GB in 0 bytes nothing is read."""
    (tmp_path / "link.json").symlink_to(path)
    for place in (path, tmp_path / "link.json"):
        assert sha256_of(place) == hashlib.sha256().hexdigest() and read_bytes(place, "it is", "") == b""
        with pytest.raises(UserError, match="not valid JSON"):
            read_json(place, "the file is", "")


def test_a_file_that_is_all_hole_is_not_read(tmp_path: Path) -> None:
    """Spec G2: 8 TB that take no place on the disk, in an archive neither; a small one is read."""
    path = tmp_path / "hole"
    path.write_bytes(b"x" * 5000)
    os.truncate(path, 2**43)
    with pytest.raises(UserError, match="nearly all hole"):
        sha256_of(path)
    os.truncate(path, 2**20)
    assert read_bytes(path, "it is", "") == b"x" * 5000 + bytes(2**20 - 5000)


@pytest.mark.parametrize("place", ["/proc/self/pagemap", "/dev/zero", "hole", "folder", "pipe", "/proc/self/fd/0"])
def test_an_input_that_never_ends(tmp_path: Path, place: str) -> None:
    """Spec G2: a manifest's input may be called anything, and is only believed when it is a file."""
    (tmp_path / "folder").mkdir()
    os.mkfifo(tmp_path / "pipe")
    (tmp_path / "hole").touch()
    os.truncate(tmp_path / "hole", 2**43)
    path = tmp_path / place  # an absolute one stays itself
    run = tmp_path / "run"
    data = write(tmp_path / "data.h5")
    with create_artefact(run / "ensemble", kind="ensemble", config=SMALL, seed=0, inputs=[data]) as folder:
        fill(folder, "ensemble", SMALL)
    (entry,) = open_artefact(run / "ensemble").manifest["inputs"]
    for relative in (os.path.relpath(path, run / "ensemble"), entry["relative"]):
        reseal(run / "ensemble", inputs=[entry | {"path": str(path), "relative": relative, "sha256": "0" * 64}])
        (changed,) = open_artefact(run / "ensemble").manifest["inputs"]
        assert find_input(run / "ensemble", changed)[0] is None
        refuses("the data that", "evaluate", run)


PLAN_FAULTS: list[tuple[str, Any]] = [
    ("workers", 0), ("workers", -1), ("workers", True), ("workers", 1.5), ("workers", "2"), ("workers", 10**400),
    ("workers", None),
    ("experiment", 3), ("experiment", None), ("cells", {}), ("cells", 7), ("anew", "data"),
    ("format", None), ("format", -1), ("format", "1"),
]  # fmt: skip
CELL_FAULTS: list[tuple[str, Any]] = [
    ("arguments", ["evaluate", "/"]), ("arguments", ["report", "/"]), ("arguments", ["evaluate", "{run}/.."]),
    ("arguments", ["evaluate", "{run}", "--out", "/x"]), ("arguments", []),
    ("arguments", ["rm"]), ("arguments", ["verify", "{run}"]),
    ("arguments", ["collect", "doorkey", "--out", "{run}/../x"]),
    ("arguments", ["collect", "{run}/../../x", "--out", "{run}/data.h5"]), ("arguments", "collect"),
    ("arguments", ["collect", "--out=/x", "--out", "{run}/data.h5"]), ("arguments", [["collect"], 3]),
    ("arguments", ["collect", "doorkey", "--force", "--out", "{run}/data.h5"]), ("out", "{run}"), ("out", "/x"),
    ("out", "{run}/../x"), ("out", 3), ("needs", ["/"]), ("needs", ["@/x"]), ("needs", ["{run}/none"]),
    ("needs", "{run}"), ("axes", []), ("axes", 3), ("axes", {"seed": []}), ("cores", None), ("cores", 0),
    ("cores", 2.5), ("name", "../x"), ("name", "ensemble-seed-0"),
]  # fmt: skip
OWN = """
format = 1
evaluate = true
axes = { seed = [0, 1] }
cells = [
  { name = "data", command = "collect doorkey --set heldout_layouts=1" },
  { name = "ensemble", axes = ["seed"], command = "train-ensemble {data} --seed {seed}" },
]
"""


@pytest.fixture
def swept(tmp_path: Path) -> Path:
    """The folder of a sweep that was begun: its plan, its first cell's record and log."""
    (tmp_path / "own.toml").write_text(OWN)
    run = tmp_path / "run"
    write_plan(run, make_plan(read_toml(tmp_path / "own.toml"), run))
    (run / LOGS).mkdir()
    (run / LOGS / "data.log").write_text("started\n")
    (run / LOGS / "data.json").write_text('{"attempts": 1, "seconds": 2.0, "code": 2, "started": 0.0, "host": "here"}')
    return run


def looked_at(run: Path) -> Iterator[list[str]]:
    """The commands that only look at a sweep."""
    for words in (["--status"], ["--status", "--json"], ["--gather"]):
        yield ["sweep", "--out", str(run), *words]


def test_a_plan_says_what_can_be(swept: Path) -> None:
    """Spec G2, G4: every number in bounds, every cell of a stage that stays in the run; the plan as written is read."""
    assert [main(words) for words in looked_at(swept)] == [0, 0, 0]
    plan = json.loads((swept / PLAN).read_text())
    changes = [{key: value} for key, value in PLAN_FAULTS]
    for key, value in CELL_FAULTS:
        first, *rest = plan["cells"]
        changes.append({"cells": [first | {key: value}, *rest]})
    for change in changes:
        (swept / PLAN).write_text(json.dumps(plan | change))
        for words in looked_at(swept):
            refuses("the sweep's plan is", *words)


@pytest.mark.parametrize(
    "record",
    [
        {"attempts": 10**400}, {"seconds": 10**400}, {"seconds": 1e300}, {"seconds": -1e300}, {"started": -(10**400)},
        {"code": 2.5}, {"code": 10**400}, {"host": ["x"]}, {"attempts": True}, {"more": 1}, [], "x", "[" * 100_000,
    ],
)  # fmt: skip
def test_a_record_says_what_can_be(swept: Path, capsys: pytest.CaptureFixture[str], record: Any) -> None:
    """Spec G2: one that cannot be is none."""
    path = swept / LOGS / "data.json"
    whole = json.loads(path.read_text())
    path.write_text(json.dumps(whole | record) if isinstance(record, dict) else str(record))
    assert [main(words) for words in looked_at(swept)] == [0, 0, 0]


@pytest.mark.parametrize(
    "line", [", 1.2.3 s left)", f", {'9' * 400} h left)", ", . s left)", ", 1e999 s left)", ", -1 s left)", "٣ s left)"]
)
def test_a_log_ends_with_anything(swept: Path, capsys: pytest.CaptureFixture[str], line: str) -> None:
    """Spec G2: what a cell said last is shown, and what time it says is left only where that is a time."""
    (cell, *_) = read_plan(swept).cells
    log_of(swept, cell).write_text(f"started\ntrain: 1/2 (3/s{line}\n", encoding="utf-8")
    with open_log(swept, cell):
        capsys.readouterr()
        assert [main(words) for words in looked_at(swept)] == [0, 0, 0]
    told = capsys.readouterr().out
    assert "time left: " in told and "1 running" in told


DEEP = "[" * 100_000


@pytest.mark.parametrize("text", [DEEP, DEEP + "]" * 100_000, '{"a":' * 100_000, "9" * 401, "-" + "9" * 20, "9" * 9999])
def test_json_is_read_by_one_rule(tmp_path: Path, text: str) -> None:
    """Spec G2: in files and in lines of logs, depth and integers are bounded; numbers not there yet may be NaN."""
    with pytest.raises(UserError, match="not valid JSON"):
        parse_json(text, tmp_path, "it is", "")
    inner = f'{{"step": 1, "x": {text}}}'
    assert [*json_lines([inner, '{"step": 2, "x": NaN}', text])] == [{"step": 2, "x": pytest.approx(nan, nan_ok=True)}]


@pytest.mark.parametrize("text", [DEEP, "9" * 401, '{"step": 1', '{"sub_goal": "one", "step": 1e999}', "{}"])
def test_a_log_of_an_artefact_holds_anything(tmp_path: Path, capsys: pytest.CaptureFixture[str], text: str) -> None:
    """Spec G2: those who show, gather and mirror logs leave out what is none, or say in one line what is wrong."""
    run = tmp_path / "run"
    run.mkdir()
    out = run / "ensemble"
    with create_artefact(out, kind="ensemble", config=SMALL, seed=0) as folder:
        fill(folder, "ensemble", SMALL)
        (folder / "metrics.jsonl").write_text(f'{text}\n{{"step": 3, "sub_goal": "one", "loss": 0.5}}\n')
    words = ("train-ensemble", "x.h5", "--out", str(out))
    write_plan(run, Plan("mine", [Cell("ensemble", words, out)], 1))
    for command in (["show", run], ["sweep", "--out", run, "--gather"]):
        code = main([str(word) for word in command])
        lines = capsys.readouterr().err.splitlines()
        assert code == 0 or (code == 2 and len(lines) == 1 and "an artefact is damaged" in lines[0]), lines


def test_a_type_that_is_not_kept_is_not_written(tmp_path: Path) -> None:
    """Spec G2: what is written is read; a network of one's own may have any type."""
    with pytest.raises(UserError, match=r"of type torch\.bfloat16 are not kept \(at x\): a"):
        save_tensors(tmp_path / "a.safetensors", {"x": torch.zeros(2, dtype=torch.bfloat16)})
    assert not any(tmp_path.iterdir())


def test_a_network_that_could_not_be_kept_is_not_trained(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Spec B6, G2: said when it is made, not after days of training."""
    monkeypatch.syspath_prepend(str(tmp_path))
    (tmp_path / "halves.py").write_text("""
import torch
def layers(channels): return [torch.nn.Conv2d(channels, 2, 1).bfloat16(), torch.nn.ReLU()], (4,)
class encoder(torch.nn.Module):
    def __init__(self, channels):
        super().__init__()
        self.register_buffer("known", torch.zeros(2).half())
    def forward(self, x): return x.flatten(1)
""")
    for name, kind in (("layers", "bfloat16"), ("encoder", "float16")):
        allow([f"halves:{name}"])
        with pytest.raises(UserError, match=rf"keeps weights of type torch\.{kind}.*float32"):
            load_network(f"halves:{name}")((8, 8, 3))
