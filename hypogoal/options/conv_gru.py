"""Option learning as in the paper: a conv-GRU network and a replay of its own for each member.

A state's *window* is the last ``recurrence`` states of its option's execution, up to the state itself. The GRU reads a
window from its first state on, and remembers nothing from before the window: in acting, in learning, and in saved
options. A window of 1 is a state alone (DEV-16).
"""

from collections import deque
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from hypogoal.core import tensors
from hypogoal.core.arrays import Bools, Columns, Ints, tensor
from hypogoal.core.drawing import DrawsFrom
from hypogoal.core.errors import UserError
from hypogoal.core.seeding import torch_generator
from hypogoal.domains.base import Engine
from hypogoal.observations import PICTURE, Observations
from hypogoal.options import double_dqn, saved
from hypogoal.options.config import STACK, OptionConfig, PaperConfig
from hypogoal.options.learner import Learner, Transitions
from hypogoal.options.paper_network import PaperQNetwork
from hypogoal.options.replay import PrioritisedReplay


@dataclass(frozen=True)
class Lived(Columns):
    """Steps of executions, as arrays (n, ...)."""

    path: NDArray[np.int32]  # (n, recurrence + 1), state ids: a window, the state after it, then any states of the two
    length: Ints  # the number of states in the window
    action: Ints
    terminated: Bools  # whether the task is over


class Member(double_dqn.DoubleDQN):
    """One member's policy: networks, optimiser, replay, and the number of steps since its last update."""

    CHANGING = (*double_dqn.DoubleDQN.CHANGING, "replay", "due")
    online: PaperQNetwork
    target: PaperQNetwork

    def __init__(self, online: PaperQNetwork, config: PaperConfig):
        super().__init__(online, config)
        path = np.zeros((config.replay, config.recurrence + 1), np.int32)
        rows = replace(Lived.zeros(config.replay), path=path)
        self.replay = PrioritisedReplay(rows)
        self.due = 0


class PaperPolicies:
    """The greedy policies of saved options, each with a network of its own."""

    def __init__(self, options: saved.SavedOptions):
        self.recurrence = options.config["recurrence"]
        actions = len(options.weights.get("0.values.2.bias", ())) or 1  # 1 if weights are missing, refused below
        make = partial(PaperQNetwork, options.shape, actions)
        each = [tensors.below(f"{option}.", options.weights) for option in range(options.count)]
        self.networks = [tensors.load_fitting(make, weights, saved.FILE).eval() for weights in each]

    def __call__(self, option: int) -> Callable[[Observations], int]:
        """Start an execution of ``option``, and return the function from an observation to an action."""
        window: deque[Observations] = deque(maxlen=self.recurrence)
        return partial(_act, self.networks[option], window)


@torch.no_grad()
def _act(network: PaperQNetwork, window: deque[Observations], observation: Observations) -> int:
    """Append ``observation`` to the execution's ``window`` and return the greedy action."""
    window.append(observation)
    seen = network.see(torch.from_numpy(np.stack(window)))
    count = len(window)
    values = network(seen, torch.arange(count)[None], torch.tensor([count]))
    return int(values.argmax())


