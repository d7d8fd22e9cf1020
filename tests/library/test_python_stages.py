"""Stages as functions of a program: what the commands do, checked alike, as objects that show themselves."""

import inspect
from pathlib import Path
from typing import Any

import corridor
import own_domain
import pytest
from toy_data import write

import hypogoal
from hypogoal.core.artefacts import open_artefact
from hypogoal.core.errors import UserError
from hypogoal.data import open_dataset
from hypogoal.domains import find

NAME = "corridor-here"
FEW = {"steps": 10, "workers": 1, "members": 2, "diversity_weight": 1e-4, "restarts": 1, "quiet": True}
PLAY = {"environments": 4, "warm_up": 50, "steps": 400, "max_episode_steps": 30, "quiet": True}


class Here(own_domain.CorridorDomain):
    """A domain that only this program has."""

    name = NAME


def test_a_program_does_what_commands_do(corridor_run: Path, tmp_path: Path) -> None:
    """Spec A8: the same bytes, the same settings; what there is to use is listed."""
    made = hypogoal.train_meta(corridor_run / "ensemble", out=str(tmp_path / "meta"), **PLAY)
    one, other = open_artefact(made.path), open_artefact(corridor_run / "meta")
    assert one.config == other.config and one.manifest.files == other.manifest.files
    assert dir(hypogoal) == sorted(hypogoal.__all__)
    assert [*inspect.signature(hypogoal.train_meta).parameters][:5] == ["ensemble", "out", "options", "agent", "preset"]


def test_what_is_made_is_a_path_with_something_to_show(
    corridor_run: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Counts, losses, success, tables: as the command's ``show`` has them, in HTML that is text."""
    for name, word in {"data.h5": "unlabelled", "ensemble": "labelled loss", "meta": "episodes"}.items():
        made = hypogoal.Made(corridor_run / name)
        assert made.path == corridor_run / name and word in made._repr_html_() and word in repr(made)
        made.show()
        assert word in capsys.readouterr().out
    assert hypogoal.Made(corridor_run / "data.h5").metrics["unlabelled"] == 9 * corridor.LENGTH
    assert {"method", "quantity", "value"} <= {*hypogoal.Made(corridor_run / "evaluation").metrics}
    assert len(hypogoal.load_ensemble(hypogoal.Made(corridor_run / "ensemble"), "left-end")) == 2
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
def test_what_would_end_a_command_is_an_error(corridor_run: Path, tmp_path: Path, given: Any, words: str) -> None:
    """The same checks and lines; what is refused is not begun."""
    with pytest.raises(UserError, match=words):
        hypogoal.train_ensemble(corridor_run / "data.h5", out=tmp_path / "out", **FEW | given)
    assert not (tmp_path / "out").exists()


def test_one_file_may_be_given_where_several_may(corridor_run: Path, tmp_path: Path) -> None:
    """Data files of unlabelled states: one, or a list."""
    data = corridor_run / "data.h5"
    one = hypogoal.train_ensemble(data, out=tmp_path / "one", unlabelled=data, **FEW)
    several = hypogoal.train_ensemble(data, out=tmp_path / "several", unlabelled=[data], **FEW)
    assert open_artefact(one.path).manifest.files == open_artefact(several.path).manifest.files


def test_domains_of_another_program_and_of_another_name(tmp_path: Path) -> None:
    """An object is found by its own name, in its program."""
    data = hypogoal.collect(Here(), out=tmp_path / "data.h5", quiet=True)
    ensemble = hypogoal.train_ensemble(data, out=tmp_path / "ensemble", **FEW)
    assert open_dataset(data.path).domain == open_artefact(ensemble.path).config["domain"] == NAME
    del find.REGISTERED[NAME]  # as in another program
    with pytest.raises(UserError, match="unknown domain"):
        hypogoal.train_options(ensemble, out=tmp_path / "out", **PLAY)
    domain = own_domain.CorridorDomain()
    domain.name = "doorkey"
    with pytest.raises(UserError, match=r"has the name of one of hypogoal's: doorkey\. Give it another name"):
        hypogoal.collect(domain, out=tmp_path / "out")
