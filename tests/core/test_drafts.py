"""Spec G1, G2: what a stage works on is its own, is gone on with only by what began it, and is never lost."""

import errno
import os
import resource
import shutil
import signal
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Any

import pytest
from toy_data import reseal

from hypogoal.cli import notes_of
from hypogoal.core.artefacts import claim, create_artefact, open_artefact
from hypogoal.core.checkpoints import checkpoints_of
from hypogoal.core.drafts import LOCK, check_complete, draft, draft_folder, put_in_place, unfinished
from hypogoal.core.errors import Complete, NumericalError, UserError
from hypogoal.core.files import write_table

ABOUT: dict[str, Any] = {"kind": "meta", "config": {"steps": 3, "chooser": "ppo"}, "seed": 7}


class Broken(Exception):
    """Something went wrong in a stage."""


def stop(out: Path, error: BaseException, checkpoint: bool = True, **about: Any) -> None:
    """A stage that stops with ``error`` after its first checkpoint, if it has one."""
    with create_artefact(out, **{**ABOUT, **about}) as folder:
        (folder / "half").write_text("x")
        if checkpoint:
            checkpoints_of(folder).save({"step": 1})
        raise error


def finish(out: Path, **about: Any) -> int:
    """A stage that goes on from where it was and ends; returns where that was."""
    with create_artefact(out, **{**ABOUT, **about}) as folder:
        step = (checkpoints_of(folder).load() or {"step": 0})["step"]
        (folder / "whole").write_text("y")
    return int(step)


