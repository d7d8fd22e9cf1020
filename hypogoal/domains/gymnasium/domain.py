"""A domain made of any Gymnasium environment and a label function for each sub-goal."""

from collections.abc import Callable, Mapping
from functools import cached_property
from typing import Any

import gymnasium
from gymnasium import spaces

from hypogoal.core.config import Config, Values, setting
from hypogoal.core.errors import UserError
from hypogoal.domains.base import Domain, Layouts
from hypogoal.domains.gymnasium.engine import MEMORY, GymnasiumEngine, Label, Success
from hypogoal.domains.gymnasium.play import SEEDS, Policy, collect
from hypogoal.domains.gymnasium.reader import Reader, reader_of
from hypogoal.observations import DType, Shape

Make = Callable[..., gymnasium.Env]
TRAINING = "training"  # the split that later stages play
SPLITS = tuple(name.removesuffix("_seeds") for name in SEEDS)


class GymnasiumConfig(Config):
    """Settings of ``hypogoal collect`` for a domain made of a Gymnasium environment."""

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


class GymnasiumDomain(Domain[GymnasiumConfig]):
    """A domain made of a Gymnasium environment.

    Args:
        make: a function that makes an environment, or functions by split. The splits are ``training``, and any of
            ``labelled``, ``unlabelled`` and ``heldout`` that differs from it. Observations are pictures, uint8
            (H, W, C) or (H, W), or numbers, a ``Box`` of any shape, or a ``Dict`` of pictures and numbers. Actions are
            ``Discrete``. The ``seed`` of ``reset`` sets the layout, so the same seed and actions give the same episode.
            Arguments of ``make`` are the domain's own settings, see ``config_class``.
        sub_goals: by name, a function of the environment that returns whether the sub-goal holds in the current state,
            whatever came before.
        success: a function that is called at the end of each training episode, and returns whether the episode was a
            success. Its arguments are the environment, the last step's info, the episode's sum of rewards, and whether
            the episode terminated. None: an episode succeeds if it terminates with a sum of rewards above 0.
        policy: a function that plays ``1 - explore`` of the steps in which states are collected. None: play is random.
            Policies by sub-goal, for example a policy for each rare sub-goal, share the steps evenly.
        origins: by name, functions of the environment that return numbers to keep beside each state. A name that begins
            with ``planted_`` is that of a feature, which holds or not. Evaluation says how well members tell the
            feature, and labelled and held-out states are drawn evenly over combinations of features, too.
        plan: whether options can be planned (``network=planned``), for which every layout is walked through first.
            True: observations and labels identify a state of a layout. If observations hide something, such as the
            agent's place, give a function of the environment that returns what is hidden. The environment must be
            deterministic, with at most some 50,000 states.
        defaults: by stage, settings that suit this domain, such as ``{"train-ensemble": {"network": "montezuma"}}``.
        memory: the number of distinct states whose observations training keeps, see ``GymnasiumEngine``.
        name: the domain's name in messages. Artefacts use the name that the user passed to ``collect``.
        config_class: a class derived from ``GymnasiumConfig`` that adds settings. ``make`` gets the added settings in
            collection, training, baselines and evaluation.

    Example, for ``hypogoal collect my_module:DOMAIN``::

        DOMAIN = GymnasiumDomain(make, {"key": lambda env: env.unwrapped.carrying is not None})
    """

    many_layouts = has_env = True
    collect = collect

    def __init__(
        self,
        make: Make | Mapping[str, Make],
        sub_goals: Mapping[str, Label],
        *,
        success: Success | None = None,
        policy: Policy | Mapping[str, Policy | None] | None = None,
        origins: Mapping[str, Callable[[gymnasium.Env], int]] | None = None,
        plan: bool | Callable[[gymnasium.Env], Any] = False,
        defaults: Mapping[str, Values] | None = None,
        memory: int = MEMORY,
        name: str = "own",
        config_class: type[GymnasiumConfig] = GymnasiumConfig,
    ):
        self.makes = make if isinstance(make, Mapping) else {TRAINING: make}
        if TRAINING not in self.makes or not {*self.makes} <= {TRAINING, *SPLITS}:
            names = ", ".join(map(str, self.makes))
            raise UserError("make is of unknown splits", names, f"Give {TRAINING}, and any of {', '.join(SPLITS)}.")
        self.success, self.memory, self.name = success, memory, name
        self.origins, self.plan = origins or {}, plan
        self.label_functions, self.sub_goals = sub_goals, tuple(sub_goals)
        self.defaults = defaults or {}
        self.config_class = config_class
        usual = GymnasiumConfig.model_fields
        self.engine_settings = tuple(name for name in config_class.model_fields if name not in usual)
        self.policies = tuple(policy.values()) if isinstance(policy, Mapping) else (policy,)

    @cached_property
    def reader(self) -> Reader:
        """The reader of the environment's observations."""
        env = self.make_env()
        reader = reader_of(env.observation_space)
        env.close()
        return reader

    @property
    def observation_shape(self) -> Shape:
        return self.reader.shape

    @property
    def observation_dtype(self) -> DType:
        return self.reader.dtype

    def make_env(self, split: str = TRAINING, **arguments: Any) -> gymnasium.Env[Any, Any]:
        """Return an environment of a split.

        ``arguments`` are the domain's own settings. Missing settings have their defaults. Raises ``UserError`` if the
        environment's actions are not ``Discrete``.
        """
        fields = self.config_class.model_fields
        defaults = {name: fields[name].default for name in self.engine_settings}
        make = self.makes.get(split, self.makes[TRAINING])
        env = make(**defaults | arguments)
        actions = env.action_space
        if not isinstance(actions, spaces.Discrete) or actions.start != 0:
            raise UserError("actions must be Discrete(n), from 0", actions, "Wrap it so that they are.")
        return env

    def make_engine(self, layout_seed: int, count: int, max_steps: int, **arguments: Any) -> GymnasiumEngine:
        """Return an engine of ``count`` environments.

        ``arguments`` are ``layouts``, ``memory`` and the domain's own settings.
        """
        layouts = arguments.pop("layouts", Layouts((layout_seed,)))
        return GymnasiumEngine(self, layouts, count, max_steps=max_steps, **{"memory": self.memory} | arguments)
