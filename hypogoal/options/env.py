"""Options played as the actions of a Gymnasium environment."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import gymnasium
import numpy as np
import torch
from gymnasium.utils import RecordConstructorArgs
from numpy.typing import NDArray
from torch import Tensor

from hypogoal.core.errors import UserError
from hypogoal.core.tensors import load_fitting
from hypogoal.domains.gymnasium_engine import as_image
from hypogoal.hypotheses.ensemble import Ensemble
from hypogoal.hypotheses.wrappers import require_observations
from hypogoal.options.execution import offered_options
from hypogoal.options.exploration import actions_of
from hypogoal.options.initiation import Narrowing
from hypogoal.options.networks import LightQNetwork, PaperQNetwork

# A policy starts an execution: (option) -> a function from an observation (*obs) to the action.
Policies = Callable[[int], Callable[[NDArray[np.uint8]], int]]


@dataclass(frozen=True)
class Options:
    """G x K options; option g*K + k aims at member k's hypothesis of sub-goal g.

    Attributes:
        sub_goals: G names.
        members: K.
        ensembles: the termination classifiers, one ensemble per sub-goal.
        policies: starts an option's greedy policy.
        timeout: steps after which an option ends.
        initiation: holds options back where they rarely reach their sub-goals (D7); None, it holds none back.
    """

    sub_goals: tuple[str, ...]
    members: int
    ensembles: Sequence[Ensemble]
    policies: Policies
    timeout: int
    initiation: Narrowing | None = None

    @property
    def count(self) -> int:
        """G * K."""
        return len(self.sub_goals) * self.members

    def name(self, option: int) -> str:
        """For example ``open-red-door/2``."""
        return f"{self.sub_goals[option // self.members]}/{option % self.members}"

    def verdicts(self, observation: NDArray[np.uint8]) -> NDArray[np.bool_]:
        """Which options' sub-goals hold in one observation (*obs): bool (G*K,)."""
        return np.concatenate([ensemble.verdicts(observation[None])[0] for ensemble in self.ensembles])

    def offered(self, observation: NDArray[np.uint8]) -> NDArray[np.bool_]:
        """Spec D6, D7: which options may start in an observation (*obs): bool (G*K,)."""
        offered: NDArray[np.bool_] = offered_options(self.verdicts(observation)[None], mask_reached=True)[0]
        return offered if self.initiation is None else self.initiation(observation, offered)

    def holds(self, option: int, observation: NDArray[np.uint8]) -> bool:
        """Whether one option's own sub-goal holds in an observation (*obs)."""
        ensemble = self.ensembles[option // self.members]
        return bool(ensemble.verdicts(observation[None])[0, option % self.members])


def make_policies(config: Mapping[str, Any], weights: dict[str, Tensor], about: Mapping[str, Any]) -> Policies:
    """Greedy policies from an options artefact's weights.

    Args:
        config: its manifest's configuration.
        weights: the tensors of ``options.safetensors``.
        about: the ensemble manifest's configuration.
    """
    if config["termination"] == "oracle":
        raise UserError(
            "these options end at the true sub-goals, which only the domain's engine can see",
            "termination=oracle",
            "Load options that were trained with learned members.",
        )
    shape = tuple(about["observation_shape"])
    options = len(config["sub_goals"]) * config["members"]
    last = "online.heads.weight" if config["network"] == "light" else "0.values.2.bias"
    outputs = len(weights[last]) // (options if config["network"] == "light" else 1) if last in weights else 0
    actions = actions_of(weights, outputs)
    if not outputs or actions.shape != (outputs,):
        raise UserError("the weights do not fit the manifest", f"{options} options", "Make the artefact again.")
    make = _light_policies if config["network"] == "light" else _paper_policies
    return make(weights, shape, options, actions)


def _light_policies(
    weights: dict[str, Tensor], shape: tuple[int, ...], options: int, actions: NDArray[np.int64]
) -> Policies:
    own = {name[7:]: value for name, value in weights.items() if name.startswith("online.")}
    network = load_fitting(lambda: LightQNetwork(shape, options, len(actions)), own, "options.safetensors")

    def start(option: int) -> Callable[[NDArray[np.uint8]], int]:
        @torch.no_grad()
        def act(observation: NDArray[np.uint8]) -> int:
            image = torch.from_numpy(np.ascontiguousarray(observation[None]))
            return int(actions[int(network(image)[0, option].argmax())])

        return act

    return start


def _paper_policies(
    weights: dict[str, Tensor], shape: tuple[int, ...], options: int, actions: NDArray[np.int64]
) -> Policies:
    networks: dict[int, PaperQNetwork] = {}

    def network_of(option: int) -> PaperQNetwork:
        if option not in networks:
            prefix = f"{option}."
            own = {name[len(prefix) :]: value for name, value in weights.items() if name.startswith(prefix)}
            made = load_fitting(lambda: PaperQNetwork(shape, len(actions)), own, "options.safetensors")
            networks[option] = made.eval()
        return networks[option]

    def start(option: int) -> Callable[[NDArray[np.uint8]], int]:
        network = network_of(option)
        hidden: Tensor | None = None

        @torch.no_grad()
        def act(observation: NDArray[np.uint8]) -> int:
            nonlocal hidden
            image = torch.from_numpy(np.ascontiguousarray(observation[None]))
            values, hidden = network(network.embed(image)[:, None], hidden)
            return int(actions[int(values[0, 0].argmax())])

        return act

    return start


class OptionEnv(gymnasium.Wrapper[Any, Any, Any, Any], RecordConstructorArgs):
    """A Gymnasium environment whose actions are options (Spec E1): ``Discrete(G*K)``.

    One step runs an option until its classifier says yes, its time is up or the episode ends. The reward is the sum
    of the rewards inside, discounted by ``gamma``; ``info["duration"]`` is tau, so that an agent can bootstrap with
    gamma ** tau; ``info["reached"]`` says whether the option's own sub-goal was reached, ``info["option"]`` its name.

    ``action_masks()`` is what sb3-contrib's MaskablePPO asks for; of ``gymnasium.vector.SyncVectorEnv`` it is
    ``envs.call("action_masks")``.

    Args:
        env: an environment with the observations that the options were trained on.
        options: from :func:`hypogoal.load_options`.
        gamma: discount per environment step inside an option; 1 for the plain sum.

    Raises:
        UserError: its observations are others.

    >>> import gymnasium, hypogoal
    >>> options = hypogoal.load_options("runs/demo/meta")
    >>> env = hypogoal.OptionEnv(gymnasium.make("hypogoal/DoorKey-8x8-v0", layout_seed=100), options)
    >>> env.action_space, options.name(11)
    (Discrete(15), 'open-red-door/2')
    >>> observation, info = env.reset(seed=0)
    >>> env.action_masks().shape
    (15,)
    >>> observation, reward, terminated, truncated, info = env.step(11)
    >>> 1 <= info["duration"] <= options.timeout, info["option"]
    (True, 'open-red-door/2')
    """

    def __init__(self, env: gymnasium.Env[Any, Any], options: Options, gamma: float = 1.0):
        RecordConstructorArgs.__init__(self, _disable_deepcopy=True, options=options, gamma=gamma)
        gymnasium.Wrapper.__init__(self, env)
        self.options, self.gamma, self._shape = options, gamma, tuple(options.ensembles[0].observation_shape)
        require_observations(env, self._shape)
        self.action_space = gymnasium.spaces.Discrete(options.count)
        self._image: NDArray[np.uint8] | None = None

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        """As the environment's own."""
        observation, info = self.env.reset(seed=seed, options=options)
        self._image = as_image(observation, self._shape)
        return observation, info

    def action_masks(self) -> NDArray[np.bool_]:
        """Spec D6, D7: which options may start here, bool (G*K,)."""
        return self.options.offered(self._current())

    def step(self, action: int) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        """Run option ``action`` to its end."""
        option = int(action)
        act = self.options.policies(option)
        total, duration, reached, ended = 0.0, 0, False, False
        image, observation = self._current(), None
        terminated = truncated = False
        info: dict[str, Any] = {}
        while not ended:
            observation, reward, terminated, truncated, info = self.env.step(act(image))
            image = as_image(observation, self._shape)
            total += self.gamma**duration * float(reward)
            duration += 1
            reached = self.options.holds(option, image)
            ended = reached or terminated or truncated or duration >= self.options.timeout
        self._image = image
        info = info | {"duration": duration, "reached": reached, "option": self.options.name(option)}
        return observation, total, terminated, truncated, info

    def _current(self) -> NDArray[np.uint8]:
        if self._image is None:
            raise UserError("the environment was not reset", None, "Call reset() first.")
        return self._image
