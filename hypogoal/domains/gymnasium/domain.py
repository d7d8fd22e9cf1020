"""A domain made of any Gymnasium environment and a label function for each sub-goal (Spec B6, B7)."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property, partial
from typing import Any, NamedTuple

import gymnasium
import numpy as np
from numpy.typing import NDArray

from hypogoal.core.config import Config, setting
from hypogoal.core.errors import UserError
from hypogoal.core.seeding import rng_for
from hypogoal.data import GET_MORE, Collected, States, Unmet, require_classes
from hypogoal.domains.base import Domain
from hypogoal.domains.gymnasium import engine as engines
from hypogoal.observations import Observations, digest

Policy = Callable[[gymnasium.Env, Any, np.random.Generator], int]
"""How to play when collecting states: (environment, observation, random numbers) -> action."""
SEEDS = ("labelled_seeds", "unlabelled_seeds", "heldout_seeds")  # settings: the layouts of each set


class GymnasiumConfig(Config):
    """Settings of ``hypogoal collect`` for such a domain."""

    labelled_seeds: tuple[int, ...] = setting(
        (0,), "layout seeds of the labelled states", source="as the paper's MiniGrid experiment", low=0
    )
    unlabelled_seeds: tuple[int, ...] = setting(
        (1, 2), "layout seeds of the unlabelled states", source="as the paper's MiniGrid experiment", low=0
    )
    heldout_seeds: tuple[int, ...] = setting(
        tuple(range(1000, 1010)),
        "layout seeds of the held-out states",
        source="as the paper's MiniGrid experiment",
        low=0,
    )
    steps: int = setting(3_000, "steps played on each layout", unit="steps", low=1)
    states: int = setting(
        1_000, "most distinct states kept of each layout, evenly over combinations of sub-goals", low=2
    )
    explore: float = setting(0.25, "share of random actions, where the domain has a policy", low=0.0, high=1.0)
    max_episode_steps: int = setting(500, "an episode is cut after this many steps", unit="steps", low=1)


class GymnasiumDomain(Domain):
    """Spec B6: all that hypogoal needs to know about a problem, from a Gymnasium environment.

    Args:
        make: makes an environment. Observations are pictures, uint8 (H, W, C) or (H, W), or numbers, a ``Box`` of any
            shape or a ``Dict`` of such; actions are ``Discrete``. The ``seed`` of ``reset`` sets the layout: the same
            seed and actions give the same episode. Its arguments are the domain's own settings, see ``config_class``.
        sub_goals: by name, a function of the environment that returns whether the sub-goal holds in its current state,
            whatever came before; or names alone, with ``labels``.
        labels: with names alone, one function from the environment to ``{name: bool}`` for all of them.
        success: called at the end of each training episode, returns whether it was a success: a function of the
            environment, the last step's info, the episode's sum of rewards, and whether it terminated. None: an episode
            succeeds when it terminates with a sum above 0.
        policy: plays ``1 - explore`` of the steps to collect states; None: random play. Policies by sub-goal, for
            example one that reaches each rare sub-goal, share the steps evenly.
        defaults: by stage, settings that suit this domain: ``{"train-ensemble": {"network": "montezuma"}}``.
        memory: the number of distinct states whose observations training keeps, see ``GymnasiumEngine``.
        features: names of the numbers in observations other than pictures; default: those of a ``Dict``, or x0, x1, ...
        resize: the side in pixels to which pictures are resized; 0: no resizing.
        name: for messages; artefacts use the name that the user passed to ``collect``.
        config_class: a class derived from ``GymnasiumConfig`` that adds settings; ``make`` gets them in collection,
            training, baselines and evaluation.

    Example, for ``hypogoal collect my_module:DOMAIN``::

        DOMAIN = GymnasiumDomain(make, {"key": lambda env: env.unwrapped.carrying is not None})
    """

    many_layouts = True
    labels_stand_in = "the sub-goals of its GymnasiumDomain, with a function that says where it holds"

    def __init__(
        self,
        make: engines.MakeEnv,
        sub_goals: Mapping[str, engines.Label] | Sequence[str],
        *,
        labels: engines.LabelAll | None = None,
        success: engines.Success | None = None,
        policy: Policy | Mapping[str, Policy | None] | None = None,
        defaults: Mapping[str, Mapping[str, Any]] | None = None,
        memory: int = engines.MEMORY,
        features: Sequence[str] = (),
        resize: int = 0,
        name: str = "own",
        config_class: type[GymnasiumConfig] = GymnasiumConfig,
    ):
        self.make, self.memory, self.name = make, memory, name
        self.success, self._named, self.resize = success, tuple(features), resize
        self.config_class = config_class
        generic, settings = GymnasiumConfig.model_fields, config_class.model_fields
        self._own_settings = {name: field.default for name, field in settings.items() if name not in generic}
        self.engine_settings = tuple(self._own_settings)
        self.labels = engines.Labels(sub_goals, labels)
        self.sub_goals = self.labels.names
        by_goal = policy if isinstance(policy, Mapping) else {}
        self.policies = tuple(by_goal.values()) or (None if isinstance(policy, Mapping) else policy,)
        if not set(by_goal) <= set(self.sub_goals):
            raise UserError(
                "policies are given by sub-goal", ", ".join(by_goal), f"These are {', '.join(self.sub_goals)}."
            )
        self.defaults = dict(defaults or {})

    @cached_property
    def reader(self) -> engines.Reader:
        """Reads its observations."""
        env = engines.make_checked(self.make_env)
        reader = engines.reader_of(env)
        env.close()
        if self._named and len(self._named) != len(reader.features):
            counts = f"{len(self._named)} for {len(reader.features)}"
            raise UserError("the number of feature names is wrong", counts, "Give one for each.")
        return reader._replace(features=self._named or reader.features)

    @property
    def observation_shape(self) -> tuple[int, ...]:
        return self.reader.shape

    @property
    def observation_dtype(self) -> np.dtype[Any]:
        return self.reader.dtype

    @property
    def doubt(self) -> str:
        return self.reader.doubt

    @property
    def has_env(self) -> bool:
        return True

    def make_env(self, **arguments: Any) -> gymnasium.Env[Any, Any]:
        """An environment; ``arguments``: the domain's own settings, defaults for those left out."""
        env = self.make(**{**self._own_settings, **arguments})
        return engines.resized(env, self.resize) if self.resize else env

    def make_engine(self, layout_seed: int, count: int, max_steps: int, **arguments: Any) -> engines.GymnasiumEngine:
        """An engine of ``count`` environments; ``arguments``: ``layouts``, ``memory`` and the domain's own settings."""
        memory, layouts = arguments.pop("memory", self.memory), arguments.pop("layouts", layout_seed)
        return engines.GymnasiumEngine(
            partial(self.make_env, **arguments),
            self.labels,
            layouts,
            count,
            max_steps=max_steps,
            memory=memory,
            success=self.success,
        )

    def small(self, config: GymnasiumConfig) -> GymnasiumConfig:
        return config.model_copy(update={"states": min(config.states, 200)})

    def collect(self, config: GymnasiumConfig, seed: int, progress: Any) -> Collected:
        """Labelled, unlabelled and held-out states reached in play on each layout, each picture once.

        Held-out states that look like a labelled or unlabelled one are left out. Origins: ``layout_seed``, ``episode``
        and ``step``, counted from 0. Raises ``Unmet`` if the labelled states have one class only, or if there are no
        unlabelled or no held-out states.
        """
        seeds_of_sets = [getattr(config, name) for name in SEEDS]
        env = engines.make_checked(partial(self.make_env, **self.world(config.model_dump())))
        progress.total = config.steps * sum(map(len, seeds_of_sets))
        training: set[bytes] = set()  # digests of labelled and unlabelled states
        sets: list[States] = []
        for seeds in seeds_of_sets:
            avoid = training if len(sets) == 2 else set()
            states: list[_State] = []
            for layout_seed in seeds:
                rng = rng_for(seed, "play", layout_seed)
                starts = engines.Starts(self.reader)
                play = _LayoutPlay(self, env, config, layout_seed, rng, progress, starts, set(avoid))
                states += play.collect()
            sets.append(_states(states, self.reader, len(self.sub_goals)))
            training.update(map(digest, sets[-1].observations))
        env.close()
        labelled, unlabelled, heldout = sets
        where = f"steps={config.steps}"
        for part, name in ((unlabelled, "unlabelled"), (heldout, "held-out")):
            if not len(part.observations):
                do = "Give other seeds, or more steps: states that look like training states do not count."
                raise Unmet(f"there are no {name} states", where, do)
        require_classes(labelled.labels, self.sub_goals, where, GET_MORE)
        return Collected(self.reader.shape, self.sub_goals, labelled, unlabelled, heldout, self.reader.features)


