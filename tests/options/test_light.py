"""The light learner's fast path: distinct states of a batch once, by their tiles (Spec D2)."""

import numpy as np
import torch

from hypogoal.domains.doorkey.engine import DoorKeyEngine
from hypogoal.options.config import OptionConfig
from hypogoal.options.light import LightLearner
from hypogoal.options.networks import values_of
from hypogoal.options.termination import oracle_terminations


def test_values_and_gradients_are_those_of_every_row() -> None:
    """As of both networks on all the batch's images, rows that repeat included, up to rounding."""
    rng = np.random.default_rng(0)
    engine = DoorKeyEngine(5, 4)
    for _ in range(50):
        engine.step(rng.integers(engine.n_actions, size=4))
    learner = LightLearner(engine, oracle_terminations(engine, range(5)), OptionConfig.of(environments=4), 0)
    with torch.no_grad():
        for weight in learner.networks.target.parameters():
            weight.mul_(0.9)  # so that the target is another network
    s, following = rng.integers(20, size=(2, 64))
    weights = torch.from_numpy(rng.normal(size=(64, 5, 7)).astype(np.float32))

    def slopes(values: torch.Tensor) -> torch.Tensor:
        loss = (values * weights).sum()
        gradients = torch.autograd.grad(loss, [*learner.networks.online.parameters()])
        return torch.cat([gradient.flatten() for gradient in gradients])

    online, target = learner.networks.online, learner.networks.target
    here, next_online, next_target = values_of(online, target, engine, s, following, learner.device)
    fast = slopes(here)
    images, after = (torch.from_numpy(engine.images(states)) for states in (s, following))
    plain = learner.networks.online(images)
    torch.testing.assert_close(here, plain)
    torch.testing.assert_close(fast, slopes(plain), rtol=1e-4, atol=1e-3)
    torch.testing.assert_close(next_online, learner.networks.online(after).detach())
    torch.testing.assert_close(next_target, learner.networks.target(after).detach())
    assert not next_online.requires_grad
    assert not next_target.requires_grad
    assert not torch.allclose(next_online, next_target)
