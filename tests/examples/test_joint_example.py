"""Proposals that are jointly independent, and the members that they teach (examples/joint.py)."""

import sys
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest
from command_line import run, settings
from numpy.typing import NDArray

from hypogoal.core.artefacts import open_artefact
from hypogoal.core.own_code import load
from hypogoal.domains.rooms.states import crossed_states, labelled_states, unlabelled_states
from hypogoal.hypotheses.config import EnsembleConfig
from hypogoal.hypotheses.ensemble import Ensemble
from hypogoal.hypotheses.training import train

NAMES = ("shape", "place")
TAUGHT = EnsembleConfig(
    members=2, diversity="none", teacher="joint:independent", network="tiles", steps=150, learning_rate=2e-3
)


@pytest.fixture
def joint(monkeypatch: pytest.MonkeyPatch) -> ModuleType:
    """The example, with few starts."""
    load("joint:teach", "teacher", "", {})
    example = sys.modules["joint"]
    monkeypatch.setattr(example, "RESTARTS", 8)
    return example


def rooms(
    mix: float, names: tuple[str, ...] = NAMES
) -> tuple[NDArray[np.uint8], NDArray[np.bool_], NDArray[np.uint8], NDArray[np.bool_]]:
    """Labelled pictures and labels, unlabelled pictures and their features (M, F)."""
    labelled, unlabelled = labelled_states(256, 0, names), unlabelled_states(512, mix, 0, names)
    return labelled.observations, labelled.factors[:, 0], unlabelled.observations, unlabelled.factors


def followed(ensemble: Ensemble) -> NDArray[np.float64]:
    """How often each member goes with each feature, (K, F), in states where the features are independent."""
    scenes = crossed_states(50, 0, NAMES)
    return (ensemble.predictions(scenes.observations)[:, :, None] == scenes.factors[:, None]).mean(0)


def test_two_taught_members_own_a_feature_each(joint: ModuleType) -> None:
    """The main claim: labels fit shape and place; taught members own one each, untaught ones do not."""
    *states, _ = rooms(1.0)
    taught = followed(train(*states, TAUGHT, 0))
    untaught = followed(train(*states, TAUGHT.model_copy(update={"teacher": ""}), 0))
    assert (taught.max(0) > 0.9).all() and sorted(taught.argmax(1)) == [0, 1], taught
    assert untaught.max(0).min() < 0.8, untaught


def test_shape_and_place_are_found_where_colour_varies(joint: ModuleType) -> None:
    """Labels fit *shape if it is red, else place* and its opposite as well, which are independent, too."""
    *states, factors = rooms(1.0)
    right = (joint.independent(*states, 2, 0) > 0)[:, :, None] == factors  # (K, M, F)
    assert sorted(right.mean(1).argmax(0).tolist()) == [0, 1]
    assert (right.mean(1).max(0) > 0.95).all()


def test_what_does_not_suit_is_one_clear_line(joint: ModuleType) -> None:
    """Spec G2: one member, too many, pictures smaller than a pattern."""
    *states, _ = rooms(1.0)
    for members in (1, 9):
        with pytest.raises(ValueError, match=rf"proposals .* from 2 to 8 members, not {members}"):
            train(*states, TAUGHT.model_copy(update={"members": members}), 0)
    observations, labels, unlabelled = states
    with pytest.raises(ValueError, match="too small"):
        joint.teach(observations[:, :7], labels, unlabelled[:, :7], 2, 0)


def test_the_command_teaches(joint: ModuleType, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Who types a teacher's name trusts it; the file has the setting."""
    monkeypatch.delenv("HYPOGOAL_TRUST")
    data, out = tmp_path / "data.h5", tmp_path / "ensemble"
    run("collect", "rooms", "--out", data, *settings("unlabelled=200"))
    few = settings("steps=2", "workers=1", "teacher=joint:independent")
    run("train-ensemble", data, "--out", out, "--diversity", "none", "--members", 2, *few)
    assert open_artefact(out).config["teacher"] == "joint:independent"
