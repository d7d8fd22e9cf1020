"""A domain made of any Gymnasium environment and a label function for each sub-goal (Spec B6, B7)."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import cached_property, partial
from typing import Any

import gymnasium

from hypogoal.core.config import Config, setting
from hypogoal.core.errors import UserError
from hypogoal.data import Collected
from hypogoal.domains.base import Domain
from hypogoal.domains.gymnasium import engine as engines
from hypogoal.domains.gymnasium.engine import GymnasiumEngine, Labels, make_checked
from hypogoal.domains.gymnasium.play import Policy, collect
from hypogoal.domains.gymnasium.reader import Reader, reader_of, resized
from hypogoal.observations import DType, Shape


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
        shared = GymnasiumConfig.model_fields
        self.engine_settings = tuple(name for name in config_class.model_fields if name not in shared)
        self.labels = Labels(sub_goals, labels)
        self.sub_goals = self.labels.names
        self.defaults = dict(defaults or {})
        by_goal = policy if isinstance(policy, Mapping) else {}
        self.policies: tuple[Policy | None, ...] = tuple(by_goal.values())
        if not by_goal:
            self.policies = (None if isinstance(policy, Mapping) else policy,)
        if not by_goal.keys() <= {*self.sub_goals}:
            do = f"These are {', '.join(self.sub_goals)}."
            raise UserError("policies are given by sub-goal", ", ".join(by_goal), do)

    @cached_property
    def reader(self) -> Reader:
        """Reads its observations."""
        env = make_checked(self.make_env)
        reader = reader_of(env)
        env.close()
        if self._named and len(self._named) != len(reader.features):
            counts = f"{len(self._named)} for {len(reader.features)}"
            raise UserError("the number of feature names is wrong", counts, "Give one for each.")
        return replace(reader, features=self._named or reader.features)

    @property
    def observation_shape(self) -> Shape:
        return self.reader.shape

    @property
    def observation_dtype(self) -> DType:
        return self.reader.dtype

    @property
    def doubt(self) -> str:
        return self.reader.doubt

    @property
    def has_env(self) -> bool:
        return True

    def make_env(self, **arguments: Any) -> gymnasium.Env[Any, Any]:
        """An environment; ``arguments``: the domain's own settings, defaults for those left out."""
        fields = self.config_class.model_fields
        defaults = {name: fields[name].default for name in self.engine_settings}
        env = self.make(**{**defaults, **arguments})
        return resized(env, self.resize) if self.resize else env

    def make_engine(self, layout_seed: int, count: int, max_steps: int, **arguments: Any) -> GymnasiumEngine:
        """An engine of ``count`` environments; ``arguments``: ``layouts``, ``memory`` and the domain's own settings."""
        memory = arguments.pop("memory", self.memory)
        layouts = arguments.pop("layouts", layout_seed)
        return GymnasiumEngine(
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
        return collect(self, config, seed, progress)
