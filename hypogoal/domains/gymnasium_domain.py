"""A domain from any Gymnasium environment and a label function for each sub-goal (Spec B6, B7)."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, fields, replace
from functools import cached_property, partial
from pathlib import Path
from typing import Any, NamedTuple

import gymnasium
import numpy as np
from numpy.typing import NDArray

from hypogoal.core.config import as_dict, setting
from hypogoal.core.errors import UserError
from hypogoal.core.own_code import UsersCode
from hypogoal.core.seeding import rng_for
from hypogoal.dataset import GET_MORE, Collected, Observations, States, Unmet, digest, require_classes
from hypogoal.domains import gymnasium_engine as engines
from hypogoal.domains.base import Domain
from hypogoal.domains.recorded_play import MINARI, Recorded, read_play

Policy = Callable[[gymnasium.Env, Any, np.random.Generator], int]
"""What is played to collect states: (environment, observation, random numbers) -> action."""
SEEDS = ("labelled_seeds", "unlabelled_seeds", "heldout_seeds")  # settings: the layouts of each set
FEW_STEPS = 200  # on a layout: of fewer, check plays on fewer layouts
_Layout = tuple[int, list[Recorded]]  # its seed, and what was recorded on it


@dataclass(frozen=True)
class GymnasiumConfig:
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
    play: tuple[str, ...] = setting(
        (), "files of recorded play, or folders of Minari datasets: half of the steps begin somewhere along it"
    )


class GymnasiumDomain(Domain):
    """Spec B6: all that hypogoal needs to know about a problem, from a Gymnasium environment.

    Args:
        make: makes an environment. Observations are pictures, uint8 (H, W, C) or (H, W), or numbers, a ``Box`` of any
            shape or a ``Dict`` of such; actions are ``Discrete``. The ``seed`` of ``reset`` sets the layout: the same
            seed and actions give the same episode. Its arguments are the domain's own settings, see ``config_class``.
        sub_goals: by name, a function of the environment that says whether the sub-goal holds in its current state,
            whatever came before; or names alone, with ``labels``.
        labels: with names alone, one function from the environment to ``{name: bool}`` for all of them.
        success: called at the end of each training episode to say whether it was a success: a function of the
            environment, the last step's info, the episode's sum of rewards, and whether it terminated. None: it
            terminated with a sum above 0.
        policy: plays ``1 - explore`` of the steps to collect states; None: random play. Policies by sub-goal, for
            example one that reaches each rare sub-goal, share the steps evenly.
        defaults: settings of stages that suit this domain, by stage: ``{"train-ensemble": {"network": "montezuma"}}``.
        memory: how many distinct states training keeps observations of, see ``GymnasiumEngine``.
        features: names of the numbers in observations other than pictures; default: those of a ``Dict``, or x0, x1, ...
        resize: side in pixels to which pictures are resized; 0: not at all.
        name: for messages; artefacts have the name that the user gave to ``collect``.
        config_class: a frozen dataclass that adds settings of its own to ``GymnasiumConfig``: ``make`` gets them, in
            collection, training, baselines and evaluation alike.

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
        generic = {field.name for field in fields(GymnasiumConfig)}
        self._own_settings = {field.name: field.default for field in fields(config_class) if field.name not in generic}
        self.engine_settings = tuple(self._own_settings)
        self._labels = engines.Labels(sub_goals, labels)
        self.sub_goals = self._labels.names
        by_goal = policy if isinstance(policy, Mapping) else {}
        self.policies = tuple(by_goal.values()) or (None if isinstance(policy, Mapping) else policy,)
        if not set(by_goal) <= set(self.sub_goals):
            raise UserError(
                "policies are given by sub-goal", ", ".join(by_goal), f"These are {', '.join(self.sub_goals)}."
            )
        self.defaults = dict(defaults or {})

    @cached_property
    def look(self) -> engines.Look:
        """How its observations are read."""
        env = engines.make_checked(self.make_env)
        look = engines.look_of(env)
        env.close()
        if self._named and len(self._named) != len(look.features):
            given = f"{len(self._named)} for {len(look.features)}"
            raise UserError("the number of feature names is wrong", given, "Give one for each.")
        return look._replace(features=self._named or look.features)

    @property
    def observation_shape(self) -> tuple[int, ...]:
        return self.look.shape

    @property
    def observation_dtype(self) -> np.dtype[Any]:
        return self.look.dtype

    @property
    def doubt(self) -> str:
        return self.look.doubt

    @property
    def has_env(self) -> bool:
        return True

    def make_env(self, **arguments: Any) -> gymnasium.Env[Any, Any]:
        """An environment; ``arguments``: its own settings, with defaults for those left out."""
        env = engines.made(self.make, **{**self._own_settings, **arguments})
        return engines.resized(env, self.resize) if self.resize else env

    def make_engine(self, layout_seed: int, count: int, max_steps: int, **arguments: Any) -> engines.GymnasiumEngine:
        """An engine of ``count`` environments; ``arguments``: ``layouts``, ``memory``, and settings of its own."""
        memory, layouts = arguments.pop("memory", self.memory), arguments.pop("layouts", layout_seed)
        make = partial(self.make_env, **arguments)
        told = {"max_steps": max_steps, "memory": memory, "success": self.success}
        return engines.GymnasiumEngine(make, self._labels, layouts, count, **told)

    def small(self, config: GymnasiumConfig) -> GymnasiumConfig:
        return replace(config, states=min(config.states, 200))

    def shortened(self, config: GymnasiumConfig, steps: int) -> GymnasiumConfig:
        """Fewer steps on each layout; where that would be few, one layout of each set, unless play may be of others."""
        seeds = {name: getattr(config, name) for name in SEEDS}
        if not config.play and steps < FEW_STEPS * sum(map(len, seeds.values())):
            seeds = {name: values[:1] for name, values in seeds.items()}
        replayed = self.collected_steps(replace(config, steps=0))
        share = max(1, (steps - replayed) // max(1, sum(map(len, seeds.values()))))
        return replace(config, **seeds, steps=min(config.steps, share))

    def collected_steps(self, config: GymnasiumConfig) -> int:
        recorded = (way for path in config.play for way in read_play(Path(path)))
        layouts = sum(len(getattr(config, name)) for name in SEEDS)
        return layouts * config.steps + sum(len(way.actions) for way in recorded)

    def inputs(self, config: GymnasiumConfig) -> list[Path]:
        return [path / MINARI if path.is_dir() else path for path in map(Path, config.play)]

    def collected_bytes(self, config: GymnasiumConfig) -> int:
        layouts = len(config.labelled_seeds) + len(config.unlabelled_seeds) + len(config.heldout_seeds)
        return layouts * min(config.states, config.steps) * self.observation_bytes

    def played_bytes(self, steps: int, frames: int) -> int:
        return min(2 * self.memory, steps) * self.observation_bytes

    def collect(self, config: GymnasiumConfig, seed: int, progress: Any) -> Collected:
        """Labelled, unlabelled and held-out states met in play on each layout, each picture once.

        Held-out states that look like a labelled or unlabelled one are left out. Origins: ``layout_seed``, ``episode``
        and ``step``, counted from 0. Raises ``Unmet`` if the labelled states have one class only, or if there are no
        unlabelled or no held-out states, ``UserError`` if recorded play cannot be replayed.
        """
        seeds_of_sets = [getattr(config, name) for name in SEEDS]
        env = engines.make_checked(partial(self.make_env, **self.world(as_dict(config))))
        recorded = [way for path in config.play for way in read_play(Path(path))]
        for way in recorded:
            most = int(env.action_space.n) - 1  # type: ignore[attr-defined]
            if max(way.actions) > most or not any(way.layout_seed in seeds for seeds in seeds_of_sets):
                what = f"recorded play has layout seed {way.layout_seed} and actions up to {max(way.actions)}"
                do = f"The seed must be in labelled_seeds, unlabelled_seeds or heldout_seeds, actions in 0 to {most}."
                raise UserError(what, way.where, do)
        progress.expect(self.collected_steps(config))
        learnt: set[bytes] = set()  # what the labelled and the unlabelled states look like
        sets: list[States] = []
        for seeds in seeds_of_sets:
            avoid = learnt if len(sets) == 2 else set()
            ways = [(layout, [way for way in recorded if way.layout_seed == layout]) for layout in seeds]
            met = [state for way in ways for state in self._play(env, config, way, seed, avoid, progress)]
            sets.append(_states(met, self.look, len(self.sub_goals)))
            learnt.update(map(digest, sets[-1].observations))
        env.close()
        labelled, unlabelled, heldout = sets
        collected = Collected(self.look.shape, self.sub_goals, labelled, unlabelled, heldout, self.look.features)
        where = f"steps={config.steps}"
        try:
            for states, name in ((unlabelled, "unlabelled"), (heldout, "held-out")):
                if not len(states.observations):
                    do = "Give other seeds, or more steps: states that look like training states do not count."
                    raise Unmet(f"there are no {name} states", where, do)
            require_classes(labelled.labels, self.sub_goals, where, GET_MORE)
        except Unmet as error:
            error.collected = collected
            raise
        return collected

    def _play(
        self, env: gymnasium.Env, config: GymnasiumConfig, on: _Layout, seed: int, avoid: set[bytes], progress: Any
    ) -> list[_Met]:
        """The distinct states of one layout but those to ``avoid``: an even sample of each combination of sub-goals.

        Of its recorded play, whole; then of ``steps``, shared by the policies: half of them from the start, half from
        somewhere on a recorded way, again and again for as many steps as that has.
        """
        layout, recorded = on
        rng, seen = rng_for(seed, "play", layout), set(avoid)
        groups: dict[bytes, _Sample] = {}
        episode, step, last = -1, 0, 0
        actions = int(env.action_space.n)  # type: ignore[attr-defined]
        starts = engines.Starts(self.look)

        def look(observation: Any) -> None:
            image = self.look.read(env, observation)
            picture = digest(image)
            if picture not in seen:
                seen.add(picture)
                labels = self._labels.of(env)
                group = groups.setdefault(labels.tobytes(), _Sample(config.states))
                group.offer(_Met(image, labels, (layout, episode, step)), rng)

        kinds: list[tuple[Policy | None, list[Recorded], int]] = [(None, [one], len(one.actions)) for one in recorded]
        whole, policies = len(kinds), self.policies * (2 if recorded else 1)
        for number, policy in enumerate(policies):
            first, end = (config.steps * place // len(policies) for place in (number, number + 1))
            kinds.append((policy, recorded if number >= len(self.policies) else [], end - first))
        for number, (policy, ways, steps) in enumerate(kinds):
            over = True
            for left in range(steps, 0, -1):
                if over or step == last:
                    observation = starts.begin(env, layout)
                    episode, step = episode + 1, 0
                    look(observation)
                    way = ways[int(rng.integers(len(ways)))].actions if ways else ()
                    ahead = len(way) if number < whole else int(rng.integers(len(way) + 1))
                    last = ahead + (len(way) or config.max_episode_steps)
                if step < ahead:
                    action = way[step]
                elif policy is None or rng.random() < config.explore:
                    action = int(rng.integers(actions))
                else:
                    with UsersCode("the domain's policy", policy) as code:
                        action = code.choice(policy(env, observation, rng), "the action", actions)
                observation, _reward, terminated, truncated, _info = engines.stepped(env, action)
                step += 1
                look(observation)  # the last state of an episode, too: a sub-goal may lie there
                progress.advance()
                over = terminated or truncated or step >= config.max_episode_steps
                if over and number < whole and left > 1:
                    do = "Leave out the others, or give a larger max_episode_steps."
                    raise UserError(f"the episode ends after {step} of {steps} actions", ways[0].where, do)
        return _shared_out(list(groups.values()), config.states, rng)


class _Met(NamedTuple):
    """A state, and where it was met: layout seed, episode, step."""

    picture: Observations
    labels: NDArray[np.bool_]
    whence: tuple[int, int, int]


class _Sample:
    """So many of the states offered, each as likely as another; all of one combination of sub-goals."""

    def __init__(self, size: int):
        self.size, self.offered = size, 0
        self.kept: list[_Met] = []

    def offer(self, state: _Met, rng: np.random.Generator) -> None:
        """One more state, each once."""
        self.offered += 1
        if len(self.kept) < self.size:
            self.kept.append(state)
        elif (place := int(rng.integers(self.offered))) < self.size:
            self.kept[place] = state


def _shared_out(groups: list[_Sample], size: int, rng: np.random.Generator) -> list[_Met]:
    """``size`` states of all groups, as evenly as they have them, in the order in which they were met."""
    left = size
    states: list[_Met] = []
    for number, group in enumerate(sorted(groups, key=lambda group: len(group.kept))):
        take = min(len(group.kept), left // (len(groups) - number))
        # Not the first places: they hold what was met first, or, once a sample is full, nothing from just after that.
        states += [group.kept[place] for place in rng.permutation(len(group.kept))[:take]]
        left -= take
    return sorted(states, key=lambda state: state.whence)


def _states(met: list[_Met], look: engines.Look, sub_goals: int) -> States:
    images = np.array([state.picture for state in met], look.dtype).reshape(-1, *look.shape)
    labels = np.array([state.labels for state in met], np.bool_).reshape(-1, sub_goals)
    whence = np.array([state.whence for state in met], np.int64).reshape(-1, 3)
    return States(images, labels, dict(zip(("layout_seed", "episode", "step"), whence.T, strict=True)))
