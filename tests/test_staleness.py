"""``hypogoal status``: what is stale in a run, why, and the commands that renew it."""

import json
import shlex
from pathlib import Path

import pytest

from hypogoal.cli import main
from hypogoal.core.artefacts import Draft, create
from hypogoal.staleness import lines, states_of


def make(run: Path, name: str, kind: str, *inputs: str, text: str = "", command: str = "", force: bool = False) -> None:
    """An artefact of one file; ``command`` is what made it."""
    paths = [run / each for each in inputs]
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("sys.argv", shlex.split(command) or ["mine.py"])
        with create(run / name, kind=kind, config={}, seed=0, inputs=paths, force=force) as draft:
            (draft.files / "file.txt").write_text(text)


@pytest.fixture
def run(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """An ensemble, options, an agent that continues them, and an evaluation; made in another folder, then moved."""
    monkeypatch.chdir(tmp_path)
    made = tmp_path / "before"
    make(made, "ensemble", "ensemble", command="hypogoal train-ensemble data.h5 --out before/ensemble")
    make(made, "options", "options", "ensemble", command=f"hypogoal train-options {made}/ensemble --out before/options")
    make(made, "meta", "meta", "ensemble", "options", command="program.py")
    make(made, "evaluation", "evaluation", "ensemble", "meta", command="hypogoal evaluate before")
    return made.rename(tmp_path / "run")


def stale(run: Path) -> dict[str, str]:
    return {state.path.name: "; ".join(state.reasons) for state in states_of(run) if state.reasons}


def test_a_new_run_is_up_to_date(run: Path) -> None:
    assert stale(run) == {}
    assert lines(states_of(run))[-1] == "everything is up to date"


def test_a_changed_input_makes_all_that_follow_stale(run: Path) -> None:
    make(run, "ensemble", "ensemble", text="other", force=True)
    assert stale(run) == {
        "options": "its input run/ensemble is changed since it was written",
        "meta": "its input run/ensemble is changed since it was written; its input run/options is stale",
        "evaluation": "its input run/ensemble is changed since it was written; its input run/meta is stale",
    }
    names = [state.path.name for state in states_of(run)]
    assert names.index("ensemble") < names.index("options") < names.index("meta") < names.index("evaluation")


def test_commands_name_the_places_of_today(run: Path) -> None:
    make(run, "ensemble", "ensemble", text="other", force=True)
    commands = {state.path.name: state.command for state in states_of(run)}
    assert commands["options"] == "hypogoal train-options run/ensemble --out run/options --force"
    assert commands["meta"] == ""  # made by a program
    assert commands["ensemble"] == ""  # up to date


def test_a_damaged_file_and_a_lost_input(run: Path) -> None:
    (run / "meta" / "file.txt").write_text("mine")
    assert stale(run)["meta"] == "file.txt: changed since it was written"
    (run / "options").rename(run.parent / "elsewhere")
    assert "its input run/options is missing" in stale(run)["meta"]


def test_an_evaluation_lacks_what_was_made_since(run: Path) -> None:
    make(run, "ppo", "baseline")
    assert stale(run) == {"evaluation": "run/ppo was made since"}


def test_the_command(run: Path, capsys: pytest.CaptureFixture[str]) -> None:
    make(run, "ppo", "baseline")
    assert main(["status", "run"]) == 0
    assert "run/evaluation: run/ppo was made since" in capsys.readouterr().out
    assert main(["status", "run", "--json"]) == 0
    states = json.loads(capsys.readouterr().out)
    assert [state["path"] for state in states if state["reasons"]] == ["run/evaluation"]
    assert main(["status", "nowhere"]) == 2


def test_what_is_in_progress_is_said(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """Spec A8: by ``verify`` and ``status``, of a run that is whole so far and of one with nothing complete yet."""
    monkeypatch.chdir(tmp_path)
    run = Path("run")
    make(run, "dqn", "baseline")
    draft = Draft(run / "ppo")
    with draft.locked():
        draft.begun.write_text("{}")
        draft.checkpoints().save({"step": 1})
        assert main(["verify", "run"]) == 0
        assert capsys.readouterr().out.splitlines()[:2] == ["run: whole so far", "run/ppo: in progress"]
        assert main(["status", "run"]) == 0
        assert capsys.readouterr().out.splitlines()[0] == "run/ppo: in progress"
        assert main(["verify", "run", "--json"]) == 0
        assert json.loads(capsys.readouterr().out)["notes"][0] == "run/ppo: in progress"
        assert main(["verify", "run/ppo"]) == 0
        assert capsys.readouterr().out.splitlines() == ["run/ppo: nothing is complete yet", "run/ppo: in progress"]
    assert main(["verify", "run"]) == 0
    assert "run/ppo: interrupted; its command with --resume continues it" in capsys.readouterr().out
    (run / "dqn" / "file.txt").write_text("mine")
    assert main(["verify", "run"]) == 2
    assert "file.txt: changed since it was written" in capsys.readouterr().out


def test_what_is_nowhere_is_not_in_progress(run: Path, capsys: pytest.CaptureFixture[str]) -> None:
    for name in ("verify", "status", "show"):
        assert main([name, "run/nowhere"]) == 2
        told = capsys.readouterr()
        assert "no such file or folder" in told.out + told.err
