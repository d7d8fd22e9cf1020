"""Proposals that are jointly independent, and the members that they teach (proposals=joint)."""

from __future__ import annotations

import dataclasses
import itertools
from pathlib import Path

import numpy as np
import pytest
import torch
from test_broken_training import Breaking, Broken
from test_training import TOY, follows, toy

from hypogoal.core.checkpoints import Checkpoints
from hypogoal.core.errors import UserError
from hypogoal.domains.rooms.states import FACTORS, labelled_states, unlabelled_states
from hypogoal.hypotheses import proposals
from hypogoal.hypotheses.config import EnsembleConfig
from hypogoal.hypotheses.patterns import Patterns
from hypogoal.hypotheses.proposals import Search, agreements, components, table
from hypogoal.hypotheses.training import Round, Watcher, fit

NAMES = ("colour", "place")
CONFIG = EnsembleConfig(
    members=2, diversity="none", proposals="joint", restarts=8, network="tiles", steps=60, learning_rate=2e-3
)


def states(mix: float, seed: int = 0) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Labelled pictures, labels and unlabelled pictures with two planted features."""
    labelled = labelled_states(256, seed, NAMES)
    return labelled.observations, labelled.factors[:, 0], unlabelled_states(512, mix, seed, NAMES).observations


def searched(search: Search) -> Search:
    for _ in search.steps(lambda *_: None, 10):
        pass
    return search


@pytest.mark.parametrize(("mix", "agreement", "names"), [(0.5, 0.5, FACTORS), (1.0, 0.0, ("shape", "place"))])
def test_the_loss_says_in_how_many_states_features_agree(
    mix: float, agreement: float, names: tuple[str, ...], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Of four or two; it need not be given."""
    monkeypatch.setattr(proposals, "AGREEMENTS", (0.0, 0.5))
    scenes = labelled_states(256, 0, names), unlabelled_states(512, mix, 0, names)
    config = dataclasses.replace(CONFIG, members=len(names), restarts=16)
    search = Search(scenes[0].observations, scenes[0].factors[:, 0], scenes[1].observations, config, 3)
    assert searched(search).agreement == agreement


def test_members_learn_a_feature_each() -> None:
    """With nothing else to make them differ: one the easy feature, the other the hidden one."""
    config = dataclasses.replace(TOY, diversity="none", proposals="joint", agreement="0", restarts=8)
    easy, hard = follows(fit(*toy(), config, seed=1))
    assert sorted(easy.round()) == sorted(hard.round()) == [0, 1]
    assert easy.max() > 0.9 and hard.max() > 0.9


def test_the_table_counts_combinations() -> None:
    """Of certain predictions: by hand, and against a count; of uncertain ones: products."""
    certain = torch.tensor([[[-1.0, -1.0, 1.0, 1.0], [-1.0, -1.0, 1.0, 1.0], [-1.0, 1.0, 1.0, 1.0]]])
    shares = table(certain)[0]
    assert sorted(shares.tolist()) == pytest.approx([0.0] * 5 + [0.25, 0.25, 0.5], abs=1e-6)
    assert shares[[0, -1]].tolist() == pytest.approx([0.25, 0.5], abs=1e-6)
    unsure = torch.rand(2, 4, 7, generator=torch.Generator().manual_seed(0))
    expected = [
        torch.stack([p if positive else 1 - p for p, positive in zip(unsure[1], cell, strict=True)]).prod(0).mean()
        for cell in itertools.product((0, 1), repeat=4)
    ]
    found = table(2 * unsure - 1)[1].tolist()
    assert sorted(found) == pytest.approx(sorted(float(each) for each in expected), abs=1e-6)
    assert (found[0], found[-1]) == pytest.approx((float(expected[0]), float(expected[-1])), abs=1e-6)
    assert table(torch.full((1, 1, 3), -0.5))[0].tolist() == pytest.approx([0.75, 0.25], abs=1e-6)


