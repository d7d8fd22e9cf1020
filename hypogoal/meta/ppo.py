"""The meta-policy: PPO (Schulman et al. 2017) over options, with decisions discounted by their duration."""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any, Self

import numpy as np
import torch
from torch import Tensor, nn

from hypogoal.core import seeding
from hypogoal.core.adam import Adam
from hypogoal.core.arrays import Bools, Columns, Floats, Ints, tensor
from hypogoal.core.drawing import DrawsFrom
from hypogoal.core.errors import UserError
from hypogoal.core.tensors import load_into
from hypogoal.domains.base import Engine
from hypogoal.meta import networks, smdp
from hypogoal.meta.config import MetaConfig
from hypogoal.observations import PICTURE
from hypogoal.options import choosers
from hypogoal.options.config import STACK, OptionConfig
from hypogoal.options.double_dqn import descend
from hypogoal.options.networks import apply_to_states

GRADIENT_NORM = 0.5
CLIP = 0.2  # the clipping range of the ratio of probabilities. Source: Schulman et al. 2017
VALUE_WEIGHT = 0.5  # the weight of the value loss. Source: Schulman et al. 2017
ENTROPY_WEIGHT = 0.01  # the weight of the entropy bonus. Source: Table 5
# The names, by stable-baselines3, of what is logged of an update: means over its batches.
HEALTH = ("policy_gradient_loss", "value_loss", "entropy_loss", "approx_kl", "clip_fraction")


@dataclass(frozen=True)
class Draws(Columns):
    """Choices of options, as arrays (n, ...)."""

    state: Ints  # the state in which the option was chosen
    offered: Bools  # (n, O), which options were offered
    drawn: Floats  # (n, R), what the head remembers of the draw
    log_prob: Floats


