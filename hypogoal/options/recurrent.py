"""Option learning as in the paper: an independent conv-GRU network and replay per member (Spec D2, D3).

The GRU is unrolled over the option's own steps: acting carries its hidden state from the option's first step on;
learning samples a step and replays the option's execution up to it. Every member learns from its own executions.
BatchNorm counts an image as often as it occurs. With ``recurrence=none`` nothing is remembered (DEV-16).
"""

import copy
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import partial
from typing import Any, ClassVar

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from hypogoal.core.arrays import Columns
from hypogoal.core.checkpoints import Resumable
from hypogoal.core.drawing import DrawsFrom
from hypogoal.core.errors import UserError
from hypogoal.core.seeding import torch_generator
from hypogoal.core.tensors import below, load_fitting, load_into
from hypogoal.domains.base import Engine
from hypogoal.learners.double_dqn import descend, double_q_targets, follow, target_rate
from hypogoal.learners.replay import PrioritisedReplay
from hypogoal.observations import PICTURE, Observations
from hypogoal.options.choosers import Ids
from hypogoal.options.config import STACK, PaperConfig
from hypogoal.options.learner import Learner, Policies, SavedOptions, Transitions
from hypogoal.options.paper_network import PaperQNetwork, looked_at


@dataclass(frozen=True)
class Rows(Columns):
    """Steps of executions, arrays (n,)."""

    state: NDArray[np.int32]  # ids
    action: NDArray[np.int16]
    next_state: NDArray[np.int32]  # ids
    terminated: NDArray[np.bool_]  # the task is over
    timed_out: NDArray[np.bool_]  # the option's time was up
    place: NDArray[np.int16]  # steps since the option began
    execution: NDArray[np.int32]


class Member(Resumable):
    """One member's policy: networks, optimiser, replay of whole executions, counters."""

    CHANGING = ("online", "target", "optimiser", "replay", "updates", "due", "executions")

    def __init__(self, engine: Engine, config: PaperConfig, seed: int, option: int, actions: int, device: torch.device):
        with DrawsFrom(torch_generator(seed, "option-weights", option)):
            remembers = config.recurrence == "execution"
            self.online = PaperQNetwork(engine.observation_shape, actions, remembers).to(device)
        self.target = copy.deepcopy(self.online).requires_grad_(False).eval()
        self.optimiser = torch.optim.Adam(self.online.parameters(), lr=config.option_learning_rate, fused=True)
        self.replay = PrioritisedReplay(config.replay, Rows)
        self.updates = self.due = self.executions = 0


