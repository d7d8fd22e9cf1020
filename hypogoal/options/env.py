"""Options played as the actions of a Gymnasium environment."""

import copy
import warnings
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import gymnasium
import numpy as np
from gymnasium.utils import RecordConstructorArgs

from hypogoal.core.arrays import Bools, Floats
from hypogoal.core.errors import UserError
from hypogoal.domains.find import load_domain
from hypogoal.hypotheses.ensemble import Ensemble
from hypogoal.observations import Observations
from hypogoal.options.loop import offered_options
from hypogoal.options.reward import Env, require_observations
from hypogoal.options.saved import Policies
from hypogoal.options.termination import TerminationRule

MASKED = "a masked option runs: choose by action_masks(), or have warnings of this ignored"


@dataclass(frozen=True, repr=False)
class Options:
    """G x K options. Option g*K + k aims at member k's hypothesis of sub-goal g.

    Attributes:
        sub_goals: the names of the G sub-goals.
        members: K, the number of members of each ensemble.
        ensembles: the termination classifiers, one ensemble per sub-goal.
        policies: starts an option's greedy policy, which :class:`OptionEnv` plays to the option's end.
        rule: what ends options, as the rule was when the options were saved. Each environment plays with a copy.
        timeout: the number of steps after which an option ends.
        mask_reached: whether options are withheld where their sub-goals already hold, as in training.
        domain, domain_config: where the options were trained, see :meth:`make_env`.

    Options can be sent to another process.
    """

    sub_goals: tuple[str, ...]
    members: int
    ensembles: Sequence[Ensemble]
    policies: Policies
    rule: TerminationRule
    timeout: int
    mask_reached: bool
    domain: str
    domain_config: Mapping[str, Any]

    def __repr__(self) -> str:
        goals = ", ".join(self.sub_goals)
        return f"Options({self.count} of {goals}: {self.members} members each, at most {self.timeout} steps)"

    @property
    def count(self) -> int:
        """The number of options, G * K."""
        return len(self.sub_goals) * self.members

    def make_env(self, **arguments: Any) -> Env:
        """Return the Gymnasium environment of training, with the settings with which its states were collected.

        ``arguments`` go to the environment, for example ``layout_seed``. Raises ``UserError`` if the domain is not
        installed, is code that the user did not allow, or has no environment.
        """
        domain = load_domain(self.domain)
        return domain.make_env(**domain.world(self.domain_config) | arguments)

    def name(self, option: int) -> str:
        """Return an option's name, for example ``open-red-door/2``."""
        return f"{self.sub_goals[option // self.members]}/{option % self.members}"

    def log_odds(self, option: int, observation: Observations) -> Floats:
        """Return how sure an option's member is that its sub-goal holds in ``observation`` (*obs), float32 (1,)."""
        ensemble = self.ensembles[option // self.members]
        return ensemble.log_odds(observation[None])[:, option % self.members]

    def offered(self, observation: Observations) -> Bools:
        """Return which options may start in ``observation`` (*obs), bool (G*K,)."""
        if not self.mask_reached:
            return np.ones(self.count, bool)
        log_odds = [ensemble.log_odds(observation[None]) for ensemble in self.ensembles]
        return offered_options(self.rule.positive(np.concatenate(log_odds, axis=1)))[0]


class OptionEnv(gymnasium.Wrapper[Any, Any, Any, Any], RecordConstructorArgs):
    """A Gymnasium environment whose actions are options: ``Discrete(G*K)``.

    One step runs an option until its rule ends it (by default: until its classifier is positive), its time is up or the
    episode ends. The reward is the sum of the rewards inside, discounted by ``gamma``. ``info["duration"]`` is tau, so
    that an agent can bootstrap with gamma ** tau. ``info["reached"]`` says whether the option's own sub-goal was
    reached, and ``info["option"]`` is the option's name.

    sb3-contrib's MaskablePPO calls ``action_masks()``. For a ``gymnasium.vector.SyncVectorEnv``, use
    ``envs.call("action_masks")``. For agents without masks, a masked option runs all the same, with a ``UserWarning``
    before anything is played, and ``info["masked"]`` is true.

    Args:
        env: an environment with the observations that the options were trained on.
        options: the options, from :func:`hypogoal.load_options`.
        gamma: the discount per environment step inside an option. With 1, the reward is the plain sum.

    Raises:
        UserError: if the environment has other observations.

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

    def __init__(
        self,
        env: Env,
        options: Options,
        gamma: float = 1.0,
    ):
        RecordConstructorArgs.__init__(self, _disable_deepcopy=True, options=options, gamma=gamma)
        gymnasium.Wrapper.__init__(self, env)
        self.options, self.gamma = options, gamma
        self.rule = copy.deepcopy(options.rule)
        self._look = require_observations(env, options.ensembles[0])
        self.action_space = gymnasium.spaces.Discrete(options.count)
        self._image: Observations | None = None
        self._masks: Bools | None = None  # of the current observation, None until they are asked for

    def reset(self, **kwargs: Any) -> tuple[Any, dict[str, Any]]:
        """Reset the environment."""
        observation, info = self.env.reset(**kwargs)
        self._image, self._masks = self._look.read(observation), None
        self.rule.begin_episodes(np.zeros(1, int))
        return observation, info

    def action_masks(self) -> Bools:
        """Return which options may start in the current observation, bool (G*K,)."""
        if self._masks is None:
            self._masks = self.options.offered(self._current())
        return self._masks.copy()

    def step(self, action: int) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        """Run option ``action`` to its end, even if the option is masked.

        Raises:
            UserError: if there is no such option, or if the environment was not reset.
        """
        options = self.options
        if not self.action_space.contains(action):
            raise UserError(
                "no such option",
                repr(action),
                f"They are 0 to {options.count - 1}.",
            )
        option = int(action)
        masked = not self.action_masks()[option]
        if masked:
            warnings.warn(MASKED, UserWarning, stacklevel=2)
        act = options.policies(option)
        running = np.array([option])
        total, duration, ended = 0.0, 0, False
        image = self._current()
        while not ended:
            observation, reward, terminated, truncated, info = self.env.step(act(image))
            image = self._look.read(observation)
            total += self.gamma**duration * float(reward)
            log_odds = options.log_odds(option, image)
            [reached] = self.rule.reached(log_odds, running, np.array([duration])).tolist()
            duration += 1
            ended = reached or terminated or truncated or duration >= options.timeout
        self._image, self._masks = image, None
        info = info | {"duration": duration, "reached": reached, "option": options.name(option), "masked": masked}
        return observation, total, terminated, truncated, info

    def _current(self) -> Observations:
        if self._image is None:
            raise UserError("the environment was not reset", None, "Call reset() first.")
        return self._image
