"""Examples of a teacher and of objectives: what they make of members (examples/joint.py, examples/objectives.py)."""

import sys
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest
from command_line import run, settings
from numpy.typing import NDArray

from hypogoal.check.objectives import check_objective
from hypogoal.check.verdict import require
from hypogoal.core.artefacts import open_artefact
from hypogoal.core.own_code import load
from hypogoal.diversity import load_objective
from hypogoal.domains.rooms.states import crossed_states, labelled_states, unlabelled_states
from hypogoal.hypotheses.config import EnsembleConfig
from hypogoal.hypotheses.ensemble import Ensemble
from hypogoal.hypotheses.scores import mean_disagreement
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


@pytest.mark.parametrize("name", ["repulsive", "ace"])
def test_they_keep_the_laws(name: str) -> None:
    """Spec C1, C2: shapes, empty sets, any order, extreme logits, a gradient for each member."""
    require(check_objective(load_objective(f"objectives:{name}")))


def numbers(easy: NDArray[np.bool_], hard: NDArray[np.bool_], seed: int) -> NDArray[np.float32]:
    """Three numbers: the first has the easy feature's sign, the product of the others the hard one's."""
    rng = np.random.default_rng(seed)
    first, second = np.where(easy, 1.0, -1.0), rng.choice([-1.0, 1.0], size=len(easy))
    values = np.stack([first, second, np.where(hard, second, -second)], axis=1)
    return (values + 0.1 * rng.normal(size=values.shape)).astype(np.float32)


@pytest.mark.parametrize(("name", "weight"), [("repulsive", 1.0), ("ace", 0.1)])
def test_members_disagree_where_they_agree_without(name: str, weight: float) -> None:
    """Labels fit two features, and one is easy: without an objective every member takes that one."""
    labels, free = np.arange(200) % 2 == 0, np.arange(200)
    seen, elsewhere = numbers(labels, labels, 0), numbers(free % 2 == 0, free % 4 < 2, 1)
    plain = EnsembleConfig(members=3, steps=150, learning_rate=1e-3, diversity="none")
    diverse = plain.model_copy(update={"diversity": f"objectives:{name}", "diversity_weight": weight})
    found = []
    for config in (plain, diverse):
        ensemble = train(seen, labels, elsewhere, config, seed=1)
        assert (ensemble.predictions(seen) == labels[:, None]).mean() > 0.95
        found.append(mean_disagreement(ensemble.predictions(elsewhere)))
    assert found[0] < 0.05 and found[1] > 0.15, found
