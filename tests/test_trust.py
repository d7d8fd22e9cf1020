"""Spec B6, G2, H8: code that a file names is loaded only with ``--trust``, in every process; what one typed is."""

import os
import sys
from pathlib import Path

import pytest
from command_line import fails, refuses, run
from toy_data import write

from hypogoal.core import own_code
from hypogoal.core.errors import UserError
from hypogoal.domains.base import load_domain

ROOT = Path(__file__).parents[1]
EXPERIMENT = """
format = 1
evaluate = false
axes = {{ own = ["{own}"] }}
cells = [{{ name = "c", axes = ["own"], command = "{command}" }}]
"""
NAMED = [
    ("theirs.toml", "train-ensemble data.h5 --preset theirs.toml --out out -q"),
    ("theirs.h5", "train-ensemble theirs.h5 --out out -q"),
    ("collect evilmod:obj", "run own.toml --out out"),
    ("collect {own}", "run own.toml --out out"),
    ("train-ensemble data.h5 --set=network=evilmod:obj", "run own.toml --out out"),
    ("train-ensemble data.h5 --diversity {own}", "run own.toml --out out"),
]


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A current folder with a module that notes when it is loaded, and files that name it."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(str(tmp_path))  # not a folder of another test
    mark = "import pathlib\npathlib.Path(__file__).with_name('ran').touch()\nobj = 1\n"
    (tmp_path / "evilmod.py").write_text(mark)
    (tmp_path / "theirs.toml").write_text('[train-ensemble]\ndiversity = "evilmod:obj"\n')
    write(tmp_path / "data.h5")
    write(tmp_path / "theirs.h5", domain="evilmod:obj")
    yield tmp_path
    sys.modules.pop("evilmod", None)


@pytest.mark.parametrize(("named", "words"), NAMED)
def test_a_file_cannot_have_code_loaded(folder: Path, named: str, words: str) -> None:
    """One line; with ``--trust`` it is loaded."""
    (folder / "own.toml").write_text(EXPERIMENT.format(own="evilmod:obj", command=named))
    refuses("a file names code of its own as its", *words.split())
    assert not (folder / "ran").exists()
    if not words.startswith("run"):
        fails(*words.split(), "--trust")
        assert (folder / "ran").exists()


def test_what_one_typed_is_loaded(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """On the command line or in a call; an old value of the variable says nothing."""
    monkeypatch.setenv(own_code.VARIABLE, "evilmod:obj")
    with pytest.raises(UserError, match="Do you trust it"):
        load_domain("evilmod:obj")
    refuses("the object is not a domain", "collect", "evilmod:obj", "--out", folder / "made" / "out")
    own_code._allowed.clear()
    monkeypatch.setenv(own_code.VARIABLE, "1")
    with pytest.raises(UserError, match="not a domain"):
        load_domain("evilmod:obj")


def test_cells_have_what_one_typed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """In processes of their own, whose files name it."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("PYTHONPATH", os.pathsep.join([str(ROOT), str(ROOT / "tests")]))
    (tmp_path / "margin.py").write_text((ROOT / "examples" / "margin.py").read_text())
    write(tmp_path / "data.h5")
    command = (
        "train-ensemble data.h5 --diversity {own} --set steps=2 --set members=2 --set workers=1 --set sub_goals=one"
    )
    (tmp_path / "own.toml").write_text(EXPERIMENT.format(own="dbat", command=command))
    run("run", "own.toml", "--out", "out", "-q", "--set", "own=margin:pair_loss")
    assert len([*tmp_path.glob("out/c/*/manifest.json")]) == 1
