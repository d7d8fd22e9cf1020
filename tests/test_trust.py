"""Spec B6, G2, H8: code that a file names is loaded only with ``--trust``, in every process; what one typed is."""

import json
import os
import shutil
import sys
from pathlib import Path

import pytest
from command_line import called, fails, refuses, run
from toy_data import write

import hypogoal
from hypogoal.core import own_code
from hypogoal.core.errors import UserError
from hypogoal.core.processes import surroundings
from hypogoal.domains.find import load_domain

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


IN_MANIFESTS = [
    *(("ensemble", name, "ensemble") for name in ("network", "view")),
    *(("ensemble", "domain", command) for command in ("train-options {run}/ensemble", "train-meta {run}/ensemble")),
    *(("meta", name, "options") for name in ("network", "termination")),
    *(("meta", "domain", command) for command in ("evaluate {run}", "export {run}/meta --episodes 1")),
    ("ensemble", "network", "audit {run}/ensemble --domain doorkey --sub-goal open-red-door"),
    ("ensemble", "network", "export {run}/ensemble"),
]


@pytest.mark.parametrize(("part", "key", "way"), IN_MANIFESTS)
def test_a_manifest_cannot_have_code_loaded(folder: Path, tiny_run: Path, part: str, key: str, way: str) -> None:
    """Whoever reads it: a stage, a tool, Python; of an agent's ensemble, too."""
    theirs = folder / "run"
    shutil.copytree(tiny_run, theirs)
    file = theirs / part / "manifest.json"
    manifest = json.loads(file.read_text())
    manifest["config"][key] = "evilmod:obj"
    file.write_text(json.dumps(manifest))
    if " " in way:
        words = *way.format(run=theirs).split(), "--out", folder / "out-v0"
        printed = fails(*words).err
        assert "a file names code of its own as its" in printed and not (folder / "ran").exists()
    else:
        load = {"ensemble": hypogoal.load_ensemble, "options": hypogoal.load_options}[way]
        arguments = (theirs / part, "open-red-door") if way == "ensemble" else (theirs / part,)
        with pytest.raises(UserError, match="a file names code of its own"):
            load(*arguments)
    assert not (folder / "ran").exists()


@pytest.mark.parametrize("words", ["show theirs.h5", "verify .", "status .", "check theirs.h5", "show run"])
def test_a_look_loads_nothing(folder: Path, words: str) -> None:
    (folder / "run").mkdir()
    shutil.copy(folder / "theirs.h5", folder / "run")
    called(tuple(words.split()))
    assert not (folder / "ran").exists()


def test_children_know_what_was_typed_and_no_more(monkeypatch: pytest.MonkeyPatch) -> None:
    """In every process that one starts: spawned, forked, a cell's, a job's of Slurm, which inherits the environment."""
    monkeypatch.setattr(own_code, "_allowed", set())
    assert own_code.environment() == {}
    own_code.allow(["--network", "mine:net"])
    assert own_code.environment() == {own_code.TYPED: "mine:net"}
    with surroundings():
        own_code._allowed.clear()  # as in the child
        own_code.require_trust("mine:net", "network")
        with pytest.raises(UserError, match="a file names code of its own"):
            own_code.require_trust("other:net", "network")
    own_code.allow(["--trust"])
    with surroundings():
        own_code._allowed.clear()
        own_code.require_trust("other:net", "network")


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
