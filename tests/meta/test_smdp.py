"""SMDP returns and the meta-policy's loss (Spec E1-E3)."""

import math
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch
from corridor import Corridor
from numpy.typing import NDArray
from stable_baselines3.common.utils import explained_variance as theirs

from hypogoal.core.errors import UserError
from hypogoal.meta import smdp
from hypogoal.meta.config import MetaConfig, TrainMetaConfig
from hypogoal.meta.networks import CategoricalHead, GaussianHead, LightMetaNetwork, PaperMetaNetwork, among
from hypogoal.meta.ppo import HEALTH, Draws, MetaPolicy, changes, clipped_surrogate
from hypogoal.meta.smdp import explained_variance, scaled_advantages, smdp_advantages
from hypogoal.options.choosers import Outcome


def advantages_of(columns: list[tuple[float, ...]], trace: float) -> NDArray[np.float64]:
    """Of decisions in a row: return, discount, value, next value, whether terminated, whether ended."""
    returns, discounts, values, following, terminated, ended = np.array(columns).T
    return smdp_advantages(returns, discounts, values, following, terminated > 0, ended > 0, trace)


def test_advantages_by_hand() -> None:
    """Spec E1: two options of 3 and 2 steps, gamma .9, lambda .5, the second reaches the goal with reward 1."""
    last = 0.9 - 0.6  # reward 1 at the option's second step
    first = 0.9**3 * 0.6 - 0.4 + 0.9**3 * 0.5 * last
    found = advantages_of([(0.0, 0.9**3, 0.4, 0.6, 0, 0), (0.9, 0.9**2, 0.6, 7.0, 1, 1)], 0.5)
    np.testing.assert_allclose(found, [first, last])


def test_a_cut_episode_bootstraps_and_does_not_leak_into_the_next() -> None:
    """Spec D2, E1: truncation is not termination."""
    found = advantages_of([(0.0, 0.5, 0.0, 2.0, 0, 1), (1.0, 0.5, 0.0, 0.0, 1, 1)], 1.0)
    np.testing.assert_allclose(found, [1.0, 1.0])


def test_the_advantages_scale_by_hand() -> None:
    """Spec E1: a floor above their spread keeps noise small; below it, and without one, they are standardised."""
    noise = np.array([0.001, -0.003, 0.002])
    np.testing.assert_allclose(scaled_advantages(noise, 0.1), noise * 10)
    signal = np.array([1.0, 3.0])
    np.testing.assert_allclose(scaled_advantages(signal, 0.1), [-1.0, 1.0])
    np.testing.assert_allclose(scaled_advantages(signal, 0.0), [-1.0, 1.0])
    np.testing.assert_allclose(scaled_advantages(np.full(3, 7.0), 0.0), np.zeros(3))


def test_the_clipped_surrogate_by_hand() -> None:
    """Spec E1: Eq. (7) of Schulman et al. 2017."""
    ratio = torch.tensor([1.5, 0.5, 1.1])
    advantages = torch.tensor([1.0, -1.0, 2.0])
    loss = clipped_surrogate(ratio.log(), torch.zeros(3), advantages, 0.2)
    assert float(loss) == pytest.approx(-(1.2 - 0.8 + 2.2) / 3)


def test_what_an_update_changed_by_hand() -> None:
    """Ratios 1, 2 and .5: of two of three the policy went further than .2; the estimate is never below 0."""
    kl, clipped = changes(torch.tensor([0.0, math.log(2), -math.log(2)]), torch.zeros(3), 0.2)
    assert kl.item() == pytest.approx(((2 - 1 - math.log(2)) + (0.5 - 1 + math.log(2))) / 3)
    assert clipped.item() == pytest.approx(2 / 3)
    rng = np.random.default_rng(0)
    values, returns = rng.random((2, 50))
    assert explained_variance(values, returns) == pytest.approx(theirs(values, returns))
    assert explained_variance(values, np.ones(50)) == 0.0


def test_an_update_tells_its_health() -> None:
    """Each number by stable-baselines3's name; a single batch is of the policy that drew."""
    policy = MetaPolicy(Corridor(2), 2, MetaConfig(decisions=6, meta_batch=6, epochs=1), 0)
    outcomes = replace(
        Outcome.zeros(6), environments=np.repeat([0, 1], 3), returns=np.arange(6) / 6, terminated=np.ones(6, np.bool_)
    )
    told = policy.update(draws_in(np.arange(6) % 5), outcomes)
    assert told["approx_kl"] == pytest.approx(0, abs=1e-3) and told["clip_fraction"] == 0
    assert told["entropy_loss"] == pytest.approx(-math.log(2), abs=1e-3)
    assert told["value_loss"] == pytest.approx(((outcomes.returns - told["value"]) ** 2).mean(), abs=0.05)
    assert told.keys() == {"value", *HEALTH, "explained_variance"}


