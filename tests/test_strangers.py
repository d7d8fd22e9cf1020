"""Files of strangers that would not end, numbers that are none, words that lead out of a run (Spec G2)."""

import hashlib
import json
import os
from pathlib import Path
from typing import Any

import pytest
import torch
from safetensors.torch import save_file
from toy_data import fill, reseal, write

from hypogoal.cli import main
from hypogoal.core.artefacts import create_artefact, find_input, open_artefact, sha256_of
from hypogoal.core.errors import UserError
from hypogoal.core.files import json_lines, parse_json, read_bytes, read_json
from hypogoal.core.tensors import load_tensors

ENDLESS = ("/proc/self/pagemap", "/proc/self/mem", "/proc/cpuinfo", "/sys/kernel/notes", "/sys/fs/cgroup/cgroup.procs")
SMALL = {"sub_goals": ["one"], "members": 1}


def refusal(capsys: pytest.CaptureFixture[str], *words: object) -> str:
    """The one line in which a command refuses."""
    capsys.readouterr()
    assert main([str(word) for word in words]) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert line.startswith("hypogoal: ") and line.isprintable()
    return line


@pytest.mark.parametrize("path", [path for path in map(Path, ENDLESS) if path.exists()])
def test_files_of_the_kernel_are_not_read(tmp_path: Path, path: Path) -> None:
    """Spec G2: regular files to the system, of a size that is none; a link to one is one."""
    (tmp_path / "link.json").symlink_to(path)
    for place in (path, tmp_path / "link.json"):
        for read in (sha256_of, lambda place: read_json(place, "the file is", "")):
            with pytest.raises(UserError, match="not a regular file"):
                read(place)


def test_a_file_that_is_all_hole_is_not_read(tmp_path: Path) -> None:
    """Spec G2: 8 TB that take no place on the disk, in an archive neither; a small one is read."""
    path = tmp_path / "hole"
    path.write_bytes(b"x" * 5000)
    os.truncate(path, 2**43)
    with pytest.raises(UserError, match="nearly all hole"):
        sha256_of(path)
    os.truncate(path, 2**20)
    assert read_bytes(path, "it is", "") == b"x" * 5000 + bytes(2**20 - 5000)


def test_no_more_is_read_than_a_files_size(monkeypatch: pytest.MonkeyPatch) -> None:
    """Spec G2: also where the system does not say which files are the kernel's: of 275 GB in 0 bytes nothing."""
    monkeypatch.setattr("hypogoal.core.files._kernel_devices", frozenset)
    pages = Path("/proc/self/pagemap")
    assert sha256_of(pages) == hashlib.sha256().hexdigest() and read_bytes(pages, "it is", "") == b""


@pytest.mark.parametrize("place", ["/proc/self/pagemap", "/dev/zero", "hole", "folder", "pipe", "/proc/self/fd/0"])
def test_an_input_that_never_ends(tmp_path: Path, capsys: pytest.CaptureFixture[str], place: str) -> None:
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
        assert "the data that" in refusal(capsys, "evaluate", run)
