"""Proposals that are jointly independent, and the members that they teach (examples/joint.py)."""

from __future__ import annotations

import itertools
import sys
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest
import torch
from command_line import run, settings
from numpy.typing import NDArray

from hypogoal.core.artefacts import open_artefact
from hypogoal.core.own_code import load
from hypogoal.domains.rooms.states import crossed_states, labelled_states, unlabelled_states
from hypogoal.hypotheses.config import EnsembleConfig
from hypogoal.hypotheses.ensemble import Ensemble
from hypogoal.hypotheses.training import train

EXAMPLES = Path(__file__).parents[2] / "examples"
NAMES = ("shape", "place")
TAUGHT = EnsembleConfig(
    members=2, diversity="none", teacher="joint:independent", network="tiles", steps=150, learning_rate=2e-3
)


@pytest.fixture
def joint(monkeypatch: pytest.MonkeyPatch) -> ModuleType:
    """The example, with few starts."""
    monkeypatch.setattr(sys, "path", [*sys.path, str(EXAMPLES)])
    monkeypatch.setenv("HYPOGOAL_TRUST", "1")
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


def test_the_loss_says_in_how_many_states_features_agree(joint: ModuleType, monkeypatch: pytest.MonkeyPatch) -> None:
    """It need not be given."""
    monkeypatch.setattr(joint, "AGREEMENTS", (0.0, 0.5))
    *states, _ = rooms(1.0)
    search = joint.Search(*states, 2, 3)
    found = search.scores((0.0, 0.5))
    assert np.array_equal(found, search.scores((0.0,))) and not np.array_equal(found, search.scores((0.5,)))


def test_a_rarer_feature_is_found_with_the_share_of_positives(joint: ModuleType) -> None:
    """Proposals have as many positives as the labels, not a half."""
    observations, labels, unlabelled, _ = rooms(1.0)
    kept = np.concatenate([np.flatnonzero(labels)[:32], np.flatnonzero(~labels)[:96]])
    search = joint.Search(observations[kept], labels[kept], unlabelled, 2, 0)
    assert search.positives == 0.25
    assert len(search.signs) == 64 and search.signs.sum() == 0
    shares = (search.scores((0.0,)) > 0).mean(1)
    assert ((shares > 0.1) & (shares < 0.4)).all()


def test_the_table_counts_combinations(joint: ModuleType) -> None:
    """Of certain predictions: by hand, and against a count; of uncertain ones: products."""
    certain = torch.tensor([[[-1.0, -1.0, 1.0, 1.0], [-1.0, -1.0, 1.0, 1.0], [-1.0, 1.0, 1.0, 1.0]]])
    shares = joint.table(certain)[0]
    assert sorted(shares.tolist()) == pytest.approx([0.0] * 5 + [0.25, 0.25, 0.5], abs=1e-6)
    assert shares[[0, -1]].tolist() == pytest.approx([0.25, 0.5], abs=1e-6)
    unsure = torch.rand(2, 4, 7, generator=torch.Generator().manual_seed(0))
    expected = [
        torch.stack([p if positive else 1 - p for p, positive in zip(unsure[1], cell, strict=True)]).prod(0).mean()
        for cell in itertools.product((0, 1), repeat=4)
    ]
    found = joint.table(2 * unsure - 1)[1].tolist()
    assert sorted(found) == pytest.approx(sorted(float(each) for each in expected), abs=1e-6)
    assert (found[0], found[-1]) == pytest.approx((float(expected[0]), float(expected[-1])), abs=1e-6)


def test_patterns_are_counted_and_placed(joint: ModuleType) -> None:
    """A tile's response adds up over the picture, and its side decides the sign of a difference."""
    rng = np.random.default_rng(0)
    kinds = rng.integers(0, 256, (5, 8, 8, 3), dtype=np.uint8)
    cells = rng.integers(4, size=(40, 4, 4))
    cells[0], cells[1], cells[2] = 0, 0, 0
    cells[1, 1, 3] = cells[2, 1, 0] = 4
    pictures = kinds[cells].swapaxes(2, 3).reshape(40, 32, 32, 3)
    features = joint.Patterns(pictures, rng).of(pictures)
    filters = features.shape[1] // 3
    whole, across, down = (features[:, part * filters : (part + 1) * filters] for part in range(3))
    change = (whole[1] - whole[0]).argmax()  # the filter of the tile that only two pictures have
    assert torch.allclose(whole[1], whole[2], atol=1e-3)
    assert across[1, change] > 0.1 and across[2, change] < -0.1
    assert down[1, change] == pytest.approx(float(down[2, change]), abs=1e-3) and down[1, change] < -0.1


def test_some_patterns_are_blind_to_colour_and_some_to_form(joint: ModuleType) -> None:
    """They respond as much to a tile in another colour, or to one whose pixels are in another order; others do not."""
    rng = np.random.default_rng(0)
    kinds = rng.integers(0, 256, (6, 8, 8, 3), dtype=np.uint8)
    kinds[1] = kinds[0][..., [1, 2, 0]]
    kinds[2] = rng.permutation(kinds[0].reshape(64, 3)).reshape(8, 8, 3)
    cells = np.append(rng.integers(3, 6, size=(40, 16)), np.full((3, 16), 5), axis=0)
    cells[-3:, 0] = 0, 1, 2
    pictures = kinds[cells.reshape(-1, 4, 4)].swapaxes(2, 3).reshape(-1, 32, 32, 3)
    features = joint.Patterns(pictures, rng).of(pictures)
    tile, recoloured, shuffled = features[-3:, : features.shape[1] // 3]
    of_tile, as_recoloured, as_shuffled = tile > 1.0, torch.isclose(tile, recoloured), torch.isclose(tile, shuffled)
    assert (of_tile & as_recoloured & ~as_shuffled).any()
    assert (of_tile & as_shuffled & ~as_recoloured).any()
    assert (of_tile & ~as_shuffled & ~as_recoloured).any()


def test_what_does_not_go_with_the_labels_is_left_out(joint: ModuleType) -> None:
    """Noise gets no component; without anything else that is refused."""
    generator = torch.Generator().manual_seed(0)
    labels = torch.arange(200) % 2 == 0
    noise, other = torch.randn(200, 3, generator=generator), torch.randn(300, 4, generator=generator)
    signal = torch.cat([(2.0 * labels - 1.0)[:, None] + 0.1 * noise[:, :1], 100 * noise[:, 1:2].abs()], dim=1)
    labelled, unlabelled = joint.components(signal, labels, other[:, :2])
    assert labelled.shape == (200, 1) and unlabelled.shape == (300, 1)
    with pytest.raises(ValueError, match="no pattern goes with the labels"):
        joint.components(noise * 0, labels, other[:, :3])


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
