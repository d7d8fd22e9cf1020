"""Files of strangers: nothing runs, nothing is allocated for a claim, nothing is written elsewhere (Spec G2)."""

import json
import os
from dataclasses import replace
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest
import torch
from toy_data import SHAPE, files_of, reseal, write

from hypogoal.core.artefacts import create_artefact, open_artefact
from hypogoal.core.config import resolve
from hypogoal.core.errors import UserError
from hypogoal.core.files import inside, parse_json, plain_name, read_text
from hypogoal.core.tensors import load_fitting, load_tensors
from hypogoal.data import Collected, States, fixed, open_dataset, write_dataset
from hypogoal.domains.base import load_domain
from hypogoal.experiments.named import EXPERIMENTS
from hypogoal.experiments.planning import make_plan
from hypogoal.hypotheses.config import EnsembleConfig
from hypogoal.inspection import describe_path, faults_of, lines

OBSERVATIONS = "labelled/one/observations"


def replaced(path: Path, name: str, make: Any) -> None:
    with h5py.File(path, "a") as file:
        del file[name]
        make(file)


NO_NAMES = [
    "../../x", "/abs", "a/b", "", ".hidden", "a.", " a", "a ", "\n", "a\0b", r"\q", "x" * 201, "a\u2028b", "\u202ea", 1,
    'a"><img src=x onerror=alert(1)>', "<b>", "a:b", "a|b", "a?", "a*", "=1+1", "+x", "-x", "@x", "－x",
]  # fmt: skip
NAMES = ["open-red-door", "at the door", "türe_2", "去门口", "a.b", "$x$", "R&D", "a=b, c+d", "(2) #1", "x'y", "50%"]


@pytest.mark.parametrize("names", [*([name] for name in NO_NAMES), ["a", "a"], ["a", "A"], []])
def test_names_of_sub_goals_become_files(tmp_path: Path, names: Any) -> None:
    """Spec G2: one rule, where names are written and where they are read: ../../x would be written outside --out."""
    path = write(tmp_path / "data.h5")
    with h5py.File(path, "a") as file:
        file.attrs["sub_goals"] = fixed(json.dumps(names))
    with pytest.raises(UserError, match=r"name|no sub-goals"):
        open_dataset(path)
    out = artefact(tmp_path / "meta")
    reseal(out, config={"sub_goals": names})
    with pytest.raises(UserError, match="'sub_goals' is malformed"):
        open_artefact(out)
    if isinstance(names, list):
        states = States(np.zeros((2, *SHAPE), "u1"), np.zeros((2, len(names)), bool))
        with pytest.raises(UserError, match=r"name|no sub-goals") as caught:
            write_dataset(
                tmp_path / "b.h5", Collected(SHAPE, tuple(names), states, states, states), domain="", config={}, seed=0
            )
        assert str(caught.value).isprintable()


def test_names_of_every_script_are_names(tmp_path: Path) -> None:
    """Spec B6: what is written is read, by its name."""
    states = States(np.zeros((2, *SHAPE), "u1"), np.ones((2, len(NAMES)), bool))
    write_dataset(
        tmp_path / "a.h5", Collected(SHAPE, tuple(NAMES), states, states, states), domain="", config={}, seed=0
    )
    assert list(open_dataset(tmp_path / "a.h5").counts()["labelled"]) == NAMES
    for origin in ("a/b", "..", "\n"):
        odd = replace(states, origins={origin: np.zeros(2, np.int64)})
        with pytest.raises(UserError, match="an origin's name"):
            write_dataset(tmp_path / "b.h5", Collected(SHAPE, ("a",), odd, odd, odd), domain="", config={}, seed=0)


def artefact(out: Path) -> Path:
    config = {"sub_goals": ["one"], "members": 1}
    with create_artefact(out, kind="meta", config=config, seed=0) as folder:
        for name in ("a.csv", *files_of("meta", config)):
            (folder / name).write_bytes(b"step\n1\n" if name == "a.csv" else b"")
    return out


