"""The store: an output is whole or absent, has one writer, and is continued only by what began it (Spec A8, G1, G2)."""

import errno
import json
import os
import shutil
import signal
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from toy_data import reseal

from hypogoal.core.artefacts import DATA, MANIFEST, Artefact, open_artefact
from hypogoal.core.drafts import Draft, create
from hypogoal.core.errors import Complete, UserError
from hypogoal.core.hdf5 import create_hdf5
from hypogoal.evaluation.run import find_artefacts

ABOUT: dict[str, Any] = {"kind": "meta", "config": {"steps": 3, "world": {"rooms": 2}}, "seed": 7}


def stop(out: Path, error: BaseException, *, checkpoint: bool = True, **about: Any) -> None:
    """A stage that stops with ``error``, after its first checkpoint if it has one."""
    with create(out, **{**ABOUT, **about}) as draft:
        (draft.files / "half.csv").write_text("x")
        if checkpoint:
            draft.checkpoints().save({"step": 1})
        raise error


def finish(out: Path, **about: Any) -> int:
    """A stage that continues and ends; returns the step at which it continued."""
    with create(out, **{**ABOUT, **about}) as draft:
        step = (draft.checkpoints().load() or {"step": 0})["step"]
        (draft.files / "whole.csv").write_text("y")
    return int(step)


def contents(folder: Path) -> dict[str, bytes]:
    return {path.relative_to(folder).as_posix(): path.read_bytes() for path in folder.rglob("*") if path.is_file()}


def test_a_manifest_says_what_made_it(tmp_path: Path) -> None:
    source, out = tmp_path / "ensemble", tmp_path / "meta"
    finish(source, kind="ensemble")
    finish(out, inputs=[source])
    artefact = open_artefact(out, "options", "meta")
    assert (artefact.kind, artefact.config, artefact.seed) == ("meta", ABOUT["config"], 7)
    assert artefact.input("ensemble") == source and artefact.manifest.files.keys() == {"whole.csv"}
    assert {"python", "torch", "numpy"} <= artefact.manifest.versions.keys()
    assert 0 <= artefact.manifest.took["seconds"] < 60
    assert artefact.faults() == [] and find_artefacts(tmp_path, "meta")[0].path == out


def test_artefacts_are_found_at_any_depth(tmp_path: Path) -> None:
    """Cells may have names of any depth; drafts are hidden."""
    deep = tmp_path / "meta" / "dbat" / "size-3" / "seed-0"
    for out in (deep, tmp_path / "meta" / "dbat" / ".draft"):
        finish(out)
    assert [artefact.path for artefact in find_artefacts(tmp_path, "meta")] == [deep]


def test_white_space_and_took_are_no_change(tmp_path: Path) -> None:
    """An editor and git's line ends may change a manifest; another seed in it is another input."""
    source, out = tmp_path / "ensemble", tmp_path / "meta"
    finish(source, kind="ensemble")
    finish(out, inputs=[source])
    manifest = json.loads((source / MANIFEST).read_text())
    for text in (json.dumps(manifest), json.dumps(manifest, indent=4).replace("\n", "\r\n")):
        (source / MANIFEST).write_bytes(b"\xef\xbb\xbf" + text.encode())
        assert Artefact(out).faults() == []
    reseal(source, took={"seconds": 9.9})
    assert Artefact(out).faults() == []
    reseal(source, seed=8)
    assert Artefact(out).faults() == [f"its input {source} (ensemble) is changed since it was written"]


def test_faults_are_named(tmp_path: Path) -> None:
    """Missing and changed files and inputs; to open an artefact its own files must be whole."""
    data, out = tmp_path / "data.h5", tmp_path / "meta"
    data.write_text("states")
    finish(out, inputs=[data])
    data.unlink()
    assert Artefact(out).faults() == [f"its input {data} (data) is missing"] and open_artefact(out)
    with pytest.raises(UserError, match=r"the data that .* was made from is missing"):
        Artefact(out).input(DATA)
    (out / "whole.csv").write_text("changed")
    assert Artefact(out).faults()[0] == "whole.csv is changed since it was written"
    (out / "whole.csv").unlink()
    with pytest.raises(UserError, match=r"the artefact is damaged \(whole.csv is missing\)"):
        open_artefact(out)


def test_what_is_not_what_is_needed(tmp_path: Path) -> None:
    finish(tmp_path / "meta")
    cases: list[tuple[Callable[[], object], str]] = [
        (lambda: open_artefact(tmp_path / "none"), "no such artefact"),
        (lambda: open_artefact(tmp_path / "meta", "ensemble", "options"), "but ensemble or options is needed"),
        (lambda: Artefact(tmp_path / "meta").input("ensemble"), "was not made from any ensemble"),
        (lambda: Artefact(tmp_path / "meta").config["stepz"], "lacks a setting: stepz"),
    ]
    for case, words in cases:
        with pytest.raises(UserError, match=words):
            case()