def test_masked_options_are_never_drawn() -> None:
    """Spec D6, E2: neither head draws an option that is not offered, and the categorical gives it no probability."""
    scores = torch.tensor([[50.0, 0.0, 0.0, 1.0]]).repeat(500, 1)
    offered = torch.tensor([[False, True, False, True]]).repeat(500, 1)
    generator = torch.Generator().manual_seed(0)
    for head in (CategoricalHead(), GaussianHead(4)):
        options, drawn = head.draw(scores, offered, generator)
        assert set(options.tolist()) == {1, 3}
        log_prob, entropy = head.log_prob(scores, offered, drawn)
        assert torch.isfinite(log_prob).all() and torch.isfinite(entropy).all()
        assert log_prob.shape == entropy.shape == (500,)
        assert int(among(scores, offered).argmax(1)[0]) == 3
    log_prob, entropy = CategoricalHead().log_prob(scores[:1], offered[:1], torch.tensor([[3.0]]))
    assert float(log_prob.detach()) == pytest.approx(1 - np.log(np.exp(1) + 1))
    p = np.exp(1) / (1 + np.exp(1))
    assert float(entropy.detach()) == pytest.approx(-(p * np.log(p) + (1 - p) * np.log(1 - p)), rel=1e-5)


@pytest.mark.parametrize(
    "network", [LightMetaNetwork((64, 64, 3), 15, None, "light"), PaperMetaNetwork((64, 64, 3), 15)]
)
def test_networks_give_a_score_per_option_and_a_value(network: torch.nn.Module) -> None:
    """Spec E2: shared features, an actor and a critic; early choices are nearly uniform."""
    out = network(torch.randint(0, 256, (2, 64, 64, 3), dtype=torch.uint8))
    assert out.shape == (2, 16)
    assert float(out.detach()[:, :15].softmax(1).max()) < 0.08


def test_the_papers_network_has_the_size_that_its_deviation_gives() -> None:
    """Spec E2, DEV-49: 0.4 million weights on DoorKey's picture."""
    size = sum(weights.numel() for weights in PaperMetaNetwork((64, 64, 3), 15).parameters())
    assert 400_000 < size < 450_000


def draws_in(states: NDArray[np.int64]) -> Draws:
    """The first and the second of two options in turn, each with probability one half."""
    count = len(states)
    return Draws(
        states,
        offered=np.ones((count, 2), dtype=np.bool_),
        drawn=(states[:, None] % 2).astype(np.float32),
        log_prob=np.full(count, np.log(0.5), dtype=np.float32),
    )


def test_the_value_that_is_learned_is_what_decisions_return() -> None:
    """Spec E1, E2: where each decision returns .5 and ends its episode, every state is worth .5."""
    policy = MetaPolicy(Corridor(4), 2, MetaConfig(decisions=32, meta_batch=16), 0)
    states = np.arange(32) % 5
    outcomes = replace(
        Outcome.zeros(32),
        environments=np.repeat(np.arange(4), 8),
        returns=np.full(32, 0.5),
        discounts=np.full(32, 0.9),
        next_ids=states,
        terminated=np.ones(32, dtype=np.bool_),
    )
    values = [policy.update(draws_in(states), outcomes)["value"] for _ in range(20)]
    assert abs(values[0]) < 0.1 and values[-1] == pytest.approx(0.5, abs=0.1)


def test_credit_ends_with_an_episode_and_with_an_environment(monkeypatch: pytest.MonkeyPatch) -> None:
    """Spec E1: of decisions side by side none is credited with what another environment's, or episode's, returned."""
    asked: list[tuple[NDArray[np.bool_], ...]] = []

    def noted(*given: Any) -> Any:
        asked.append(given)
        return smdp_advantages(*given)

    monkeypatch.setattr(smdp, "smdp_advantages", noted)
    outcomes = replace(
        Outcome.zeros(6),
        environments=np.repeat([0, 1], 3),
        terminated=np.array([True, False, False, False, False, False]),
        truncated=np.array([False, False, False, False, True, False]),
    )
    MetaPolicy(Corridor(2), 2, MetaConfig(decisions=6, meta_batch=6), 0).update(draws_in(np.arange(6) % 5), outcomes)
    *_, terminated, ended, _ = asked[0]
    assert terminated.tolist() == outcomes.terminated.tolist()
    assert ended.tolist() == [True, False, True, False, True, True]


@pytest.mark.parametrize("head", ["categorical", "gaussian"])
def test_where_nothing_is_to_be_gained_choices_become_less_certain(head: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """Spec E1: of zero advantages the entropy bonus alone is left; the first option begins with a score of 1."""
    monkeypatch.setattr(smdp, "smdp_advantages", lambda returns, *_: np.zeros(len(returns)))
    policy = MetaPolicy(Corridor(2), 2, MetaConfig(head=head, decisions=6, meta_batch=6), 0)
    with torch.no_grad():
        policy.network.get_submodule("outputs").bias[0] = 1.0
    outcomes = replace(Outcome.zeros(6), environments=np.repeat([0, 1], 3))
    draws = replace(draws_in(np.arange(6) % 5), drawn=np.zeros((6, policy.head.remembered), np.float32))
    entropies = [-policy.update(draws, outcomes)["entropy_loss"] for _ in range(3)]
    assert entropies == sorted(entropies) and entropies[-1] > entropies[0] + 1e-3


def test_the_papers_network_sees_pictures_only() -> None:
    """Refused before training, in a line that names the setting."""
    config = TrainMetaConfig.of(chooser="ppo", meta_network="paper")
    engine = Corridor(1)
    MetaPolicy.refuse(config, engine)
    engine.observation_dtype = "float32"
    with pytest.raises(UserError, match="see pictures only: meta_network=paper"):
        MetaPolicy.refuse(config, engine)