class PaperLearner(Learner):
    """A learner of O options whose policies share nothing. The arguments are those of :class:`Learner`."""

    policies = PaperPolicies
    settings: PaperConfig
    CHANGING = (*Learner.CHANGING, "members", "windows", "lengths")

    @classmethod
    def refuse(cls, config: OptionConfig, engine: Engine) -> None:
        """Raise ``UserError`` if ``experience`` is not ``own``, or if observations are no pictures."""
        if config.experience != "own":
            fault = "network=paper needs experience=own"
            raise UserError(
                fault,
                f"experience={config.experience}",
                "Give --set experience=own.",
            )
        if engine.observation_dtype != PICTURE:
            raise UserError("the paper's networks see pictures only", "network=paper", "Give --set network=light.")

    def build(self, config: OptionConfig, seed: int) -> None:
        self.settings = settings = config.part(PaperConfig)
        self.members = []
        shape, actions = self.engine.observation_shape, self.engine.n_actions
        for option in range(self.options):
            with DrawsFrom(torch_generator(seed, "option-weights", option)):
                network = PaperQNetwork(shape, actions)
            self.members.append(Member(network.to(self.device), settings))
        self.windows = np.zeros((self.engine.count, settings.recurrence), int)  # of the executions that run
        self.lengths = np.zeros(self.engine.count, int)  # of the windows; the places after a window repeat its states
        self._in_pieces = self.engine.tiles is not None and self.device.type == "cpu"

    @staticmethod
    def reach(config: OptionConfig, options: int) -> int:
        """Return how many states back the replays look if all members have had equally many steps.

        If a member has had fewer steps, the engine may have forgotten states in its replay. Steps with forgotten states
        are left out of batches.
        """
        settings = config.part(PaperConfig)
        return options * settings.replay + (settings.recurrence + STACK) * config.environments

    @torch.no_grad()
    def greedy(
        self,
        ids: Ints,
        options: Ints,
        age: Ints,
    ) -> Ints:
        """Return the greedy actions, as :meth:`Learner.greedy` does, with BatchNorm in evaluation mode.

        Call this once a step, because each call appends ``ids`` to the windows.
        """
        windows = self.windows
        begun, full = age == 0, age >= self.settings.recurrence
        windows[begun] = ids[begun, None]
        windows[full, :-1] = windows[full, 1:]
        self.lengths = np.minimum(age + 1, self.settings.recurrence)
        windows[np.arange(len(ids)), self.lengths - 1] = ids
        chosen = np.empty_like(ids)
        for option in np.unique(options):
            rows = options == option
            network = self.members[option].online.eval()
            images, places = self._seen(windows[rows])
            lengths = tensor(self.lengths[rows], self.device)
            values = network(network.see(tensor(images, self.device)), places, lengths)
            preferred = values.argmax(1)
            chosen[rows] = preferred.cpu().numpy()
        return chosen

    def _seen(self, windows: Ints) -> tuple[Observations, Tensor]:
        """Return the distinct images in windows, and the index of each place's image, in the shape of ``windows``."""
        states, places = np.unique(windows, return_inverse=True)
        return self.engine.images(states), tensor(places.reshape(windows.shape), self.device)

    def observe(self, moved: Transitions) -> None:
        path = np.column_stack([self.windows, moved.next_ids])
        path[np.arange(len(path)), self.lengths] = moved.next_ids
        steps = Lived.cast(path, self.lengths, moved.actions, moved.terminated)
        for option in np.unique(moved.options):
            rows = moved.options == option
            member = self.members[option]
            member.replay.add(steps.at(rows))
            member.due += rows.sum().item()
        self.count_running(moved)

    def learn(self) -> dict[str, float]:
        """Make the updates that are due. In Tables 2 and 4, one update is due per 4 steps of the member."""
        last = None
        for option, member in enumerate(self.members):
            if member.replay.size < min(self.settings.warm_up, self.settings.replay):
                member.due = 0
            while member.due >= self.settings.update_interval:
                member.due -= self.settings.update_interval
                last = self._update(option, member) or last
        return self.health(last, sum(member.replay.size for member in self.members)) if last else {}

    def _update(self, option: int, member: Member) -> double_dqn.Updated | None:
        """Update a member's policy once. Return None, without an update, if all the steps drawn are forgotten."""
        indices, weights = member.replay.sample(self.settings.option_batch, self.rng)
        steps = member.replay.data.at(indices)
        kept = self.engine.remembers(steps.path).all(axis=1)
        if not kept.any():
            return None
        indices, weights, steps = indices[kept], weights[kept], steps.at(kept)

        path, length = steps.path.astype(int), steps.length
        most = self.settings.recurrence
        now, shifted = path[:, :-1], path[:, 1:]
        following = np.where(length[:, None] < most, now, shifted)
        lengths = tensor(length, self.device)
        later_lengths = tensor(np.minimum(length + 1, most), self.device)
        both = np.stack([now, following])
        images, (before, after) = self._seen(both)  # each image once, so BatchNorm counts an image once (DEV-51)
        online, target = member.online.train(), member.target
        shown = online.pieces_of(images) if self._in_pieces else tensor(images, self.device)
        seen = online.see(shown)
        values = online(seen, before, lengths)
        with torch.no_grad():
            next_online = online(seen, after, later_lengths)
            next_target = target(target.see(shown), after, later_lengths)

        next_states = path[np.arange(len(path)), length]
        reached = self.terminations.of_running(next_states, np.full_like(next_states, option))[:, None]
        ones = np.ones_like(length)
        batch = double_dqn.ReplayBatch(
            steps.action,
            ones,
            reached,
            steps.terminated,
            np.ones_like(reached),
            weights,
        )
        updated = member.update(
            values[:, None],
            next_online[:, None],
            next_target[:, None],
            batch,
            [option],
            self.option_steps[option],
        )
        member.replay.set_priorities(indices, updated.errors)
        return updated

    def weights(self) -> dict[str, Tensor]:
        every = {}
        for option, member in enumerate(self.members):
            for name, value in member.online.tensors().items():
                every[f"{option}.{name}"] = value
        return every

    def load_weights(self, weights: Mapping[str, Tensor]) -> None:
        for option, member in enumerate(self.members):
            member.load(tensors.below(f"{option}.", weights), f"option {option} of {saved.FILE}")
