"""The light learner's batches: distinct states once, by their tiles; what reached sub-goals again (Spec D2, D3)."""

from collections import Counter

import numpy as np
import pytest
import torch
from corridor import LongCorridor

from hypogoal.domains.doorkey.engine import DoorKeyEngine
from hypogoal.options.config import OptionConfig
from hypogoal.options.learner import Transitions
from hypogoal.options.light import Lessons, LightLearner
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


def test_learning_tells_its_health() -> None:
    """After an update: the replay's size, exploration, and finite numbers of the last batch; before it nothing."""
    engine = LongCorridor(4)
    config = OptionConfig.of(environments=4, warm_up=8, update_interval=4, epsilon_from="start", epsilon_steps=100)
    learner = LightLearner(engine, oracle_terminations(engine, [0, 1]), config, 0)
    told = []
    for _ in range(4):
        ids = engine.ids.copy()
        step = engine.step(np.ones(4, int))
        no = np.zeros(4, np.bool_)
        learner.observe(
            Transitions(ids, np.ones(4, int), step.next_ids, step.rewards, np.zeros(4, int), no, no, no, no)
        )
        told.append(learner.learn())
    assert told[0] == {} and told[-1]["replay_size"] == 16
    assert told[-1]["exploration_rate"] == pytest.approx((learner.epsilon()[0] + 1) / 2)
    assert np.isfinite([*told[-1].values()]).all() and told[-1]["option_td_error"] > 0


def test_what_reached_is_drawn_while_its_states_are_remembered() -> None:
    """A quarter of a batch: of the options that have some, each of what an option has alike."""
    engine = LongCorridor(1, memory=120)
    config = OptionConfig.of(environments=1, replay=100, option_batch=8)
    learner = LightLearner(engine, oracle_terminations(engine, [0, 1, 0]), config, 0)
    for _ in range(200):
        engine.step(np.array([0]))
    assert engine.oldest == 84
    learner.replay.add(Lessons.cast([199], [0], [200], [1], [0], [False]))
    reached = {0: [(10, 11), (90, 91), (83, 84), (95, 96)], 1: [(12, 13)], 2: [(0, 150), (0, 20)]}  # 0: the start
    for option, states in reached.items():
        for slot, (state, following) in enumerate(states):
            learner.positive.put((option, slot), Lessons(state, 0, following, 1, option, False))
        learner.positives[option] = len(states)
    drawn: Counter[tuple[int, int]] = Counter()
    for _ in range(200):
        batch, indices, weights = learner._batch()
        assert (len(indices), len(batch), len(weights)) == (6, 8, 8)
        again = batch.at(slice(6, None))
        drawn.update(zip(again.state.tolist(), again.next_state.tolist(), strict=True))
    assert drawn.keys() == {(90, 91), (95, 96), (0, 150)}
    assert all(70 <= drawn[pair] <= 130 for pair in [(90, 91), (95, 96)])
