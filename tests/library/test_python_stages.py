"""Stages as functions of a program: what the commands do, checked alike, as objects that show themselves."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import corridor
import numpy as np
import own_domain
import pytest
from toy_data import write

import hypogoal
from hypogoal.cli import main
from hypogoal.core.artefacts import open_artefact
from hypogoal.core.errors import UserError
from hypogoal.core.seeding import torch_generator
from hypogoal.data import open_dataset
from hypogoal.domains import base
from hypogoal.hypotheses.deep_lift import mean_state
from hypogoal.hypotheses.ensemble import Ensemble

NAME = "corridor-here"
FEW = {"steps": 20, "workers": 1, "members": 2, "quiet": True}
PLAY = {"environments": 4, "warm_up": 50, "steps": 400, "quiet": True}


class Here(own_domain.CorridorDomain):
    """A domain that only this program has."""

    name = NAME


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """From a domain's object to an evaluation, in one program."""
    folder = tmp_path_factory.mktemp("runs") / "run"
    data = hypogoal.collect(Here(), out=folder / "data.h5", copies=9, quiet=True)
    ensemble = hypogoal.train_ensemble(data, out=folder / "ensemble", **FEW)
    options = hypogoal.train_options(ensemble, out=folder / "options", **PLAY)
    hypogoal.train_meta(ensemble, out=str(folder / "meta"), options=options, **PLAY)
    hypogoal.evaluate(folder, quiet=True)
    del base.REGISTERED[NAME]  # as in another program
    return folder


def test_a_program_does_what_commands_do(run: Path, tmp_path: Path) -> None:
    """Spec A8: the same bytes, the same settings."""
    out = tmp_path / "run" / "ensemble"
    shutil.copytree(run.parent, tmp_path, dirs_exist_ok=True, ignore=shutil.ignore_patterns("ensemble", "evaluation"))
    words = [word for name in ("steps", "workers") for word in ("--set", f"{name}={FEW[name]}")]
    assert main(["train-ensemble", str(tmp_path / "run/data.h5"), "--out", str(out), "--members=2", "-q", *words]) == 0
    theirs, ours = open_artefact(out), open_artefact(run / "ensemble")
    assert theirs.config == ours.config and theirs.manifest.files == ours.manifest.files
    assert open_artefact(run / "meta").config["domain"] == NAME