def test_a_moved_run_finds_its_inputs(tmp_path: Path) -> None:
    """Beside the artefact; if nothing is there, where they were. What is beside it and was changed is changed."""
    run, data = tmp_path / "Läufe 1", tmp_path / "data.h5"
    data.write_text("states")
    finish(run / "ensemble", kind="ensemble", inputs=[data])
    finish(run / "meta", inputs=[run / "ensemble"])
    shutil.copytree(run, tmp_path / "far" / "kopiert ü")
    moved = Artefact(tmp_path / "far" / "kopiert ü" / "meta")
    assert moved.input("ensemble") == moved.path.parent / "ensemble"
    assert Artefact(moved.input("ensemble")).input(DATA) == data
    reseal(moved.path.parent / "ensemble", seed=8)
    with pytest.raises(UserError, match="changed since"):
        moved.input("ensemble")


def test_resume_continues(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The manifest has the command; what is complete is complete, with another torch, too."""
    out = tmp_path / "meta"
    monkeypatch.setattr("sys.argv", ["/usr/bin/hypogoal", "train-meta", "--resume"])
    with pytest.raises(KeyError):
        stop(out, KeyError())
    assert Draft(out).is_resumable and not Draft(out).is_locked and not out.exists()
    assert finish(out, resume=True) == 1 and os.listdir(tmp_path) == ["meta"]
    manifest = open_artefact(out).manifest
    assert manifest.files.keys() == {"half.csv", "whole.csv"} and manifest.command == ["hypogoal", "train-meta"]
    reseal(out, versions={"torch": "0.1"}, config=ABOUT["config"] | {"gone": 1, "workers": 4})
    with pytest.raises(Complete):
        finish(out, resume=True)
    assert finish(tmp_path / "other", resume=True) == 0


OTHERS: list[tuple[dict[str, Any], str]] = [
    ({"seed": 8}, "seed=7, not 8"),
    ({"config": {"steps": 4, "world": {"rooms": 2}}}, "steps=3, not 4"),
    ({"config": {"steps": 3, "world": {"rooms": 1}}}, "world={'rooms': 2}, not {'rooms': 1}"),
    ({"inputs": ["data.h5"]}, "other inputs"),
]


@pytest.mark.parametrize(("change", "words"), OTHERS)
def test_what_was_begun_otherwise_is_not_continued(tmp_path: Path, change: dict[str, Any], words: str) -> None:
    """Nor is what was made otherwise complete."""
    (tmp_path / "data.h5").write_text("states")
    change = {**change, "inputs": [tmp_path / name for name in change.get("inputs", ())]}
    with pytest.raises(KeyError):
        stop(tmp_path / "begun", KeyError())
    finish(tmp_path / "made")
    for name, subject in (("begun", "unfinished output was begun"), ("made", "complete output was made")):
        with pytest.raises(UserError, match=f"the {subject} with {words}"):
            finish(tmp_path / name, **change, resume=True)
    assert Draft(tmp_path / "begun").is_resumable
    assert finish(tmp_path / "begun", **change, force=True) == 0


def test_other_versions_and_damaged_drafts_are_not_continued(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Another torch need not give the same bytes; another number of processes does."""
    out = tmp_path / "meta"
    with pytest.raises(KeyError):
        stop(out, KeyError(), config={"workers": 4})
    with monkeypatch.context() as patch:
        patch.setattr("hypogoal.core.drafts.versions", lambda: {"torch": "9.9"})
        with pytest.raises(UserError, match="begun with torch="):
            finish(out, resume=True)
    begun = Draft(out).begun.read_text()
    for text, words in (("{", "the manifest cannot be read"), ('{"identity": {}}', "kind: Field required")):
        Draft(out).begun.write_text(text)
        with pytest.raises(UserError, match=words):
            finish(out, resume=True)
    Draft(out).begun.write_text(begun)
    assert finish(out, config={"workers": 1}, resume=True) == 1


def test_nothing_is_lost_by_mistake(tmp_path: Path) -> None:
    """A draft needs --resume or --force, a complete output --force; it stands until the new one is whole."""
    out = tmp_path / "meta"
    finish(out)
    with pytest.raises(UserError, match="the output exists already"):
        finish(out)
    with pytest.raises(KeyError):
        stop(out, KeyError(), force=True)
    assert open_artefact(out).manifest.files.keys() == {"whole.csv"}
    with pytest.raises(UserError, match="an unfinished output exists"):
        finish(out)
    assert finish(out, resume=True) == 1
    assert open_artefact(out).manifest.files.keys() == {"half.csv", "whole.csv"}
    with pytest.raises(KeyError):
        stop(out, KeyError(), force=True, checkpoint=False)
    assert open_artefact(out) and os.listdir(tmp_path) == ["meta"]


def test_force_replaces_only_what_a_stage_made_there(tmp_path: Path) -> None:
    """No output of another kind, no file of others', no input, however wrong the --out."""
    finish(tmp_path / "ensemble", kind="ensemble")
    finish(tmp_path / "unreadable")
    (tmp_path / "unreadable" / MANIFEST).write_text("{")
    (tmp_path / "link").symlink_to("ensemble")
    (tmp_path / "mine").mkdir()
    for name in ("mine/thesis.txt", "foreign.h5"):
        (tmp_path / name).write_text("precious")
    before = contents(tmp_path)
    for name in ("ensemble", "unreadable", "mine", "foreign.h5"):
        for kind in ("meta", DATA):
            with pytest.raises(UserError, match="what is there is not of kind"):
                finish(tmp_path / name, kind=kind, force=True)
    for out, path in (("ensemble", "link"), ("link", "ensemble"), (".", "ensemble")):
        with pytest.raises(UserError, match="would replace an input"):
            finish(tmp_path / out, kind="ensemble", inputs=[tmp_path / path], force=True)
    assert contents(tmp_path) == before
    (tmp_path / "empty").mkdir()
    assert finish(tmp_path / "empty") == 0


def test_a_data_file_is_renamed_when_whole(tmp_path: Path) -> None:
    """It has no manifest: what made it is in it."""
    out, about = tmp_path / "ein Pfad ü" / "data.h5", {"kind": DATA, "config": {"domain": "toy", "steps": 3}, "seed": 7}

    def write(*, fails: bool = False, **more: Any) -> None:
        with create(out, **{**about, **more}) as draft:
            with create_hdf5(draft.files / out.name) as file:
                file.attrs.update({"sub_goals": "[]", "domain": "toy", "seed": 7, "config": '{"steps": 3}'})
            if fails:
                raise KeyError

    with pytest.raises(KeyError):
        write(fails=True)
    assert os.listdir(out.parent) == []
    write()
    before = out.read_bytes()
    with pytest.raises(Complete):
        write(resume=True)
    with pytest.raises(UserError, match="made with steps=3, not 4"):
        write(resume=True, config={"domain": "toy", "steps": 4})
    with pytest.raises(KeyError):
        write(fails=True, force=True)
    assert out.read_bytes() == before
    write(force=True)
    assert os.listdir(out.parent) == ["data.h5"]


HOLD = """
import sys, signal
from pathlib import Path
from hypogoal.core.drafts import create
with create(Path(sys.argv[1]), kind="meta", config={}, seed=0) as draft:
    print("begun", flush=True)
    signal.pause()
"""


def test_the_second_of_two_writers_is_refused(tmp_path: Path) -> None:
    """When the first is killed, its lock is nobody's, and what it left is replaced."""
    out = tmp_path / "meta"
    with subprocess.Popen([sys.executable, "-c", HOLD, str(out)], stdout=subprocess.PIPE, text=True) as other:
        assert other.stdout is not None and other.stdout.readline() == "begun\n"
        assert Draft(out).is_locked
        for how in ({"force": True}, {"resume": True}):
            with pytest.raises(UserError, match="another process is writing this"):
                finish(out, **how)
        other.send_signal(signal.SIGKILL)
    assert not Draft(out).is_locked and Draft(out).folder.exists()
    assert finish(out) == 0 and os.listdir(tmp_path) == ["meta"]


@pytest.mark.parametrize("code", [errno.ENOLCK, errno.EOPNOTSUPP, errno.EBADF, errno.EIO])
def test_a_disk_without_locks_is_told(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, code: int) -> None:
    """Spec G2: one line; nothing is left there, but for an earlier draft."""

    def refuse(*_: object) -> None:
        raise OSError(code, os.strerror(code))

    with pytest.raises(ValueError, match="the last checkpoint is kept"):
        stop(tmp_path / "begun", ValueError())
    before = contents(tmp_path)
    monkeypatch.setattr("fcntl.flock", refuse)
    for name in ("begun", "new"):
        with pytest.raises(UserError, match=r"no file can be locked here \(.*--out on another disk"):
            finish(tmp_path / name)
    assert contents(tmp_path) == before


def test_a_kill_between_two_renames_loses_nothing(tmp_path: Path) -> None:
    """The new output was whole: it is put in place by the next command, which is told that it is there."""
    out = tmp_path / "meta"
    finish(out)

    def dies(old: Path, new: Path) -> None:
        """A process that is killed after the first of two renames leaves its draft as it is."""
        os.rename(old, new)
        os._exit(9)

    child = os.fork()
    if not child:
        Path.rename = dies  # type: ignore[assignment, method-assign]
        finish(out, seed=8, force=True)
    assert os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]) == 9
    assert not out.exists()
    with pytest.raises(Complete):
        finish(out, seed=8, resume=True)
    assert open_artefact(out).seed == 8 and os.listdir(tmp_path) == ["meta"]