def test_what_was_begun_is_gone_on_with(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Spec G1: with --resume; the artefact says the command that began it and has no checkpoint in it."""
    out = tmp_path / "meta"
    monkeypatch.setattr("sys.argv", ["/usr/bin/hypogoal", "train-meta", "--resume"])
    with pytest.raises(Broken):
        stop(out, Broken())
    assert unfinished(out) and not out.exists()
    monkeypatch.setattr("sys.argv", ["/usr/bin/hypogoal", "train-meta", "--quiet", "--resume"])
    assert finish(out, resume=True) == 1
    assert [path.name for path in tmp_path.iterdir()] == ["meta"]
    manifest = open_artefact(out).manifest
    assert set(manifest["files"]) == {"half", "whole"}
    assert manifest["command"] == ["hypogoal", "train-meta"]


def test_resume_where_nothing_was_begun_begins(tmp_path: Path) -> None:
    """Spec G1: nothing there, or nothing that could be gone on with."""
    assert finish(tmp_path / "meta", resume=True) == 0
    out = tmp_path / "other"
    with pytest.raises(Broken):
        stop(out, Broken(), checkpoint=False)
    assert not draft_folder(out).exists()
    (draft_folder(out) / "files").mkdir(parents=True)  # as a process leaves it that was killed early
    (draft_folder(out) / "files" / "half").write_text("x")
    assert finish(out, resume=True) == 0
    assert set(open_artefact(out).manifest["files"]) == {"whole"}


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"seed": 8}, "seed=7, not 8"),
        ({"config": {"steps": 4, "chooser": "ppo"}}, "steps=3, not 4"),
        ({"kind": "options"}, "kind=meta, not options"),
        ({"inputs": ["input.h5"]}, "other inputs"),
    ],
)
def test_another_stage_does_not_go_on(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, change: dict[str, Any], words: str
) -> None:
    """Spec G1, G2: another configuration, seed, kind or input is named in one line; --force begins anew."""
    monkeypatch.chdir(tmp_path)
    (tmp_path / "input.h5").write_text("states")
    change = {key: [Path(name) for name in value] if key == "inputs" else value for key, value in change.items()}
    out = tmp_path / "meta"
    with pytest.raises(Broken):
        stop(out, Broken())
    with pytest.raises(UserError, match=words) as caught:
        finish(out, **change, resume=True)
    assert "--force" in str(caught.value) and unfinished(out)
    assert finish(out, **change, force=True) == 0 and not draft_folder(out).exists()


def test_other_versions_do_not_go_on(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Spec G1: the same bytes are promised, and another torch need not give them."""
    out = tmp_path / "meta"
    with pytest.raises(Broken):
        stop(out, Broken())
    monkeypatch.setattr("hypogoal.core.artefacts.versions", lambda: {"torch": "9.9"})
    with pytest.raises(UserError, match=r"begun with (python|torch|hypogoal|numpy)="):
        finish(out, resume=True)


def test_what_other_versions_completed_is_complete(tmp_path: Path) -> None:
    """Spec G1: nothing is gone on with; settings that only one version has do not make it another one's."""
    out = tmp_path / "meta"
    finish(out)
    reseal(out, versions={"torch": "0.1"}, config={"steps": 3, "gone": 1})
    with pytest.raises(Complete, match=r"complete already"):
        finish(out, resume=True)
    with pytest.raises(UserError, match="was made with steps=3, not 4"):
        finish(out, config={"steps": 4}, resume=True)


def test_what_is_unfinished_is_not_begun_anew_by_mistake(tmp_path: Path) -> None:
    """Spec G1: neither flag, one line, before any work; --force says so."""
    out = tmp_path / "meta"
    with pytest.raises(Broken):
        stop(out, Broken())
    with pytest.raises(UserError, match="an unfinished output exists"):
        claim(out, kind="meta")
    with pytest.raises(UserError, match="an unfinished output exists"):
        finish(out)
    assert unfinished(out) and claim(out, kind="meta", resume=True) and claim(out, kind="meta", force=True)


def test_a_full_disk_says_that_the_checkpoint_is_kept(tmp_path: Path) -> None:
    """Spec G1: or 'run it again' is done without --resume, and refused."""
    with pytest.raises(OSError, match="No space left") as caught:
        stop(tmp_path / "meta", OSError(errno.ENOSPC, os.strerror(errno.ENOSPC)))
    assert notes_of(caught.value) == ["the last checkpoint is kept: give the same command with --resume to continue"]


def test_a_damaged_draft_is_one_line(tmp_path: Path) -> None:
    """Spec G2."""
    out = tmp_path / "meta"
    with pytest.raises(Broken):
        stop(out, Broken())
    for text in ("{", "[]", '{"identity": 3, "command": []}', '{"identity": {}}'):
        (draft_folder(out) / "begun.json").write_text(text)
        with pytest.raises(UserError, match="damaged"):
            finish(out, resume=True)


def test_what_stops_a_stage_says_how_to_go_on(tmp_path: Path) -> None:
    """Spec G1, G3: Ctrl-C and NaN keep the last checkpoint and say so; where there is none they say nothing."""
    for number, error in enumerate((KeyboardInterrupt(2), NumericalError("a loss is NaN"))):
        with pytest.raises(type(error)) as caught:
            stop(tmp_path / str(number), error)
        assert any("--resume" in note for note in caught.value.__notes__)
        assert unfinished(tmp_path / str(number))
    with pytest.raises(KeyboardInterrupt) as stopped:
        stop(tmp_path / "early", KeyboardInterrupt(2), checkpoint=False)
    assert not hasattr(stopped.value, "__notes__")


def test_force_of_an_unfinished_replacement(tmp_path: Path) -> None:
    """Spec G2: what stood there stands there until the new one is whole; --resume then needs no second --force."""
    out = tmp_path / "meta"
    finish(out)
    with pytest.raises(Broken):
        stop(out, Broken(), force=True)
    assert set(open_artefact(out).manifest["files"]) == {"whole"}
    assert finish(out, resume=True) == 1
    assert set(open_artefact(out).manifest["files"]) == {"half", "whole"}


def test_a_death_between_two_renames_loses_nothing(tmp_path: Path) -> None:
    """Spec G2: what was moved aside comes back."""
    out = tmp_path / "meta"
    finish(out)
    out.rename(tmp_path / ".meta.old")
    with pytest.raises(Broken):
        stop(out, Broken(), force=True, checkpoint=False)
    assert set(open_artefact(out).manifest["files"]) == {"whole"}
    assert [path.name for path in tmp_path.iterdir()] == ["meta"]


def test_a_rename_that_fails_loses_nothing(tmp_path: Path) -> None:
    """Spec G2: what stood there is there again; another disk is one on which no rename ends."""
    finish(tmp_path / "meta")
    with tempfile.TemporaryDirectory(dir="/dev/shm" if os.path.isdir("/dev/shm") else None) as far:
        made = Path(far) / "made"
        made.mkdir()
        if made.stat().st_dev == tmp_path.stat().st_dev:
            pytest.skip("there is one disk only")
        with pytest.raises(OSError, match="cross-device"):
            put_in_place(made, tmp_path / "meta")
    assert os.listdir(tmp_path) == ["meta"] and os.listdir(tmp_path / "meta")


def test_a_command_that_could_not_be_read_again_begins_nothing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Spec A8, G2: a manifest says the command, and is UTF-8."""
    monkeypatch.setattr("sys.argv", ["hypogoal", os.fsdecode(b"\xff")])
    with pytest.raises(UserError, match="not valid JSON"):
        finish(tmp_path / "meta")
    assert os.listdir(tmp_path) == []


def test_what_another_process_finished_meanwhile_is_not_replaced(tmp_path: Path) -> None:
    """Spec A6, G2: both saw nothing there; the later one is told before it works, not after."""
    out = tmp_path / "meta"
    claim(out, kind="meta")
    finish(out)
    for resume in (False, True):
        with pytest.raises(UserError, match="exists already"), draft(out, {}, resume=resume):
            raise AssertionError("it worked")
    assert set(open_artefact(out).manifest["files"]) == {"whole"}


def test_who_is_refused_leaves_no_draft(tmp_path: Path) -> None:
    """Spec G2: a process that comes too late, after the other has tidied up, makes no folder that nobody needs."""
    out = tmp_path / "out"
    out.mkdir()
    with pytest.raises(UserError, match="exists already"), draft(out, {}):
        raise AssertionError
    assert [*tmp_path.iterdir()] == [out]


def test_the_lock_goes_last(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Spec G1: who gets it while the rest is still being removed would lose what it has just begun."""
    gone: list[str] = []
    unlink = os.unlink

    def noted(path: Any, **more: Any) -> None:
        gone.append(Path(path).name)
        unlink(path, **more)

    monkeypatch.setattr("os.unlink", noted)
    with draft(tmp_path / "out", {}) as work:
        checkpoint = checkpoints_of(work.files)
        for number in range(9):
            (work.files / str(number)).touch()
            checkpoint.save({"a": number})
    assert len(gone) >= 12 and gone[-1] == LOCK and not draft_folder(tmp_path / "out").exists()


def test_an_output_that_is_a_link_is_made_where_it_leads(tmp_path: Path) -> None:
    """Spec A8: another disk, say; nothing is there yet, an empty folder is, or something to be replaced."""
    far, near = tmp_path / "far", tmp_path / "near"
    far.mkdir()
    near.mkdir()
    out, there = near / "meta", far / "there"
    out.symlink_to(there)
    finish(out)
    there.rename(far / "moved")
    there.mkdir()
    with pytest.raises(Broken):
        stop(out, Broken(), force=True)
    assert unfinished(out) and os.listdir(near) == ["meta"]
    assert finish(out, resume=True) == 1
    finish(out, force=True)
    assert out.is_symlink() and os.listdir(near) == ["meta"] and sorted(os.listdir(far)) == ["moved", "there"]
    assert set(open_artefact(there).manifest["files"]) == {"whole"}


def test_a_link_that_an_earlier_version_moved_aside_is_removed(tmp_path: Path) -> None:
    """Spec G2: as a link; what it leads to stays."""
    (tmp_path / "far").mkdir()
    (tmp_path / "far" / "mine").write_text("precious")
    (tmp_path / ".meta.old").symlink_to(tmp_path / "far")
    (tmp_path / "meta").mkdir()
    finish(tmp_path / "meta", force=True)
    assert sorted(os.listdir(tmp_path)) == ["far", "meta"] and os.listdir(tmp_path / "far") == ["mine"]


def test_the_folder_one_is_in_can_be_the_output(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Spec A8: ``--out .``"""
    here = tmp_path / "here"
    here.mkdir()
    monkeypatch.chdir(here)
    finish(Path("."), force=True)
    assert open_artefact(here, "meta") and os.listdir(tmp_path) == ["here"]


def test_no_room_leaves_nothing(tmp_path: Path) -> None:
    """Spec G2: at whichever write the room ends, the first included."""
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    failed = 0
    for limit in (*range(0, 120, 8), *range(120, 1500, 60)):
        resource.setrlimit(resource.RLIMIT_FSIZE, (limit, hard))
        try:
            with create_artefact(tmp_path / "out", **ABOUT) as folder:
                (folder / "half").write_text("x" * 200)
                write_table(folder / "numbers.csv", ["a"], [["b" * 300]])
        except OSError:
            failed += 1
            assert os.listdir(tmp_path) == []
        else:
            assert os.listdir(tmp_path) == ["out"]
            shutil.rmtree(tmp_path / "out")
        finally:
            resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
    assert 20 < failed < 38


def test_want_of_memory_says_that_the_checkpoint_is_kept(tmp_path: Path) -> None:
    """Spec G1: and so does whatever else ends a stage, unless it says itself what to do about the checkpoint."""
    note = ["the last checkpoint is kept: give the same command with --resume to continue"]
    for number, error in enumerate((MemoryError(), RuntimeError("can't allocate memory"), UserError("your code"))):
        with pytest.raises(type(error)) as caught:
            stop(tmp_path / str(number), error)
        assert notes_of(caught.value) == note
    with pytest.raises(UserError) as refused:
        stop(tmp_path / "odd", UserError("it does not fit", None, "Give --force and no --resume to begin anew."))
    assert notes_of(refused.value) == []


WRITE = """
import os, signal, sys
from pathlib import Path
from hypogoal.core.drafts import draft
from hypogoal.core.files import replacing

folder, checkpoint = Path(sys.argv[1]), sys.argv[2:]
with replacing(folder / "arrays.npz") as fresh, draft(folder / "meta", {}, force=True) as work:
    fresh.write_bytes(b"x" * 1000)
    if checkpoint:
        (work.files.parent / "checkpoint").mkdir()
        (work.files.parent / "checkpoint" / "stage.safetensors").write_bytes(b"x")
    (folder / "meta").rename(folder / ".meta.old")
    print("written", flush=True)
    signal.pause()
"""


@pytest.mark.parametrize("checkpoint", [False, True])
def test_what_a_killed_process_left_is_removed(tmp_path: Path, checkpoint: bool) -> None:
    """Spec G2: temporary files by the next writer in the folder, a draft by the next of its output."""
    finish(tmp_path / "meta")
    (tmp_path / ".mine.partial").mkdir()  # no draft of ours
    (tmp_path / ".mine.partial" / "precious").touch()
    own = {".mine.partial", "meta", "other"}
    command = [sys.executable, "-c", WRITE, str(tmp_path), *(["x"] if checkpoint else [])]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as writer:
        assert writer.stdout is not None and writer.stdout.readline() == "written\n"
        hidden = {f".arrays.npz.{writer.pid}.new", ".meta.partial", ".meta.old"}
        finish(tmp_path / "other")
        assert {*os.listdir(tmp_path)} == {".mine.partial", "other", *hidden}
        writer.send_signal(signal.SIGKILL)
    finish(tmp_path / "other", force=True)
    assert {*os.listdir(tmp_path)} == {".mine.partial", "other", ".meta.partial", ".meta.old"}
    finish(tmp_path / "meta", force=True)
    assert {*os.listdir(tmp_path)} == own


HOLD = """
import sys, time
from pathlib import Path
from hypogoal.core.artefacts import create_artefact
with create_artefact(Path(sys.argv[1]), kind="meta", config={}, seed=0):
    print("begun", flush=True)
    time.sleep(60)
"""


def test_two_processes_do_not_write_one_output(tmp_path: Path) -> None:
    """Spec G2: the second is told who writes it; when the first was killed, its lock is nobody's."""
    out = tmp_path / "meta"
    with subprocess.Popen([sys.executable, "-c", HOLD, str(out)], stdout=subprocess.PIPE, text=True) as other:
        assert other.stdout is not None and other.stdout.readline() == "begun\n"
        for attempt in (
            lambda: claim(out, kind="meta"),
            lambda: finish(out, force=True),
            lambda: finish(out, resume=True),
        ):
            with pytest.raises(UserError, match=f"process {other.pid} on .* is writing this"):
                attempt()
        other.send_signal(signal.SIGKILL)
        other.wait()
    assert draft_folder(out).exists()
    assert finish(out) == 0
    assert os.listdir(tmp_path) == ["meta"]


def test_how_many_processes_there_are_is_no_matter(tmp_path: Path) -> None:
    """Spec G1: with fewer (a process was killed for want of memory) it goes on where it was."""
    out = tmp_path / "out"

    def begin(workers: int, *, resume: bool) -> None:
        with draft(out, {"kind": "meta", "config": {"workers": workers, "steps": 3}}, resume=resume) as work:
            assert bool(checkpoints_of(work.files).load()) == resume
            checkpoints_of(work.files).save({"step": 1})
            raise KeyboardInterrupt

    for workers, resume in ((4, False), (1, True)):
        with pytest.raises(KeyboardInterrupt):
            begin(workers, resume=resume)
    other = {"kind": "meta", "config": {"workers": 1, "steps": 4}}
    with pytest.raises(UserError, match="steps=3, not 4"), draft(out, other, resume=True):
        pass


def test_what_has_no_setting_in_common_was_made_otherwise(tmp_path: Path) -> None:
    """Spec G2: imported states are none that 'collect' made."""
    before, now = ({"config": config, "versions": {}} for config in ({"source": "own.npz"}, {"steps": 3}))
    with pytest.raises(UserError, match="made with other settings"):
        check_complete(before, now, tmp_path)
