"""Many members as one network give what each member gives (Spec D1; the rule that a fast path equals the plain one)."""

import copy

import numpy as np
import pytest
import torch
from torch import nn

from hypogoal.hypotheses.ensemble import Ensemble
from hypogoal.hypotheses.networks import NETWORKS
from hypogoal.hypotheses.stacked import StackedMembers


@pytest.mark.parametrize(("network", "shape"), [("doorkey", (64, 64, 3)), ("montezuma", (84, 84, 4))])
def test_stacked_members_equal_each_ensemble(network: str, shape: tuple[int, ...]) -> None:
    """Two ensembles of two members, with running statistics that are not the initial ones."""
    generator = torch.Generator().manual_seed(0)
    rng = np.random.default_rng(0)
    ensembles = [Ensemble(network, shape, 2, generator) for _ in range(2)]
    states = rng.integers(0, 256, size=(70, *shape), dtype=np.uint8)
    for ensemble in ensembles:
        ensemble.train()
        for member in ensemble.members:
            member(torch.from_numpy(states[:16]).permute(0, 3, 1, 2).float() / 255)
        ensemble.eval()
    plain = np.concatenate([ensemble.log_odds(states) for ensemble in ensembles], axis=1)
    stacked = StackedMembers(ensembles).log_odds(states)
    np.testing.assert_allclose(stacked, plain, atol=1e-5)
    assert np.ptp(plain) > 1e-3


OWN = {
    "BatchNorm after ReLU": [nn.Conv2d(3, 8, 3), nn.ReLU(), nn.BatchNorm2d(8), nn.MaxPool2d(2)],
    "GroupNorm": [nn.Conv2d(3, 8, 3), nn.GroupNorm(2, 8), nn.ReLU()],
    "groups": [nn.Conv2d(3, 8, 3), nn.ReLU(), nn.Conv2d(8, 8, 3, groups=2), nn.ReLU()],
    "a slope of its own": [nn.Conv2d(3, 8, 3), nn.PReLU(), nn.MaxPool2d(2)],
    "joined after all": [nn.Conv2d(3, 8, 3, padding=1), nn.BatchNorm2d(8), nn.ReLU(), nn.AvgPool2d(2), nn.Dropout()],
}


@pytest.mark.parametrize("name", OWN)
def test_own_networks_of_other_layers_predict_the_same(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """Spec C5: what cannot be joined is predicted ensemble by ensemble."""

    def own(channels: int) -> tuple[list[nn.Module], tuple[int, ...]]:
        layers = copy.deepcopy(OWN[name])
        for layer in layers:
            for values in (*layer.parameters(), *layer.buffers()):
                if values.dtype == torch.float32:
                    nn.init.uniform_(values, 0.1, 0.4)
        return layers, (16,)

    monkeypatch.setitem(NETWORKS, "own", own)
    generator = torch.Generator().manual_seed(0)
    ensembles = [Ensemble("own", (16, 16, 3), 2, generator).eval() for _ in range(2)]
    states = np.random.default_rng(0).integers(0, 256, size=(10, 16, 16, 3), dtype=np.uint8)
    stacked = StackedMembers(ensembles)
    assert stacked.joined == (name == "joined after all")
    plain = np.concatenate([ensemble.log_odds(states) for ensemble in ensembles], axis=1)
    np.testing.assert_allclose(stacked.log_odds(states), plain, atol=1e-5)
    assert stacked.log_odds(states).shape == (10, 4)
    assert np.ptp(plain) > 1e-4
