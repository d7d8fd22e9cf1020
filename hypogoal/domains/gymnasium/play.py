"""States of a Gymnasium environment: play of each layout, and a sample of what it reached (Spec B7)."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial
from typing import TYPE_CHECKING, Any, NamedTuple

import gymnasium
import numpy as np
from numpy.random import Generator

from hypogoal.core.arrays import Bools
from hypogoal.core.seeding import rng_for
from hypogoal.data import GET_MORE, Collected, States, Unmet, require_classes
from hypogoal.domains.gymnasium.engine import check_step, make_checked
from hypogoal.domains.gymnasium.reader import Reader
from hypogoal.observations import Observations, digest

if TYPE_CHECKING:
    from hypogoal.domains.gymnasium.domain import GymnasiumConfig, GymnasiumDomain

Policy = Callable[[gymnasium.Env, Any, Generator], int]
"""How to play when collecting states: (environment, observation, random numbers) -> action."""
SEEDS = ("labelled_seeds", "unlabelled_seeds", "heldout_seeds")  # settings: the layouts of each set
ORIGINS = ("layout_seed", "episode", "step")


class Met(NamedTuple):
    """A state that was met, and where: layout seed, episode, step."""

    observation: Observations
    labels: Bools
    origin: tuple[int, int, int]


class Sample:
    """A uniform sample of up to ``size`` of the states offered."""

    def __init__(self, size: int):
        self.size, self.offered = size, 0
        self.kept: list[Met] = []

    def offer(self, state: Met, rng: Generator) -> None:
        """Offer a state, each once."""
        self.offered += 1
        if len(self.kept) < self.size:
            self.kept.append(state)
            return
        place = int(rng.integers(self.offered))
        if place < self.size:
            self.kept[place] = state


class LayoutPlay:
    """Plays one layout and keeps its distinct states by combination of sub-goals, except those in ``seen``, digests."""

    def __init__(
        self,
        domain: GymnasiumDomain,
        env: Any,
        layout_seed: int,
        config: GymnasiumConfig,
        rng: Generator,
        seen: set[bytes],
        progress: Any,
    ):
        self.domain, self.env = domain, env
        self.layout_seed = layout_seed
        self.config = config
        self.rng = rng
        self.seen = seen
        self.progress = progress
        self.samples: dict[bytes, Sample] = {}  # by labels
        self.episode, self.elapsed = -1, 0

    def collect(self) -> list[Met]:
        """An even sample of all combinations of sub-goals; the policies share the steps."""
        policies, steps = self.domain.policies, self.config.steps
        for turn, policy in enumerate(policies):
            first = steps * turn // len(policies)
            end = steps * (turn + 1) // len(policies)
            self._explore(policy, end - first)
        samples = list(self.samples.values())
        return even_sample(samples, self.config.states, self.rng)

    def _explore(self, policy: Policy | None, steps: int) -> None:
        """Play ``steps`` by a policy, or at random."""
        over = True
        for _ in range(steps):
            if over:
                observation = self._begin()
            if policy is None or self.rng.random() < self.config.explore:
                action = int(self.rng.integers(self.env.action_space.n))
            else:
                action = int(policy(self.env, observation, self.rng))
            observation, over = self._step(action)

    def _begin(self) -> Any:
        """Begin an episode; returns its first observation."""
        observation, _info = self.env.reset(seed=self.layout_seed)
        self.episode, self.elapsed = self.episode + 1, 0
        self._keep(observation)
        return observation

    def _step(self, action: int) -> tuple[Any, bool]:
        """Play one step: the observation, and whether the episode is over."""
        result = self.env.step(action)
        if self.episode == self.elapsed == 0:
            check_step(result)
        observation, _reward, terminated, truncated, _info = result
        self.elapsed += 1
        self._keep(observation)  # an episode's last state too: a sub-goal may hold in it
        self.progress.advance()
        over = bool(terminated or truncated)
        return observation, over or self.elapsed >= self.config.max_episode_steps

    def _keep(self, observation: Any) -> None:
        values = self.domain.reader.read(observation)
        look = digest(values)
        if look in self.seen:
            return
        self.seen.add(look)
        labels = self.domain.labels.of(self.env)
        origin = (self.layout_seed, self.episode, self.elapsed)
        empty = Sample(self.config.states)
        sample = self.samples.setdefault(labels.tobytes(), empty)
        sample.offer(Met(values, labels, origin), self.rng)


def even_sample(samples: list[Sample], size: int, rng: Generator) -> list[Met]:
    """Up to ``size`` states of all samples, as evenly as possible, in the order in which they were reached."""
    left = size
    states: list[Met] = []
    samples.sort(key=lambda sample: len(sample.kept))
    for number, sample in enumerate(samples):
        even = left // (len(samples) - number)
        share = min(len(sample.kept), even)
        # Not the first places: those favour the first states reached, or, in a full sample, exclude the next ones.
        order = rng.permutation(len(sample.kept))
        states += [sample.kept[place] for place in order[:share]]
        left -= share
    return sorted(states, key=lambda state: state.origin)


def states_of(met: Sequence[Met], reader: Reader, sub_goals: int) -> States:
    """Observations, labels (N, sub_goals) and origins of the states."""
    count = len(met)
    observations = np.empty((count, *reader.shape), reader.dtype)
    labels = np.empty((count, sub_goals), np.bool_)
    origins = np.empty((count, len(ORIGINS)), np.int64)
    for row, state in enumerate(met):
        observations[row] = state.observation
        labels[row] = state.labels
        origins[row] = state.origin
    columns = dict(zip(ORIGINS, origins.T, strict=True))
    return States(observations, labels, columns)


def collect(domain: GymnasiumDomain, config: GymnasiumConfig, seed: int, progress: Any) -> Collected:
    """Labelled, unlabelled and held-out states reached in play on each layout, each picture once.

    Held-out states that look like a labelled or unlabelled one are left out. Origins: ``layout_seed``, ``episode``
    and ``step``, counted from 0. Raises ``Unmet`` if the labelled states have one class only, or if there are no
    unlabelled or no held-out states.
    """
    world = domain.world(config.model_dump())
    env = make_checked(partial(domain.make_env, **world))
    seeds_of_sets = {name: getattr(config, name) for name in SEEDS}
    layouts = sum(map(len, seeds_of_sets.values()))
    progress.total = config.steps * layouts
    training: set[bytes] = set()  # digests of labelled and unlabelled states
    sets: list[States] = []
    for name, seeds in seeds_of_sets.items():
        met: list[Met] = []
        for layout_seed in seeds:
            seen = set(training) if name == "heldout_seeds" else set()
            rng = rng_for(seed, "play", layout_seed)
            play = LayoutPlay(domain, env, layout_seed, config, rng, seen, progress)
            met += play.collect()
        states = states_of(met, domain.reader, len(domain.sub_goals))
        sets.append(states)
        training.update(map(digest, states.observations))
    env.close()
    labelled, unlabelled, heldout = sets
    where = f"steps={config.steps}"
    for states, kind in ((unlabelled, "unlabelled"), (heldout, "held-out")):
        if not len(states.observations):
            do = "Give other seeds, or more steps: states that look like training states do not count."
            raise Unmet(f"there are no {kind} states", where, do)
    require_classes(labelled.labels, domain.sub_goals, where, GET_MORE)
    reader = domain.reader
    return Collected(
        reader.shape,
        domain.sub_goals,
        labelled,
        unlabelled,
        heldout,
        reader.features,
    )