class _State(NamedTuple):
    """A state and its origin: layout seed, episode, step."""

    observation: Observations
    labels: NDArray[np.bool_]
    origin: tuple[int, int, int]


@dataclass
class _LayoutPlay:
    """Plays one layout and keeps its distinct states by combination of sub-goals, except those in ``seen``."""

    domain: GymnasiumDomain
    env: Any
    config: GymnasiumConfig
    layout_seed: int
    rng: np.random.Generator
    progress: Any
    starts: engines.Starts
    seen: set[bytes]  # digests
    groups: dict[bytes, _Sample] = field(default_factory=dict)
    episode: int = -1
    elapsed: int = 0

    def collect(self) -> list[_State]:
        """An even sample of all combinations of sub-goals; the policies share the steps."""
        policies = self.domain.policies
        for number, policy in enumerate(policies):
            first, end = (self.config.steps * turn // len(policies) for turn in (number, number + 1))
            self.explore(policy, end - first)
        return _even_sample(list(self.groups.values()), self.config.states, self.rng)

    def explore(self, policy: Policy | None, steps: int) -> None:
        """Play ``steps`` by a policy, or at random."""
        count = int(self.env.action_space.n)
        over = True
        for _ in range(steps):
            if over:
                observation = self.begin()
            if policy is None or self.rng.random() < self.config.explore:
                action = int(self.rng.integers(count))
            else:
                action = int(policy(self.env, observation, self.rng))
            observation, over = self.step(action)

    def begin(self) -> Any:
        """Begin an episode; returns its first observation."""
        observation = self.starts.begin(self.env, self.layout_seed)
        self.episode, self.elapsed = self.episode + 1, 0
        self._keep(observation)
        return observation

    def step(self, action: int) -> tuple[Any, bool]:
        """Play one step: the observation, and whether the episode is over."""
        result = self.env.step(action)
        if self.episode == self.elapsed == 0:
            engines.check_step(result)
        observation, _reward, terminated, truncated, _info = result
        self.elapsed += 1
        self._keep(observation)  # an episode's last state too: a sub-goal may hold in it
        self.progress.advance()
        return observation, bool(terminated or truncated) or self.elapsed >= self.config.max_episode_steps

    def _keep(self, observation: Any) -> None:
        picture = self.domain.reader.read(observation)
        look = digest(picture)
        if look not in self.seen:
            self.seen.add(look)
            labels = self.domain.labels.of(self.env)
            sample = self.groups.setdefault(labels.tobytes(), _Sample(self.config.states))
            sample.offer(_State(picture, labels, (self.layout_seed, self.episode, self.elapsed)), self.rng)


class _Sample:
    """A uniform sample of up to ``size`` of the states offered."""

    def __init__(self, size: int):
        self.size, self.offered = size, 0
        self.kept: list[_State] = []

    def offer(self, state: _State, rng: np.random.Generator) -> None:
        """Offer a state, each once."""
        self.offered += 1
        if len(self.kept) < self.size:
            self.kept.append(state)
        elif (place := int(rng.integers(self.offered))) < self.size:
            self.kept[place] = state


def _even_sample(groups: list[_Sample], size: int, rng: np.random.Generator) -> list[_State]:
    """Up to ``size`` states of all groups, as evenly as possible, in the order in which they were reached."""
    left = size
    states: list[_State] = []
    for number, group in enumerate(sorted(groups, key=lambda group: len(group.kept))):
        take = min(len(group.kept), left // (len(groups) - number))
        # Not the first places: those favour the first states reached, or, in a full sample, exclude the next ones.
        states += [group.kept[place] for place in rng.permutation(len(group.kept))[:take]]
        left -= take
    return sorted(states, key=lambda state: state.origin)


def _states(states: list[_State], reader: engines.Reader, sub_goals: int) -> States:
    observations = np.array([state.observation for state in states], reader.dtype).reshape(-1, *reader.shape)
    labels = np.array([state.labels for state in states], np.bool_).reshape(-1, sub_goals)
    origins = np.array([state.origin for state in states], np.int64).reshape(-1, 3)
    return States(observations, labels, dict(zip(("layout_seed", "episode", "step"), origins.T, strict=True)))
