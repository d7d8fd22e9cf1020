"""The meta-policy: PPO (Schulman et al. 2017) over options, decisions weighted by their duration (Spec E1-E3)."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Self

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from hypogoal.core.arrays import Columns, tensor
from hypogoal.core.checkpoints import State
from hypogoal.core.drawing import DrawsFrom
from hypogoal.core.errors import UserError
from hypogoal.core.seeding import rng_for, torch_generator
from hypogoal.core.tensors import load_into
from hypogoal.domains.base import Engine
from hypogoal.learners.double_dqn import descend
from hypogoal.meta.config import MetaConfig
from hypogoal.meta.networks import HEADS, meta_network
from hypogoal.meta.smdp import smdp_advantages
from hypogoal.observations import PICTURE
from hypogoal.options.choosers import FILE, Chooser, Offered, Outcome
from hypogoal.options.networks import apply_to_states
from hypogoal.options.parts import Ids

GRADIENT_NORM = 0.5
CLIP = 0.2  # of the ratio of probabilities: Schulman et al. 2017
VALUE_WEIGHT = 0.5  # of the value loss: Schulman et al. 2017


@dataclass(frozen=True)
class Draws(Columns):
    """Choices of an option, arrays (n, ...)."""

    state: NDArray[np.int64]  # in which it was chosen
    offered: NDArray[np.bool_]  # (n, O)
    drawn: NDArray[np.float32]  # what the head remembers of the draw, (n, R)
    log_prob: NDArray[np.float32]


@dataclass(frozen=True)
class Decisions(Draws):
    """Choices and what came of them."""

    environment: NDArray[np.int64]
    returned: NDArray[np.float64]  # rewards inside the option, discounted from its start
    discount: NDArray[np.float64]  # gamma ** tau
    next_state: NDArray[np.int64]  # in which the option ended
    terminated: NDArray[np.bool_]  # nothing follows it
    ended: NDArray[np.bool_]  # the episode ended there, for whatever reason


class MetaPolicy(Chooser):
    """Chooses among O options for every environment and learns from what they return.

    ``seed`` is of weights, draws and minibatches; the networks are on ``device``, options are drawn on the CPU.
    """

    CHANGING = ("policy", "optimiser", "generator", "rng", "_open", "updates")

    def __init__(self, engine: Engine, options: int, config: MetaConfig, seed: int, device: torch.device | str = "cpu"):
        self.engine, self.options, self.config = engine, options, config
        self.device = torch.device(device)
        with DrawsFrom(torch_generator(seed, "meta-weights")):
            network = meta_network(config.meta_network, engine.observation_shape, options, engine.standard)
            self.network = network.to(self.device)
            self.head = HEADS[config.head](options).to(self.device)
        self.policy = nn.ModuleDict({"network": self.network, "head": self.head})
        self.optimiser = torch.optim.Adam(self.policy.parameters(), lr=config.meta_learning_rate, eps=1e-5, fused=True)
        self.generator = torch_generator(seed, "meta-draws")
        self.rng = rng_for(seed, "meta-batches")
        count = engine.count
        self._open = Draws(  # the last one of every environment
            state=np.zeros(count, np.int64),
            offered=np.zeros((count, options), np.bool_),
            drawn=np.zeros((count, self.head.remembered), np.float32),
            log_prob=np.zeros(count, np.float32),
        )
        self._finished: list[Decisions] = []  # as they ended
        self.updates = 0

    @classmethod
    def refuse(cls, config: Any, engine: Engine) -> None:
        """Without settings of PPO there is nothing to learn by; the paper's network sees pictures only."""
        if not isinstance(config, MetaConfig):
            raise UserError("only train-meta learns the meta-policy", "chooser=ppo", "Give chooser=random or even.")
        if config.meta_network == "paper" and engine.observation_dtype != PICTURE:
            do = "Give --set meta_network=light."
            raise UserError("the paper's networks see pictures only", "meta_network=paper", do)

    @classmethod
    def create(cls, engine: Engine, options: int, config: Any, seed: int, device: str) -> Self:
        return cls(engine, options, config, seed, device)

    def choose(self, environments: Ids, ids: Ids, offered: Offered) -> Ids:
        with torch.no_grad():
            scores = self._outputs(ids)[:, :-1].cpu()
            mask = torch.from_numpy(offered)
            options, drawn = self.head.draw(scores, mask, self.generator)
            log_prob = self.head.log_prob(scores, mask, drawn)[0]
        self._open.put(environments, Draws(ids, offered, drawn.numpy(), log_prob.numpy()))
        return options.numpy()

    def record(self, outcome: Outcome) -> None:
        draws = self._open.at(outcome.environments)
        decisions = Decisions(
            **vars(draws),
            environment=outcome.environments,
            returned=outcome.returns,
            discount=outcome.discounts,
            next_state=outcome.next_ids,
            terminated=outcome.terminated,
            ended=outcome.terminated | outcome.truncated,
        )
        self._finished.append(decisions)

    def begin_anew(self) -> None:
        self._finished = []

    def learn(self) -> dict[str, float]:
        if sum(map(len, self._finished)) < self.config.decisions:
            return {}
        decisions, self._finished = Decisions.joined(self._finished), []
        return self._update(decisions.at(np.argsort(decisions.environment, kind="stable")))

    def _outputs(self, ids: NDArray[np.int64]) -> Tensor:
        return apply_to_states(self.network, self.engine, ids)

    def _update(self, decisions: Decisions) -> dict[str, float]:
        """Learn from decisions, those of an environment side by side in the order in which they were taken."""
        config, states = self.config, decisions.state
        with torch.no_grad():
            outputs = self._outputs(states)
            values = outputs[:, -1].double().cpu().numpy()
            next_values = self._outputs(decisions.next_state)[:, -1].double().cpu().numpy()
        begins = np.flatnonzero(np.diff(decisions.environment)) + 1
        advantages = np.concatenate(
            [
                smdp_advantages(
                    decisions.returned[rows],
                    decisions.discount[rows],
                    values[rows],
                    next_values[rows],
                    decisions.terminated[rows],
                    decisions.ended[rows],
                    config.gae_lambda,
                )
                for rows in np.split(np.arange(len(states)), begins)
            ]
        )
        offered, drawn, old = (
            tensor(values, self.device) for values in (decisions.offered, decisions.drawn, decisions.log_prob)
        )
        with torch.no_grad():
            certainty = certainty_of(self.head.probabilities(outputs[:, :-1], offered))
        goal = tensor(advantages + values, self.device).float()
        scaled = tensor(scaled_advantages(advantages, config.advantage_floor), self.device).float()
        for epoch in range(config.epochs):
            order = self.rng.permutation(len(states))
            for begin in range(0, len(states), config.meta_batch):
                rows = order[begin : begin + config.meta_batch]
                pick = tensor(rows, self.device)
                out = self._outputs(states[rows])
                log_prob, entropy = self.head.log_prob(out[:, :-1], offered[pick], drawn[pick])
                loss = clipped_surrogate(log_prob, old[pick], scaled[pick], CLIP)
                loss = loss + VALUE_WEIGHT * (out[:, -1] - goal[pick]).square().mean()
                loss = loss - config.entropy * entropy.mean()
                where = f"in update {self.updates}, epoch {epoch}, batch {begin // config.meta_batch}"
                descend(loss, self.policy, self.optimiser, "the meta-policy", where, GRADIENT_NORM)
        self.updates += 1
        return {**certainty, "value": float(values.mean())}

    def state(self) -> dict[str, Tensor]:
        return dict(self.policy.state_dict())

    def load(self, state: Mapping[str, Tensor]) -> None:
        """Weights of an artefact; a ``UserError`` where they are not of such a policy."""
        load_into(self.policy, state, FILE)

    def snapshot(self) -> State:
        """As of :class:`Resumable`, and the decisions, in one array for each column."""
        draws = vars(self._open.at(slice(0)))
        outcomes = {name: np.zeros(0, kind) for name, kind in Decisions.types().items() if name not in draws}
        self._finished = [Decisions.joined([Decisions(**draws, **outcomes), *self._finished])]
        return {**super().snapshot(), "finished": dict(vars(self._finished[0]))}

    def restore(self, snapshot: Mapping[str, Any]) -> None:
        super().restore(snapshot)
        self._finished = [Decisions(**snapshot["finished"])]


