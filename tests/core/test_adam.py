"""Adam's step against torch's own."""

import pytest
import torch
from torch import nn

from hypogoal.core.adam import Adam


@pytest.mark.parametrize("settings", [{"lr": 1e-3}, {"lr": 5e-4, "eps": 1e-5}, {"lr": 2e-4, "weight_decay": 1e-2}])
def test_weights_get_the_same_bytes(settings: dict[str, float]) -> None:
    """Also where the rate changes, and where some weights have no gradient in some steps."""
    torch.manual_seed(0)
    networks = [nn.Sequential(nn.Conv2d(3, 16, 3), nn.Flatten(), nn.Linear(16 * 36, 7)) for _ in range(2)]
    networks[1].load_state_dict(networks[0].state_dict())
    ours, theirs = (
        Adam(networks[0].parameters(), **settings),
        torch.optim.Adam(networks[1].parameters(), fused=True, **settings),
    )
    for step in range(30):
        ours.lr = theirs.param_groups[0]["lr"] = settings["lr"] * (1 + step % 3)
        states = torch.randn(5, 3, 8, 8)
        for network, optimiser in zip(networks, (ours, theirs), strict=True):
            optimiser.zero_grad()
            network(states).square().sum().backward()
            if step % 4 == 0:
                network[0].weight.grad = None
            optimiser.step()
        for one, other in zip(networks[0].parameters(), networks[1].parameters(), strict=True):
            assert torch.equal(one, other)
