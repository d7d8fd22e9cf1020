"""Stages as functions of a program: what the commands do, checked alike, as objects that show themselves."""

from __future__ import annotations

import inspect
import shutil
from pathlib import Path

import corridor
import own_domain
import pytest
from command_line import run as command
from command_line import settings
from toy_data import write

import hypogoal
from hypogoal.core.artefacts import open_artefact
from hypogoal.core.errors import UserError
from hypogoal.data import open_dataset
from hypogoal.domains import base

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
    shutil.copytree(run, tmp_path / "run", ignore=shutil.ignore_patterns("ensemble", "evaluation"))
    out = tmp_path / "run" / "ensemble"
    few = settings("members=2", "steps=20", "workers=1")
    command("train-ensemble", tmp_path / "run/data.h5", "--out", out, "-q", *few)
    theirs, ours = open_artefact(out), open_artefact(run / "ensemble")
    assert theirs.config == ours.config and theirs.manifest.files == ours.manifest.files
    assert open_artefact(run / "meta").config["domain"] == open_dataset(run / "data.h5").domain == NAME
    assert [*inspect.signature(hypogoal.train_meta).parameters][:4] == ["ensemble", "out", "options", "preset"]


def test_what_is_made_is_a_path_with_something_to_show(
    run: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Counts, losses, success, tables: as the command's ``show`` has them, in HTML that is text."""
    for name, word in {"data.h5": "unlabelled", "ensemble": "labelled loss", "meta": "episodes"}.items():
        made = hypogoal.Made(run / name)
        assert made.path == run / name and word in made._repr_html_() and word in repr(made)
        made.show()
        assert word in capsys.readouterr().out
    assert hypogoal.Made(run / "data.h5").metrics["unlabelled"] == 9 * corridor.LENGTH
    assert {"method", "quantity", "value"} <= {*hypogoal.Made(run / "evaluation").metrics}
    assert len(hypogoal.load_ensemble(hypogoal.Made(run / "ensemble"), "left-end")) == 2
    shown = hypogoal.Made(write(tmp_path / "<b>&.h5"))._repr_html_()
    assert "&lt;b&gt;&amp;.h5" in shown and "<b>" not in shown


@pytest.mark.parametrize(
    ("given", "words"),
    [
        ({"stepz": 3}, "train-ensemble has no setting: stepz. Did you mean 'steps'"),
        ({"preset": "none-such"}, "no such preset"),
        ({"device": "tpu"}, "unknown device"),
    ],
)
def test_what_would_end_a_command_is_an_error(run: Path, tmp_path: Path, given: dict[str, object], words: str) -> None:
    """The same checks and lines; what is refused is not begun."""
    with pytest.raises(UserError, match=words):
        hypogoal.train_ensemble(run / "data.h5", out=tmp_path / "out", **FEW | given)
    assert not (tmp_path / "out").exists()


def test_domains_of_another_program_and_of_another_name(run: Path, tmp_path: Path) -> None:
    """An object is found by its own name, in its program."""
    with pytest.raises(UserError, match="unknown domain"):
        hypogoal.train_options(run / "ensemble", out=tmp_path / "out", **PLAY)
    domain = own_domain.CorridorDomain()
    domain.name = "doorkey"
    with pytest.raises(UserError, match=r"has the name of one of hypogoal's: doorkey\. Give it another name"):
        hypogoal.collect(domain, out=tmp_path / "out")


def test_settings_count_more_than_presets(run: Path, tmp_path: Path) -> None:
    """Tuples are lists."""
    (tmp_path / "mine.toml").write_text("[train-ensemble]\nsteps = 7\nlearning_rate = 0.01\n")
    given = FEW | {"preset": str(tmp_path / "mine.toml"), "steps": 4, "sub_goals": ["left-end"]}
    config = open_artefact(hypogoal.train_ensemble(run / "data.h5", out=tmp_path / "ensemble", **given).path).config
    assert [config[name] for name in ("steps", "learning_rate", "sub_goals")] == [4, 0.01, ["left-end"]]