class MetaPolicy(choosers.Chooser):
    """A chooser among O options for every environment, which learns from what the options return.

    ``seed`` seeds weights, draws and minibatches. The networks are on ``device``, and options are drawn on the CPU.
    """

    CHANGING = ("policy", "optimiser", "generator", "rng", "running", "draws", "outcomes", "updates")

    def __init__(
        self,
        engine: Engine,
        options: int,
        config: MetaConfig,
        seed: int,
        device: torch.device | str = "cpu",
    ):
        self.engine, self.config, self.device = engine, config, torch.device(device)
        shape, name = engine.observation_shape, config.meta_network
        with DrawsFrom(seeding.torch_generator(seed, "meta-weights")):
            if name == "paper":
                self.network: nn.Module = networks.PaperMetaNetwork(shape, options)
            else:
                self.network = networks.LightMetaNetwork(shape, options, engine.standard, name)
            self.head = networks.make_head(config.head, options)
        self.policy = nn.ModuleDict({"network": self.network, "head": self.head}).to(self.device)
        self.optimiser = Adam(self.policy.parameters(), config.meta_learning_rate, eps=1e-5)
        self.generator = seeding.torch_generator(seed, "meta-draws")
        self.rng = seeding.rng_for(seed, "meta-batches")
        count = engine.count
        self.running = replace(  # the last choice in every environment
            Draws.zeros(count),
            offered=np.zeros((count, options), np.bool_),
            drawn=np.zeros((count, self.head.remembered), np.float32),
        )
        self.draws: list[Draws] = []  # the decisions since the last update, in the order of their ends
        self.outcomes: list[choosers.Outcome] = []  # what came of the decisions
        self.updates = 0

    @classmethod
    def refuse(cls, config: OptionConfig, engine: Engine) -> None:
        """Raise ``UserError`` if ``meta_network`` is ``paper`` and observations are no pictures."""
        if config.part(MetaConfig).meta_network == "paper" and engine.observation_dtype != PICTURE:
            raise UserError(
                "the paper's networks see pictures only",
                "meta_network=paper",
                "Give --set meta_network=light.",
            )

    @classmethod
    def create(
        cls,
        engine: Engine,
        options: int,
        config: OptionConfig,
        seed: int,
        device: str,
    ) -> Self:
        return cls(engine, options, config.part(MetaConfig), seed, device)

    @staticmethod
    def reach(config: OptionConfig) -> int:
        """Return how many states back the decisions that wait for the next update reach."""
        decisions = config.part(MetaConfig).decisions
        return (decisions + config.environments) * config.option_timeout + STACK * config.environments

    def choose(self, environments: Ints, ids: Ints, offered: Bools) -> Ints:
        mask = torch.from_numpy(offered)
        with torch.no_grad():
            scores = self._outputs(ids)[:, :-1].cpu()
            options, drawn = self.head.draw(scores, mask, self.generator)
            log_prob, _ = self.head.log_prob(scores, mask, drawn)
        self.running.put(
            environments,
            Draws(
                ids,
                offered,
                drawn.numpy(),
                log_prob.numpy(),
            ),
        )
        return options.numpy()

    def record(self, outcome: choosers.Outcome) -> None:
        self.draws.append(self.running.at(outcome.environments))
        self.outcomes.append(outcome)

    def begin_anew(self) -> None:
        self.draws, self.outcomes = [], []

    def learn(self) -> dict[str, float]:
        if sum(map(len, self.draws)) < self.config.decisions:
            return {}
        draws, outcomes = Draws.joined(self.draws), choosers.Outcome.joined(self.outcomes)
        self.begin_anew()
        order = np.argsort(outcomes.environments, kind="stable")
        return self.update(draws.at(order), outcomes.at(order))

    def _outputs(self, ids: Ints) -> Tensor:
        return apply_to_states(self.network, self.engine, ids, self.device)

    def update(self, draws: Draws, outcomes: choosers.Outcome) -> dict[str, float]:
        """Learn from decisions, which are sorted by environment and then by time. Return numbers to log."""
        config = self.config
        with torch.no_grad():
            outputs = self._outputs(draws.state)
            following = self._outputs(outcomes.next_ids)
        values = outputs[:, -1].double().cpu().numpy()
        last = np.diff(outcomes.environments, append=-1) != 0  # the next decision is another environment's
        advantages = smdp.smdp_advantages(
            outcomes.returns,
            outcomes.discounts,
            values,
            following[:, -1].double().cpu().numpy(),
            outcomes.terminated,
            outcomes.terminated | outcomes.truncated | last,
            config.gae_lambda,
        )
        goals = tensor(advantages + values, self.device).float()
        scaled = tensor(smdp.scaled_advantages(advantages, config.advantage_floor), self.device).float()
        offered = tensor(draws.offered, self.device)
        drawn = tensor(draws.drawn, self.device)
        old = tensor(draws.log_prob, self.device)
        health = []
        for epoch in range(config.epochs):
            order = self.rng.permutation(len(draws))
            for begin in range(0, len(order), config.meta_batch):
                rows = order[begin : begin + config.meta_batch]
                pick = tensor(rows, self.device)
                out = self._outputs(draws.state[rows])
                log_prob, entropy = self.head.log_prob(
                    out[:, :-1],
                    offered[pick],
                    drawn[pick],
                )
                policy_loss = clipped_surrogate(log_prob, old[pick], scaled[pick], CLIP)
                value_loss = (out[:, -1] - goals[pick]).square().mean()
                loss = policy_loss + VALUE_WEIGHT * value_loss
                loss = loss - ENTROPY_WEIGHT * entropy.mean()
                kl, clipped = changes(log_prob.detach(), old[pick], CLIP)
                losses = policy_loss.detach(), value_loss.detach(), -entropy.detach().mean()
                health.append(torch.stack([*losses, kl, clipped]))
                where = f"in update {self.updates}, epoch {epoch}, batch {begin // config.meta_batch}"
                descend(loss, self.optimiser, "the meta-policy", where, GRADIENT_NORM)
        self.updates += 1
        means = torch.stack(health).mean(0).cpu().tolist()
        return {
            "value": float(values.mean()),
            **dict(zip(HEALTH, means, strict=True)),
            "explained_variance": smdp.explained_variance(values, advantages + values),
        }

    def state(self) -> dict[str, Tensor]:
        return dict(self.policy.state_dict())

    def load(self, state: Mapping[str, Tensor]) -> None:
        """Load the weights of an artefact. Raises ``UserError`` if they do not fit."""
        load_into(self.policy, state, choosers.FILE)

    def restore(self, snapshot: Mapping[str, Any]) -> None:
        super().restore(snapshot)
        self.draws = [Draws(**part) for part in snapshot["draws"]]
        self.outcomes = [choosers.Outcome(**part) for part in snapshot["outcomes"]]


def clipped_surrogate(
    log_prob: Tensor,
    old: Tensor,
    advantages: Tensor,
    clip: float,
) -> Tensor:
    """Return PPO's loss, minus the mean of min(r A, clip(r, 1 - c, 1 + c) A), where r is the ratio of probabilities.

    Source: Schulman et al. 2017, Eq. (7).
    """
    ratio = (log_prob - old).exp()
    return -torch.minimum(ratio * advantages, ratio.clamp(1 - clip, 1 + clip) * advantages).mean()


def changes(log_prob: Tensor, old: Tensor, clip: float) -> tuple[Tensor, Tensor]:
    """Return how far a policy went from the policy that drew: the mean of r - 1 - log r, and the share that is clipped.

    r (n,) is the ratio of the policies' probabilities. The mean estimates the Kullback-Leibler divergence without bias.
    Source: Schulman 2020, "Approximating KL divergence".
    """
    ratio = (log_prob - old).exp()
    kl = (ratio - 1 - (log_prob - old)).mean()
    return kl, ((ratio - 1).abs() > clip).float().mean()
