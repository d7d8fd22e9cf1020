"""``show``, ``verify``, ``status``: what is there, is it whole, is it up to date (Spec A8, G2)."""

import json
import shlex
import sys
from pathlib import Path

import numpy as np
import pytest
from command_line import fails, refuses, run
from toy_data import files_of

from hypogoal.core.drafts import create
from hypogoal.data import Collected, States, write_dataset
from hypogoal.evaluation.run import find_artefacts
from hypogoal.look import describe, faults, lines, outcome, stale

KINDS = ("ensemble", "options", "meta", "baseline", "evaluation", "report", "comparison", "audit")
COMPARED = {"differences.csv", "curves.csv", "hypotheses.csv", "rooms.csv", "distance.csv"}
MAY_FILES = {"executions.csv", "exploits.csv", "film.gif", *COMPARED}
MAY = MAY_FILES, ("figures/", "videos/", "tables/", "before-", "mended-")


@pytest.fixture
def make(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    """Makes an artefact of one file, ``run/NAME``, of others of the run."""
    monkeypatch.chdir(tmp_path)

    def made(name: str, *inputs: str, text: str = "", command: str = "", force: bool = False) -> None:
        monkeypatch.setattr(sys, "argv", shlex.split(command) or ["pytest"])
        paths = [Path("run", each) for each in inputs]
        with create(Path("run", name), kind=name, config={}, seed=0, inputs=paths, force=force) as draft:
            (draft.files / "file.txt").write_text(text)

    return made


@pytest.fixture
def small_run(make) -> Path:
    """An ensemble, options, an agent that continues them, and a report; moved since."""
    make("ensemble", command="hypogoal train-ensemble data.h5 --out run/ensemble")
    make("options", "ensemble", command="hypogoal train-options run/ensemble --out run/options")
    make("meta", "ensemble", "options", command="mine.py")
    make("report", "ensemble", "meta", command="hypogoal report run")
    moved = Path("run").rename("before")
    return moved.rename("run")


def reasons(run: Path) -> dict[str, str]:
    return {Path(row["path"]).name: "; ".join(row["reasons"]) for row in stale(run) if row["reasons"]}


def test_what_follows_a_changed_artefact_is_stale(small_run: Path, make) -> None:
    assert reasons(small_run) == {} and run("status", "run").out.splitlines()[-1] == "everything is up to date"
    make("ensemble", text="other", force=True)
    assert reasons(small_run) == {
        "options": "its input run/ensemble (ensemble) is changed since it was written",
        "meta": "its input run/ensemble (ensemble) is changed since it was written; its input run/options is stale",
        "report": "its input run/ensemble (ensemble) is changed since it was written; its input run/meta is stale",
    }
    told = run("status", "run").out.splitlines()
    assert told[:3] == [
        "run/ensemble: up to date",
        "run/options: its input run/ensemble (ensemble) is changed since it was written",
        "  hypogoal train-options run/ensemble --out run/options --force",
    ]
    assert told[-1] == "3 of 4 stale: renew them in this order"
    rows = json.loads(run("status", "run", "--json").out)
    assert [Path(row["path"]).name for row in rows] == ["ensemble", "options", "meta", "report"]
    assert (rows[1]["command"][:8], rows[2]["command"]) == ("hypogoal", "mine.py")


def test_a_damaged_file_and_a_lost_input_are_named(small_run: Path) -> None:
    (small_run / "meta" / "file.txt").write_text("mine")
    changed = "file.txt is changed since it was written"
    assert reasons(small_run) == {"meta": changed, "report": "its input run/meta is stale"}
    assert fails("verify", "run").out.splitlines() == [f"run/meta: {changed}"]
    (small_run / "options").rename("elsewhere")
    gone = "its input run/options (options) is missing"
    assert json.loads(fails("verify", "run", "--json").out)["faults"] == [f"run/meta: {changed}", f"run/meta: {gone}"]
    assert run("verify", "elsewhere").out.splitlines() == ["elsewhere: whole"], "inputs outside are not its own"


def test_what_is_unfinished_is_said(small_run: Path) -> None:
    """Of a run that is whole so far, and of one with nothing complete yet."""
    with create(Path("run/ppo"), kind="baseline", config={}, seed=0) as draft:
        assert run("verify", "run").out.splitlines() == ["run: whole so far", "run/ppo: in progress"]
        assert run("status", "run").out.splitlines()[0] == "run/ppo: in progress"
        assert run("verify", "run/ppo").out.splitlines() == ["run/ppo: nothing is complete yet", "run/ppo: in progress"]
    draft.folder.mkdir()
    draft.begun.write_text("{}")
    told = run("verify", "run", "--json").out
    assert json.loads(told)["notes"] == ["run/ppo: interrupted; its command with --resume continues it"]


@pytest.mark.parametrize("command", ["show", "verify", "status"])
def test_what_is_nowhere_is_one_line(command: str, tmp_path: Path) -> None:
    refuses("no such file or folder", command, tmp_path / "nowhere")
    (tmp_path / "empty").mkdir()
    refuses("no artefact and no data file here", command, tmp_path / "empty")


def test_a_description_fits_a_terminal(tmp_path: Path, small_run: Path) -> None:
    """Spec A8: at 80 columns; a data file's counts first."""
    pictures, labels = np.zeros((3, 8, 8, 3), np.uint8), np.eye(3, 2, dtype=np.bool_)
    states = States(pictures, labels, {})
    data = tmp_path / "data.h5"
    write_dataset(data, Collected((8, 8, 3), ("a", "b"), states, states, states), domain="own", config={}, seed=3)
    told = run("show", data).out.splitlines()
    assert told[0] == "labelled  a                          3 states       1 positives"
    assert told[4:8] == [
        "unlabelled                           3 states",
        f"{data}: data",
        "domain: own",
        "observations: uint8 (8, 8, 3)",
    ]
    told = run("show", "run/meta").out.splitlines()
    assert told[0] == "run/meta: meta" and "inputs: ensemble run/ensemble, options run/options" in told
    assert max(map(len, told)) <= 80
    assert run("show", "run").out.splitlines()[0] == "run/ensemble: ensemble"


def test_each_kind_has_the_files_that_its_stage_writes(corridor_run: Path) -> None:
    """Spec A8: each stage writes all its files and lists them in the manifest, in every setting."""
    for kind in KINDS:
        artefacts = find_artefacts(corridor_run, kind)
        assert artefacts, kind
        for artefact in artefacts:
            written, wanted = artefact.manifest.files.keys(), files_of(kind, artefact.config)
            more = written - wanted
            assert wanted <= written and all(name in MAY[0] or name.startswith(MAY[1]) for name in more), more
    assert faults(corridor_run) == []
    for kind in ("ensemble", "meta", "evaluation", "comparison"):
        details = describe(find_artefacts(corridor_run, kind)[0].path)
        assert max(map(len, [*outcome(details), *lines(details)[1:]])) <= 80 or kind == "comparison"
    assert "; labelled " in lines(describe(corridor_run / "ensemble"))[0]
