"""Spec F2: DeepLift against values worked by hand, and complete on both of the paper's networks."""

import copy

import numpy as np
import pytest
import torch
from torch import nn

from hypogoal.hypotheses.deep_lift import DEEP_LIFT, INTEGRATED, attributed, mean_state, method_of
from hypogoal.hypotheses.ensemble import Ensemble

SHAPES = {"doorkey": (64, 64, 3), "montezuma": (84, 84, 4)}
BOUND = 1e-9  # log-odds; in double what is left is rounding


class Members:
    """What DeepLift asks of an ensemble."""

    def __init__(self, *members):
        self.members = members


def dense(weights):
    """Flattened inputs -> logits (0, weights . inputs)."""
    layer = nn.Linear(len(weights), 2, bias=False)
    with torch.no_grad():
        layer.weight[:] = torch.tensor([[0.0] * len(weights), weights])
    return layer


def states(*rows):
    """States of one row of pixels in one channel, given in 0..1."""
    return (255 * np.array(rows)[:, None, :, None]).round().astype(np.uint8)


def test_a_linear_member_by_hand():
    """Spec F2: each pixel's attribution is its weight times what it differs from the baseline."""
    member = nn.Sequential(nn.Flatten(), dense([2.0, -3.0]))
    found = attributed(Members(member), states([1, 0.2], [0, 0]), states([0.2, 0])[0])
    np.testing.assert_allclose(found.values[:, 0, 0, :, 0], [[1.6, -0.6], [-0.4, 0]], atol=1e-7)
    np.testing.assert_allclose(found.log_odds[:, 0], [1.4, 0], atol=1e-7)
    np.testing.assert_allclose(found.baseline_log_odds, [0.4], atol=1e-7)
    assert found.completeness_error().max() < BOUND


def test_a_relu_by_hand():
    """Spec F2: the rescale rule: relu(x0 + x1 - 1) of (1, 1) against (0, 0) gives each pixel half of the 1 it made.

    The gradient would give each a whole 1, and the sum would not be the difference.
    """
    first = nn.Linear(2, 1)
    with torch.no_grad():
        first.weight[:], first.bias[:] = 1.0, -1.0
    member = nn.Sequential(nn.Flatten(), first, nn.ReLU(), dense([1.0]))
    found = attributed(Members(member), states([1, 1]), states([0, 0])[0])
    np.testing.assert_allclose(found.values.ravel(), [0.5, 0.5], atol=1e-7)


class Product(nn.Module):
    """Two pixels -> their product."""

    def forward(self, images):
        return images.flatten(1).prod(1, keepdim=True)


def test_integrated_gradients_by_hand():
    """Spec F2: on the way from (0, 0) to (1, .8) each pixel's gradient grows to the other; half of the product each.

    At the end of the way the gradients are .8 and 1, which do not add up to it.
    """
    member = nn.Sequential(Product(), dense([3.0]))
    assert method_of(member) == INTEGRATED
    found = attributed(Members(member), states([1, 0.8]), states([0, 0])[0])
    np.testing.assert_allclose(found.values.ravel(), [1.2, 1.2], atol=1e-5)
    np.testing.assert_allclose(found.log_odds, [[2.4]], atol=1e-6)
    assert found.method == INTEGRATED and found.completeness_error().max() < 1e-5


TWICE = nn.ReLU()
CHAINS = [
    ([nn.Conv2d(1, 2, 1), nn.ReLU(), nn.MaxPool2d(2, 1), nn.Flatten()], DEEP_LIFT),
    ([nn.Conv2d(1, 2, 1), nn.GELU(), nn.Flatten()], INTEGRATED),
    ([nn.Conv2d(1, 2, 1), nn.ReLU(), nn.MaxPool2d(2, 1, padding=1), nn.Flatten()], INTEGRATED),
    ([nn.Conv2d(1, 2, 1), TWICE, nn.Conv2d(2, 2, 1), TWICE, nn.Flatten()], INTEGRATED),
]


@pytest.mark.parametrize(("layers", "method"), CHAINS)
def test_deep_lift_explains_what_its_rules_hold_for(layers, method):
    """Spec F2: else integrated gradients; both say which they are, and add up."""
    torch.manual_seed(0)
    member = nn.Sequential(*layers, nn.LazyLinear(2))
    member(torch.zeros(1, 1, 2, 2))
    for weight in member.parameters():
        nn.init.uniform_(weight, 0.1, 0.9)
    state = np.array([[[9], [200]], [[30], [90]]], np.uint8)
    found = attributed(Members(member), state[None], 0 * state)
    assert method_of(member) == found.method == method
    assert found.completeness_error().max() < 0.02 * np.abs(found.values).sum() > 1e-4


def test_overlapping_windows_by_hand():
    """Spec F2: the pixel that is the maximum of two windows is credited for both.

    Captum's own rule credits it for one, and its attributions do not add up.
    """
    member = nn.Sequential(nn.MaxPool2d((1, 2), stride=1), nn.Flatten(), dense([1.0, 10.0]))
    found = attributed(Members(member), states([0, 1, 0]), states([0, 0, 0])[0])
    np.testing.assert_allclose(found.values.ravel(), [0, 11, 0], atol=1e-7)
    assert found.completeness_error().max() < BOUND


def trained(network, members=2):
    """An ensemble whose normalisation has seen something, as after training."""
    ensemble = Ensemble(network, SHAPES[network], members, torch.Generator().manual_seed(3))
    height, width, channels = SHAPES[network]
    for member in ensemble.members:
        for seed in range(3):
            member(torch.rand(8, channels, height, width, generator=torch.Generator().manual_seed(seed)))
    return ensemble.eval()


@pytest.mark.parametrize("network", SHAPES)
def test_attributions_are_complete(network):
    """Spec F2, C5: on both networks they add up to the change in log-odds, which is that of ``predict``."""
    rng = np.random.default_rng(0)
    observations = (255 * (rng.random((3, *SHAPES[network])) > 0.7)).astype(np.uint8)
    ensemble = trained(network)
    before = copy.deepcopy(ensemble.state_dict())
    found = attributed(
        ensemble, observations, mean_state(rng.integers(256, size=(20, *SHAPES[network]), dtype=np.uint8))
    )
    assert found.values.shape == (3, 2, *SHAPES[network])
    assert found.completeness_error().max() < BOUND
    assert np.abs(found.values.sum(axis=(2, 3, 4))).max() > 1e-3, "nothing was attributed"
    probabilities = ensemble.predict(observations).astype(np.float64)
    np.testing.assert_allclose(found.log_odds, np.log(probabilities / (1 - probabilities)), atol=1e-4)
    assert all(torch.equal(value, before[name]) for name, value in ensemble.state_dict().items())
    assert all(parameter.dtype == torch.float32 for parameter in ensemble.parameters())


def test_the_state_that_is_the_baseline_has_no_attribution():
    """Spec F2: and the mean state is the mean, rounded."""
    observations = np.array([[[[10, 20]]], [[[13, 21]]]], np.uint8)
    assert mean_state(observations).tolist() == [[[12, 20]]]
    ensemble = trained("montezuma", 1)
    state = np.full(SHAPES["montezuma"], 7, np.uint8)
    assert np.abs(attributed(ensemble, state[None], state).values).max() < BOUND