def test_patterns_are_counted_and_placed() -> None:
    """A tile's response adds up over the picture, and its side decides the sign of a difference."""
    rng = np.random.default_rng(0)
    kinds = rng.integers(0, 256, (5, 8, 8, 3), dtype=np.uint8)
    cells = rng.integers(4, size=(40, 4, 4))
    cells[0], cells[1], cells[2] = 0, 0, 0
    cells[1, 1, 3] = cells[2, 1, 0] = 4
    pictures = kinds[cells].swapaxes(2, 3).reshape(40, 32, 32, 3)
    features = Patterns(pictures, 8, rng).of(pictures)
    filters = features.shape[1] // 3
    whole, across, down = (features[:, part * filters : (part + 1) * filters] for part in range(3))
    change = (whole[1] - whole[0]).argmax()  # the filter of the tile that only two pictures have
    assert torch.allclose(whole[1], whole[2], atol=1e-3)
    assert across[1, change] > 0.1 and across[2, change] < -0.1
    assert down[1, change] == pytest.approx(float(down[2, change]), abs=1e-3) and down[1, change] < -0.1


def test_some_patterns_are_blind_to_colour_and_some_to_form() -> None:
    """They respond as much to a tile in another colour, or to one whose pixels are in another order; others do not."""
    rng = np.random.default_rng(0)
    kinds = rng.integers(0, 256, (6, 8, 8, 3), dtype=np.uint8)
    kinds[1] = kinds[0][..., [1, 2, 0]]
    kinds[2] = rng.permutation(kinds[0].reshape(64, 3)).reshape(8, 8, 3)
    cells = np.append(rng.integers(3, 6, size=(40, 16)), np.full((3, 16), 5), axis=0)
    cells[-3:, 0] = 0, 1, 2
    pictures = kinds[cells.reshape(-1, 4, 4)].swapaxes(2, 3).reshape(-1, 32, 32, 3)
    features = Patterns(pictures, 8, rng).of(pictures)
    tile, recoloured, shuffled = features[-3:, : features.shape[1] // 3]
    of_tile, as_recoloured, as_shuffled = tile > 1.0, torch.isclose(tile, recoloured), torch.isclose(tile, shuffled)
    assert (of_tile & as_recoloured & ~as_shuffled).any()
    assert (of_tile & as_shuffled & ~as_recoloured).any()
    assert (of_tile & ~as_shuffled & ~as_recoloured).any()


def test_shape_and_place_are_found_where_colour_varies() -> None:
    """Labels fit *shape if it is red, else place* and its opposite as well, which are independent, too."""
    names = ("shape", "place")
    labelled, unlabelled = labelled_states(256, 0, names), unlabelled_states(512, 1.0, 0, names)
    config = dataclasses.replace(CONFIG, agreement="0")
    search = Search(labelled.observations, labelled.factors[:, 0], unlabelled.observations, config, 0)
    right = (searched(search).scores().numpy() > 0)[:, :, None] == unlabelled.factors  # (K, M, F)
    assert sorted(right.mean(1).argmax(0).tolist()) == [0, 1]
    assert (right.mean(1).max(0) > 0.95).all()


def test_what_does_not_go_with_the_labels_is_left_out() -> None:
    """Noise gets no component; without anything else that is refused."""
    generator = torch.Generator().manual_seed(0)
    labels = torch.arange(200) % 2 == 0
    noise, other = torch.randn(200, 3, generator=generator), torch.randn(300, 4, generator=generator)
    signal = torch.cat([(2.0 * labels - 1.0)[:, None] + 0.1 * noise[:, :1], 100 * noise[:, 1:2].abs()], dim=1)
    labelled, unlabelled = components(signal, labels, other[:, :2])
    assert labelled.shape == (200, 1) and unlabelled.shape == (300, 1)
    with pytest.raises(UserError, match="no pattern goes with the labels"):
        components(noise * 0, labels, other[:, :3])


def test_a_rarer_feature_is_found_with_the_share_of_positives() -> None:
    """Proposals have as many positives as the labels, not a half."""
    observations, labels, unlabelled = states(1.0)
    kept = np.concatenate([np.flatnonzero(labels)[:32], np.flatnonzero(~labels)[:96]])
    config = dataclasses.replace(CONFIG, agreement="0")
    search = Search(observations[kept], labels[kept], unlabelled, config, 0)
    assert search.positives == 0.25
    assert len(search.signs) == 64 and search.signs.sum() == 0
    shares = (searched(search).scores() > 0).float().mean(1)
    assert ((shares > 0.1) & (shares < 0.4)).all()


@pytest.mark.parametrize("schedule", ["simultaneous", "sequential"])
def test_a_broken_training_is_resumed_to_the_last_bit(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, schedule: str
) -> None:
    """Spec G1: broken in both halves of a search, between two and in the members' training; reports go on."""
    monkeypatch.setattr(proposals, "STEPS", 8)
    monkeypatch.setattr(proposals, "AGREEMENTS", (0.0, 0.5))
    config = dataclasses.replace(CONFIG, steps=4, schedule=schedule)

    def trained(checkpoints: Checkpoints | None) -> tuple[dict[str, torch.Tensor], list[int]]:
        steps: list[int] = []
        ensemble = fit(*states(1.0), config, 0, Watcher(lambda step, _: steps.append(step)), checkpoints=checkpoints)
        return ensemble.state(), steps

    unbroken, steps = trained(None)
    again, _ = trained(None)
    assert steps[-1] == (20 if schedule == "simultaneous" else 24)
    path = tmp_path / "ensemble.safetensors"
    for last in (3, 3, 2, 6, 4, 6):
        with pytest.raises(Broken):
            trained(Breaking(path, last))
    saved = Checkpoints(path).load() or {}
    Checkpoints(path).save({**saved, "search": {}})
    with pytest.raises(UserError, match="does not fit"):
        trained(Checkpoints(path))
    Checkpoints(path).save(saved)
    resumed, _ = trained(Checkpoints(path))
    for state in (again, resumed):
        assert all(torch.equal(state[name], value) for name, value in unbroken.items())


def test_proposals_teach_in_proportion_to_their_confidence() -> None:
    """A member's loss grows by the mean of w * cross entropy, w = |score| up to 1."""
    observations, labels, unlabelled = toy()
    config = dataclasses.replace(CONFIG, steps=1, network="doorkey", batch_size=32)
    seen: list[torch.Tensor] = []
    made = Round._losses

    def recorded(self: Round, *batch: np.ndarray) -> tuple[torch.Tensor, torch.Tensor]:
        with_proposals, _ = made(self, *batch)
        taught, self.taught = self.taught, torch.zeros_like(self.taught)
        without, _ = made(self, *batch)
        self.taught = taught
        scores = taught[:, batch[1] - self.states.n_labelled]
        for member, (_, logits) in enumerate(self._forward(*batch, counted=(True, True)).logits):
            right = torch.where(scores[member] > 0, logits[:, 1], logits[:, 0]) - logits.logsumexp(1)
            seen.append(with_proposals[member] - without[member] + (right * scores[member].abs().clamp(max=1)).mean())
        return made(self, *batch)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(Round, "_losses", recorded)
        patch.setattr(proposals, "STEPS", 4)
        fit(observations, labels, unlabelled, config, 0)
    assert len(seen) == 2
    assert torch.stack(seen).abs().max() < 1e-4


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"agreement": "much"}, "not an agreement"),
        ({"agreement": "1"}, "not an agreement"),
        ({"agreement": "nan"}, "not an agreement"),
        ({"members": 1}, "independent of each other"),
        ({"members": 9}, "independent of each other"),
    ],
)
def test_wrong_settings_are_refused(settings: dict[str, object], message: str) -> None:
    """In one line; without proposals nobody asks."""
    config = dataclasses.replace(CONFIG, **settings)
    with pytest.raises(UserError, match=message):
        agreements(config)
    assert agreements(dataclasses.replace(config, proposals="none")) == ()


def test_observations_that_do_not_suit_are_refused() -> None:
    """Numbers, pictures smaller than a pattern, and no unlabelled states."""
    observations, labels, unlabelled = toy()
    numbers = observations.astype(np.float32)
    with pytest.raises(UserError, match=r"not pictures.*proposals=joint"):
        fit(numbers, labels, numbers, dataclasses.replace(CONFIG, network="mlp"), 0)
    with pytest.raises(UserError, match="too small"):
        Search(observations[:, :7], labels, unlabelled[:, :7], CONFIG, 0)
    with pytest.raises(UserError, match="unlabelled states are needed"):
        fit(observations, labels, unlabelled[:0], CONFIG, 0)