def test_what_is_made_is_a_path_with_something_to_show(run: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Counts, losses, success, tables: as the command's ``show`` has them, in HTML that is text."""
    kinds = {"data.h5": "unlabelled", "ensemble": "labelled loss", "meta": "episodes", "evaluation": "left-end"}
    for name, word in kinds.items():
        made = hypogoal.Made(run / name)
        assert made.path == run / name and word in made._repr_html_() and word in repr(made)
        made.show()
        assert word in capsys.readouterr().out
    assert hypogoal.Made(run / "data.h5").metrics["unlabelled"] == 9 * corridor.LENGTH
    assert hypogoal.Made(run / "meta").metrics["episodes"] > 0
    metrics = json.loads((run / "evaluation/metrics.json").read_text())
    assert hypogoal.Made(run / "evaluation").metrics == metrics
    assert len(hypogoal.load_ensemble(hypogoal.Made(run / "ensemble"), "left-end")) == 2


def test_html_is_text(tmp_path: Path) -> None:
    """Spec H8: what a stranger's file or folder is called is no markup."""
    html = hypogoal.Made(write(tmp_path / "<b>&.h5"))._repr_html_()
    assert "&lt;b&gt;&amp;.h5" in html and "<b>" not in html


def test_what_would_end_a_command_is_an_error(run: Path, tmp_path: Path) -> None:
    """The same checks and lines; what is refused is not begun."""
    data, out = run / "data.h5", tmp_path / "out"
    cases = [
        ({"stepz": 3}, "train-ensemble has no setting: stepz. Did you mean 'steps'"),
        ({"steps": "many"}, "valid integer"),
        ({"members": 0}, "value not allowed"),
        ({"diversity": "none:such"}, "cannot be loaded"),
        ({"preset": "none-such"}, "no such preset"),
        ({"device": "tpu"}, "unknown device"),
        ({"seed": -1}, "a seed is 0 or more"),
    ]
    for given, words in cases:
        with pytest.raises(UserError, match=words):
            hypogoal.train_ensemble(data, out=out, **{**FEW, **given})
        assert not out.exists()
    with pytest.raises(UserError, match="exists already"):
        hypogoal.train_ensemble(data, out=run / "ensemble", **FEW)
    with pytest.raises(UserError, match="unknown domain"):
        hypogoal.train_options(run / "ensemble", out=out, **PLAY)  # whose domain was another program's
    with pytest.raises(UserError, match="two or more different runs"):
        hypogoal.compare(run, run, out=out)
    called = own_domain.CorridorDomain()
    called.name = "doorkey"
    with pytest.raises(UserError, match=r"has the name of one of hypogoal's: doorkey\. Give it another name"):
        hypogoal.collect(called, out=out)


def test_what_is_complete_is_kept(run: Path) -> None:
    """Spec A6: ``resume`` is no error where nothing is left to do, and changes nothing."""
    before = (run / "ensemble/manifest.json").read_bytes()
    made = hypogoal.train_ensemble(run / "data.h5", out=run / "ensemble", resume=True, **FEW)
    assert made.path == run / "ensemble" and (run / "ensemble/manifest.json").read_bytes() == before
    with pytest.raises(UserError, match="made with members=2, not 3"):
        hypogoal.train_ensemble(run / "data.h5", out=run / "ensemble", resume=True, **{**FEW, "members": 3})


def test_settings_count_more_than_presets(run: Path, tmp_path: Path) -> None:
    """Precedence: settings, preset, default; tuples are lists."""
    preset = tmp_path / "mine.toml"
    preset.write_text("[train-ensemble]\nsteps = 7\nmembers = 3\nlearning_rate = 0.01\n")
    given = {**FEW, "preset": str(preset), "steps": 4, "sub_goals": ["left-end"], "diversity_weight": 0}
    made = open_artefact(hypogoal.train_ensemble(run / "data.h5", out=tmp_path / "ensemble", **given).path)
    config = made.config
    told = [config[name] for name in ("steps", "members", "learning_rate", "sub_goals")]
    assert told == [4, 2, 0.01, ["left-end"]]


def test_progress_is_a_few_lines(run: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Where there is no terminal, as in a notebook."""
    hypogoal.train_ensemble(run / "data.h5", out=tmp_path / "ensemble", **{**FEW, "quiet": False})
    said = capsys.readouterr()
    assert said.out == "" and 1 <= len(said.err.splitlines()) <= 4 and "\r" not in said.err and "\x1b" not in said.err


def test_a_file_names_no_code(run: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Spec H8: a program's words are the user's, a data file's are not."""
    monkeypatch.delenv("HYPOGOAL_TRUST", raising=False)
    data = write(tmp_path / "data.h5", domain="own_domain:DOMAIN")
    with pytest.raises(UserError, match="a file names code of its own"):
        hypogoal.train_ensemble(data, out=tmp_path / "ensemble", **FEW)


def test_attributions_of_members() -> None:
    """Spec F2: float32 (N, K, *obs), which add up to log-odds less the baseline's; nothing for the baseline itself."""
    ensemble = Ensemble("doorkey", (64, 64, 3), 2, torch_generator(0, "weights")).eval()
    rng = np.random.default_rng(0)
    some, others = (rng.integers(256, size=(count, 64, 64, 3), dtype=np.uint8) for count in (3, 5))
    found = ensemble.attributions(some, others)
    assert found.dtype == np.float32 and found.shape == (3, 2, 64, 64, 3)
    gaps = ensemble.log_odds(some) - ensemble.log_odds(mean_state(others)[None])
    assert np.abs(gaps).max() > 1e-3
    np.testing.assert_allclose(found.sum((2, 3, 4)), gaps, atol=1e-3)
    assert not ensemble.attributions(others[:1], others[:1]).any()
    for none in ((some[:0], others), (some, others[:0])):
        with pytest.raises(UserError, match="attributions need states"):
            ensemble.attributions(*none)
    with pytest.raises(UserError, match="observations do not fit the ensemble"):
        ensemble.attributions(some[..., :2], others)


def test_a_comparison_says_who_wins(run: Path, tmp_path: Path) -> None:
    """Spec F5: the lines of the command, and their numbers."""
    other = shutil.copytree(run, tmp_path / "other")
    made = hypogoal.compare(run, other, out=tmp_path / "both")
    assert made.metrics["comparisons"] and "no clear winner of run and other" in repr(made)
    assert open_artefact(made.path).faults() == []
    assert open_dataset(run / "data.h5").domain == NAME