class RecurrentLearner(Learner):
    """The intra-option policies of all O options, each on its own; arguments as of :class:`Learner`."""

    CHANGING = (*Learner.CHANGING, "members", "hidden", "running")
    NEEDS: ClassVar[Mapping[str, Any]] = {"experience": "own"}

    @classmethod
    def refuse(cls, config: PaperConfig, engine: Engine) -> None:
        """It sees pictures only, and learns single steps of its members' own executions."""
        super().refuse(config, engine)
        if engine.observation_dtype != PICTURE:
            raise UserError("the paper's networks see pictures only", "network=paper", "Give --set network=light.")

    @classmethod
    def policies(cls, saved: SavedOptions) -> Policies:
        return PaperPolicies(saved)

    def build(self, config: PaperConfig, seed: int) -> None:
        count = self.engine.n_actions
        self.members = [Member(self.engine, config, seed, option, count, self.device) for option in range(self.options)]
        self.hidden = torch.zeros(self.engine.count, PaperQNetwork.HIDDEN, device=self.device)
        self.running: list[list[tuple[int, int, int, bool, bool, bool]]] = [[] for _ in range(self.engine.count)]

    @staticmethod
    def reach(config: PaperConfig, options: int) -> int:
        """How many states back the replays hold when each has had as many steps as another.

        A running execution is stored when it ends. Of what a member that had fewer has stored, the oldest may be
        forgotten nevertheless; it is left out of its batches.
        """
        return options * config.replay + (config.option_timeout + STACK) * config.environments

    @torch.no_grad()
    def greedy(self, ids: Ids, options: Ids, age: Ids) -> Ids:
        """As of :class:`Learner`; moves each environment's hidden state one step on (BatchNorm in eval mode)."""
        chosen = np.empty(len(ids), dtype=np.int64)
        self.hidden[self.tensor(age == 0)] = 0.0
        images = self.tensor(self.engine.images(ids))
        for option in np.unique(options):
            places = np.flatnonzero(options == option)
            rows = self.tensor(places)
            network = self.members[option].online.eval()
            values, hidden = network(network.embed(images[rows])[:, None], self.hidden[rows][None])
            self.hidden[rows] = hidden[0]
            chosen[places] = values[:, 0].argmax(1).cpu().numpy()
        return chosen

    def observe(self, moved: Transitions) -> None:
        """Collect each execution; store it in its member's replay when it ends."""
        columns = (moved.ids, moved.actions, moved.next_ids, moved.terminated, moved.timed_out, moved.reached)
        for e, row in enumerate(zip(*(values.tolist() for values in columns), strict=True)):
            self.running[e].append(row)
            if moved.ended[e]:
                self._store(int(moved.options[e]), self.running[e])
                self.running[e] = []

    def _store(self, option: int, steps: list[tuple[int, int, int, bool, bool, bool]]) -> None:
        member = self.members[option]
        *columns, reached = (np.array(column) for column in zip(*steps, strict=True))
        rows = Rows.cast(*columns, np.arange(len(steps)), np.full(len(steps), member.executions))
        member.replay.add(rows)
        member.executions += 1
        member.due += len(rows)
        self.positives[option] += reached.sum()
        self.count(np.full(len(rows), option))

    def learn(self) -> dict[str, float]:
        """The updates that are due (Tables 2, 4: one per 4 steps of the member)."""
        numbers: dict[str, float] = {}
        for option, member in enumerate(self.members):
            if member.replay.size < min(self.config.warm_up, self.config.replay):  # not steps: a continued one has none
                member.due = 0
            while member.due >= self.config.update_interval:
                member.due -= self.config.update_interval
                numbers["option_loss"] = self._update(option, member)
        return numbers

    def _update(self, option: int, member: Member) -> float:
        config, data = self.config, member.replay.data
        indices, weights = member.replay.sample(config.option_batch, self.rng)
        place = data.place[indices].astype(np.int64) * member.online.remembers
        # Steps of an execution lie side by side in the ring; the oldest may have been overwritten at the seam.
        kept = np.arange(int(place.max()) + 1)
        prefix = (indices[:, None] - place[:, None] + kept) % config.replay
        whole = data.execution[prefix[:, 0]] == data.execution[indices]
        whole &= (self.engine.remembers(data.state[prefix]) | (kept > place[:, None])).all(1)
        whole &= self.engine.remembers(data.next_state[indices])
        if not whole.any():
            return 0.0
        indices, weights, place, prefix = indices[whole], weights[whole], place[whole], prefix[whole]
        length = int(place.max()) + 1
        rows = np.arange(len(indices))
        states = data.state[prefix[:, :length]].astype(np.int64)
        states = np.concatenate([states, states[:, :1]], axis=1)
        states[rows, place + 1] = data.next_state[indices]
        occurs = np.arange(length + 1) <= place[:, None] + 1
        states[~occurs] = states[0, 0]

        unique, inverse = np.unique(states, return_inverse=True)
        inverse = inverse.reshape(states.shape)
        times = np.bincount(inverse[occurs], minlength=len(unique))
        images = looked_at(self.engine.images(unique), times, member.online, self.device)
        places = self.tensor(inverse)
        member.online.train()
        values = member.online(member.online.embed(*images)[places])[0]
        with torch.no_grad():
            next_target = member.target(member.target.embed(*images)[places])[0]
        now, later = self.tensor(place), self.tensor(place + 1)
        pick = torch.arange(len(indices), device=self.device)
        next_states = data.next_state[indices].astype(np.int64)
        reached = self.terminations.of_running(next_states, np.full(len(indices), option))
        terminal = reached | data.terminated[indices]
        goal = double_q_targets(
            self.tensor(reached).float(),
            self.tensor(terminal),
            values[pick, later].detach(),
            next_target[pick, later],
            config.option_gamma,
            bounded=config.bounded_values,
        )
        taken = values[pick, now, self.tensor(data.action[indices].astype(np.int64))]
        error = taken - goal
        huber = torch.nn.functional.huber_loss(error, torch.zeros_like(error), reduction="none")
        loss = (huber * self.tensor(weights)).mean()
        where = f"in the batch of its update {member.updates}, its step {self.option_steps[option]}"
        descend(loss, member.online, member.optimiser, f"option {option}", where)
        member.updates += 1
        if rate := target_rate(member.updates, config.target_interval):
            networks = (member.target, member.online)
            target, online = ([*network.parameters(), *network.buffers()] for network in networks)
            follow(target, online, rate)
        member.replay.set_priorities(indices, error.detach().abs().cpu().numpy())
        return float(loss.detach())

    def weights(self) -> dict[str, Tensor]:
        states = [member.online.state_dict() for member in self.members]
        return {f"{option}.{name}": value for option, state in enumerate(states) for name, value in state.items()}

    def load_weights(self, weights: Mapping[str, Tensor]) -> None:
        for option, member in enumerate(self.members):
            of_option = below(f"{option}.", weights)
            load_into(member.online, of_option, f"option {option} of options.safetensors")
            member.target.load_state_dict(of_option)


class PaperPolicies:
    """Greedy policies of saved options that have a network each (Spec D2, D8), made when it is first played."""

    def __init__(self, saved: SavedOptions):
        self.weights, self.shape = dict(saved.weights), saved.shape
        self.remembers = saved.config["recurrence"] == "execution"
        self.actions = saved.actions("0.values.2.bias", 1)
        self._networks: dict[int, PaperQNetwork] = {}

    def network(self, option: int) -> PaperQNetwork:
        """An option's network."""
        if option not in self._networks:
            make = partial(PaperQNetwork, self.shape, self.actions, self.remembers)
            self._networks[option] = load_fitting(make, below(f"{option}.", self.weights), "options.safetensors").eval()
        return self._networks[option]

    def __call__(self, option: int) -> Callable[[Observations], int]:
        """Start an execution."""
        return _Execution(self.network(option))

    def __getstate__(self) -> dict[str, Any]:
        """Without the networks, which are the weights again."""
        return {**self.__dict__, "_networks": {}}


class _Execution:
    """One execution of an option, which its network remembers from its first step on."""

    def __init__(self, network: PaperQNetwork):
        self.network = network
        self.hidden: Tensor | None = None

    @torch.no_grad()
    def __call__(self, observation: Observations) -> int:
        image = torch.from_numpy(np.ascontiguousarray(observation[None]))
        values, self.hidden = self.network(self.network.embed(image)[:, None], self.hidden)
        return int(values[0, 0].argmax())
