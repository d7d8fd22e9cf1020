"""The benchmark from the command line: real trainings, short (Spec H1)."""

from __future__ import annotations

import csv
from pathlib import Path

import numpy as np
import pytest

from hypogoal.cli import main
from hypogoal.core.errors import UserError
from hypogoal.which_feature import run
from hypogoal.which_feature.run import parse_entry, resolved, run_cell
from hypogoal.which_feature.scores import owned
from hypogoal.which_feature.states import FACTORS, KNOWN
from hypogoal.which_feature.table import summary, with_interval

COMMAND = ["benchmark", "which-feature", "--quiet", "--set", "steps=2", "--members", "2"]
OWN = """
def apart(first, second):
    assert first.requires_grad
    return -((first - second) ** 2).mean((-2, -1)).tanh()
"""


def rows(out: Path) -> list[dict[str, str]]:
    with (out / "results.csv").open(newline="") as file:
        return list(csv.DictReader(file))


@pytest.mark.parametrize("factors", [FACTORS, KNOWN, ("shape", "place")])
def test_the_oracle_covers_everything(factors: tuple[str, ...]) -> None:
    """So each factor can be learned by itself: what an objective falls short of is its own."""
    cell = run_cell(parse_entry("oracle"), 0.5, 0, resolved({"factors": factors}))
    assert np.diag(cell.ranking).min() >= 0.99
    assert owned(cell.ranking).any(axis=0).all()
    assert cell.labels.max() < 10


def test_one_member_covers_one_factor_at_most_and_the_same_seed_gives_the_same() -> None:
    """Of ``cnn`` there is one, whatever --members says."""
    first, again = (run_cell(parse_entry("cnn"), 0.5, 0, resolved({"steps": 20})) for _ in range(2))
    assert first.ranking.shape == (1, 4)
    assert owned(first.ranking).sum() <= 1
    assert (first.ranking == again.ranking).all()


def test_end_to_end_and_on_again(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """Table and CSV; lines that are there are kept; an objective of one's own is scored like the others."""
    monkeypatch.chdir(tmp_path)
    (tmp_path / "mine_apart.py").write_text(OWN)
    out = tmp_path / "bench"
    command = [*COMMAND, "--out", str(out), "--seeds", "3"]
    assert main([*command, "--diversity", "dbat:0.1,cnn"]) == 0
    kept = rows(out)
    trained = []
    run_cell = run.run_cell
    monkeypatch.setattr(run, "run_cell", lambda *cell: trained.append(cell[:3]) or run_cell(*cell))
    capsys.readouterr()

    assert main([*command, "--mix", "0,0.5", "--diversity", "dbat:0.1,mine_apart:apart:0.5,mine_apart:apart"]) == 0
    printed = capsys.readouterr().out.splitlines()
    assert printed[-1] == str(out / "results.csv")
    assert max(map(len, printed[:-1])) <= 80
    found = rows(out)
    assert len(trained) == 5 and all(row in found for row in kept)
    assert {(row["entry"], row["mix"]) for row in found} == {
        ("cnn", "0.5"),
        *((entry, mix) for entry in ("dbat:0.1", "mine_apart:apart:0.5", "mine_apart:apart") for mix in ("0.0", "0.5")),
    }
    assert len(found) == 4 + 6 * 8
    assert all(0 <= float(row[name]) <= 1 for row in found for name in ("ranking", "balanced_accuracy", "at_best"))


def test_a_factor_of_two_frames_is_scored_too(tmp_path: Path) -> None:
    """``moved``: the frame before and the one that is now."""
    out = tmp_path / "bench"
    assert main([*COMMAND, "--out", str(out), "--seeds", "0", "--diversity", "none", "--factors", "count,moved"]) == 0
    assert {row["factor"] for row in rows(out)} == {"count", "moved"}


@pytest.mark.parametrize(
    ("words", "message"),
    [
        ("--diversity magic", "unknown diversity objective: magic"),
        ("--diversity dbat:-1", "out of range"),
        ("--diversity oracle:1", "oracle has no weight"),
        ("--diversity dbat:nan", "not finite"),
        ("--diversity nosuchmodule:loss", "cannot be loaded"),
        ("--mix 2", "out of range"),
        ("--mix half", "wrong type of value"),
        ("--seeds x", "wrong type of value"),
        ("--seeds -1", "out of range"),
        ("--members 0", "out of range"),
        ("--set stepz=3", "Did you mean 'steps'"),
        ("--seeds ,", "nothing to run"),
        ("--high 2", "out of range"),
        ("--out {made}", "not a folder of the benchmark"),
    ],
)
def test_mistakes(tmp_path: Path, capsys: pytest.CaptureFixture[str], words: str, message: str) -> None:
    """One line, exit code 2, nothing written."""
    made = tmp_path / "made"
    made.mkdir()
    (made / "of-others").touch()
    out = tmp_path / "out"
    assert main([*COMMAND, "--out", str(out), *words.format(made=made).split()]) == 2
    told = capsys.readouterr().err
    assert message in told
    assert told.count("\n") == 1
    assert not out.exists()


def test_a_folder_of_other_settings_or_with_damaged_results_is_refused(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Cells that were trained otherwise are not mixed; what a file says is checked."""
    out = tmp_path / "bench"
    command = [*COMMAND, "--out", str(out), "--seeds", "0", "--diversity", "cnn"]
    assert main(command) == 0
    assert main([*command, "--set", "learning_rate=0.1"]) == 2
    assert "other settings" in capsys.readouterr().err
    whole = (out / "results.csv").read_text()
    for before, after in (("cnn,0.5,0,0,colour,", "cnn,0.5,0,0,colour,9"), ("labels", "label"), ("cnn,0.5", "cnn,x")):
        (out / "results.csv").write_text(whole.replace(before, after, 1))
        assert main(command) == 2
        assert "damaged" in capsys.readouterr().err


def test_own_code_needs_the_users_word() -> None:
    """As elsewhere: a name in a file is no permission."""
    with pytest.raises(UserError, match="Do you trust it"):
        parse_entry("mine_apart:apart")


def test_seeds_are_told_by_their_number() -> None:
    """Points below three, then mean and interval; entries that cover most come first."""
    assert with_interval(np.array([0.5, 0.25])) == "0.50, 0.25"
    assert with_interval(np.array([0.0, 0.5, 1.0])) == "0.50 ± 1.24"
    assert with_interval(np.array([np.nan])) == "–"
    cells = [run_cell(parse_entry(name), 0.5, 0, resolved({"steps": 30})) for name in ("cnn", "oracle")]
    lines = summary(cells, 0.5, 1.0)
    assert [line.entry for line in lines] == ["oracle", "cnn"]
    assert np.isnan(lines[1].same).all()
