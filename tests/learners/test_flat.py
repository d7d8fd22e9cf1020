"""Parameters as one vector learn what they learn apart (the rule that a fast path equals the plain one)."""

import copy

import torch
from torch import nn

from hypogoal.learners.flat import FlatParameters


def test_flat_parameters_learn_what_plain_ones_do() -> None:
    """Spec D2: a dozen steps of Adam with clipped gradients, a convolution and dense layers, and a target's average."""
    torch.manual_seed(0)
    plain = nn.Sequential(nn.Conv2d(2, 3, 3), nn.ReLU(), nn.Flatten(), nn.Linear(27, 8), nn.ReLU(), nn.Linear(8, 5))
    ours = copy.deepcopy(plain)
    follower, target = copy.deepcopy(plain), copy.deepcopy(ours)
    flat, behind = FlatParameters(ours), FlatParameters(target, learning=False)
    one = torch.optim.Adam(plain.parameters(), lr=1e-2)
    other = torch.optim.Adam([flat.vector], lr=1e-2, fused=True)
    for _ in range(12):
        images, wanted = torch.randn(16, 2, 5, 5), torch.randn(16, 5)
        one.zero_grad()
        (plain(images) - wanted).square().mean().backward()
        norm = torch.nn.utils.clip_grad_norm_(plain.parameters(), 0.5)
        one.step()
        torch.testing.assert_close(flat.backward((ours(images) - wanted).square().mean(), 0.5), norm)
        other.step()
        with torch.no_grad():
            behind.vector.lerp_(flat.vector, 0.1)
            for held, new in zip(follower.parameters(), plain.parameters(), strict=True):
                held.lerp_(new, 0.1)
    for name, value in plain.state_dict().items():
        torch.testing.assert_close(ours.state_dict()[name], value, rtol=1e-4, atol=1e-5)
        torch.testing.assert_close(target.state_dict()[name], follower.state_dict()[name], rtol=1e-4, atol=1e-5)


def test_what_is_shared_or_frozen_stays_so() -> None:
    """Spec H6: layers of one's own may use a weight twice, or bring some that are not to be learned."""
    torch.manual_seed(0)
    network = nn.Sequential(nn.Linear(3, 3), nn.ReLU(), nn.Linear(3, 3))
    network[2].weight = network[0].weight
    network[0].bias.requires_grad_(False)
    plain = copy.deepcopy(network)
    flat = FlatParameters(network)
    one, other = torch.optim.Adam(plain.parameters(), lr=1e-2), torch.optim.Adam([flat.vector], lr=1e-2)
    for _ in range(3):
        inputs = torch.randn(4, 3)
        one.zero_grad()
        plain(inputs).square().mean().backward()
        one.step()
        flat.backward(network(inputs).square().mean(), 1e6)
        other.step()
    assert len(flat.vector) == 9 + 3 + 3 and network[2].weight is network[0].weight
    for name, value in plain.state_dict().items():
        torch.testing.assert_close(network.state_dict()[name], value)


def test_weights_are_loaded_into_the_vector() -> None:
    """Spec G1: an artefact's weights, read into the modules, are what the optimiser goes on with."""
    torch.manual_seed(0)
    network, other = nn.Linear(3, 2), nn.Linear(3, 2)
    flat = FlatParameters(network)
    network.load_state_dict(other.state_dict())
    torch.testing.assert_close(flat.vector.data, torch.cat([other.weight.data.t().flatten(), other.bias.data]))