def test_links_and_paths_that_lead_out(tmp_path: Path) -> None:
    """Spec G2: in an artefact, by name or through a link, nothing outside it is read."""
    out = artefact(tmp_path / "meta")
    (tmp_path / "secret").write_text("step\n1\n")
    (out / "a.csv").unlink()
    (out / "a.csv").symlink_to(tmp_path / "secret")
    assert f"{out}: a.csv: outside the artefact" in faults_of(out)
    with pytest.raises(UserError, match="outside the artefact"):
        open_artefact(out).whole()
    (out / "loop").symlink_to(out / "loop")
    for name in ("../secret", "/etc/hosts", "a/../../secret", "loop", "", ".", "a\0b", "x" * 300, 3):
        assert inside(out, name) is None, name
    assert inside(out, "figures/a.svg") == out / "figures/a.svg"


def test_a_manifest_that_is_no_file_is_told_once(tmp_path: Path) -> None:
    """Spec G2: a link to a folder or a device in a manifest's place; an endless search once."""
    run = tmp_path / "run"
    for name, target in (("a", ".."), ("b", "/dev/zero")):
        artefact(run / name)
        (run / name / "manifest.json").unlink()
        (run / name / "manifest.json").symlink_to(target)
    assert [fault.count("no manifest.json") for fault in faults_of(run)] == [1, 1]
    for path in (run, run / "a"):
        with pytest.raises(UserError, match="no manifest"):
            describe_path(path)


def test_odd_lists_of_a_manifest_are_shown(tmp_path: Path) -> None:
    """Spec G2: only what has been checked is taken apart."""
    path = artefact(tmp_path / "one")
    reseal(path, versions=[{"x": 1}], command=[{}])
    assert any("{'x': 1}" in line for line in lines(describe_path(path)))


def test_pipes_and_devices_are_no_files(tmp_path: Path) -> None:
    """Spec G2: opening a pipe would wait for ever, reading /dev/zero never end."""
    os.mkfifo(tmp_path / "pipe.toml")
    for path in (tmp_path / "pipe.toml", Path("/dev/zero")):
        with pytest.raises(UserError, match="not a regular file"):
            read_text(path, "it is", "")
        with pytest.raises(UserError, match="not a regular file"):
            load_tensors(path)
    with pytest.raises(UserError, match="not a regular file"):
        resolve(EnsembleConfig, stage="train-ensemble", preset=str(tmp_path / "pipe.toml"))


def test_weights_are_weighed_before_a_network_is_made() -> None:
    """Spec G2: a manifest that asks for a network of 4 TB is answered from its shapes."""
    with pytest.raises(UserError, match="do not fit"):
        load_fitting(lambda: torch.nn.Linear(10**6, 10**6), {"weight": torch.zeros(2)}, "here")


def test_a_file_cannot_name_code_to_run(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Spec B6, G2: ``module:object`` is imported where the user gave it or allowed it, not because a file says so."""
    (tmp_path / "evil.py").write_text("import pathlib; pathlib.Path(__file__).with_name('ran').touch(); DOMAIN = 1")
    monkeypatch.syspath_prepend(str(tmp_path))
    with pytest.raises(UserError, match="Do you trust it"):
        load_domain("evil:DOMAIN")
    assert not (tmp_path / "ran").exists()
    monkeypatch.setenv("HYPOGOAL_TRUST", "1")
    with pytest.raises(UserError, match="not a domain"):
        load_domain("evil:DOMAIN")
    assert (tmp_path / "ran").exists()


def test_cells_stay_in_their_run(tmp_path: Path) -> None:
    """Spec G2: a preset's variant that climbs out of --out is refused."""
    with pytest.raises(UserError, match="outside the run"):
        make_plan(EXPERIMENTS["montezuma-ladders"], tmp_path, ["variants=view=/../../../x"])


def test_messages_cannot_drive_a_terminal() -> None:
    """Spec G2: what a stranger's file says is quoted in messages."""
    assert str(UserError("kind \x1b[2J", "\ud800")) == "kind ?[2J: ?"
    assert not plain_name("\x1b[2J") and plain_name("open-red-door")
    with pytest.raises(UserError):
        parse_json("[1e999]", "here", "it is", "")