def certainty_of(probabilities: Tensor) -> dict[str, float]:
    """How sure a policy is: ``choice_entropy`` (nats) and the probability of the ``top_choice``, means over decisions.

    ``probabilities`` are (n, O). Where ``top_choice`` is near 1, an option that stops working is not left again soon.
    """
    entropy = torch.special.entr(probabilities).sum(1).mean()
    return {"choice_entropy": float(entropy), "top_choice": float(probabilities.amax(1).mean())}


def scaled_advantages(advantages: NDArray[np.float64], floor: float) -> NDArray[np.float64]:
    """Advantages (n,) less their mean, in units of their standard deviation, or of ``floor`` where that is larger.

    Without a floor the noise of a batch without rewards is blown up to the size of a signal, and the policy drifts
    until it is sure of something arbitrary.
    """
    return (advantages - advantages.mean()) / max(float(advantages.std()), floor, 1e-8)


def clipped_surrogate(log_prob: Tensor, old: Tensor, advantages: Tensor, clip: float) -> Tensor:
    """PPO's loss: minus the mean of min(r A, clip(r, 1 - c, 1 + c) A), r the ratio of probabilities.

    Source: Schulman et al. 2017, Eq. (7).
    """
    ratio = (log_prob - old).exp()
    return -torch.minimum(ratio * advantages, ratio.clamp(1 - clip, 1 + clip) * advantages).mean()
