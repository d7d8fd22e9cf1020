"""How states of a Gymnasium environment are collected, by play of each layout and a sample of the states reached."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from typing import TYPE_CHECKING, Any, NamedTuple

import gymnasium
import numpy as np
from numpy.random import Generator

from hypogoal.core.arrays import Bools
from hypogoal.core.errors import UserError
from hypogoal.core.seeding import rng_for
from hypogoal.data import PLANTED, Collected, States
from hypogoal.domains.gymnasium.engine import ask_labels
from hypogoal.label_checks import GET_MORE, Unmet, require_classes
from hypogoal.observations import Observations, digest

if TYPE_CHECKING:
    from hypogoal.domains.gymnasium.domain import GymnasiumConfig, GymnasiumDomain

Policy = Callable[[gymnasium.Env, Any, Generator], int]
"""How to play when collecting states: (environment, observation, random numbers) -> action."""
SEEDS = ("labelled_seeds", "unlabelled_seeds", "heldout_seeds")  # the settings that name the layouts of each set
PASS_SEEDS = (
    "Pass every seed on, also 0: super().reset(seed=seed). No wrapper may show what came before (NormalizeObservation)."
)
ORIGINS = ("layout_seed", "episode", "step")


class Met(NamedTuple):
    """A state that was met, and where it was met."""

    observation: Observations
    labels: Bools
    origin: tuple[int, ...]  # the numbers of ``ORIGINS``, then those of the domain's own origins


def play_layout(
    policies: Sequence[Policy | None],
    env: Any,
    layout_seed: int,
    config: GymnasiumConfig,
    rng: Generator,
) -> Iterator[tuple[Any, tuple[int, int, int]]]:
    """Play a layout. Yield each observation and its origin.

    The last state of an episode is yielded, too, because a sub-goal may hold in it. The policies share the steps
    evenly. None in place of a policy plays at random.
    """
    episode = -1
    for turn, policy in enumerate(policies):
        first = config.steps * turn // len(policies)
        end = config.steps * (turn + 1) // len(policies)
        over = True
        for _ in range(first, end):
            if over:
                observation, _info = env.reset(seed=layout_seed)
                episode, elapsed = episode + 1, 0
                yield observation, (layout_seed, episode, elapsed)
            if policy is None or rng.random() < config.explore:
                action = int(rng.integers(env.action_space.n))
            else:
                action = int(policy(env, observation, rng))
            observation, _reward, terminated, truncated, _info = env.step(action)
            elapsed += 1
            yield observation, (layout_seed, episode, elapsed)
            over = terminated or truncated or elapsed >= config.max_episode_steps


def sample_layout(
    domain: GymnasiumDomain,
    env: Any,
    layout_seed: int,
    config: GymnasiumConfig,
    seen: set[bytes],
    rng: Generator,
    *,
    by_features: bool,
) -> list[Met]:
    """Return a sample of the distinct states of a layout, even over combinations of sub-goals, and of features.

    States whose digests are in ``seen`` are left out. Of each combination at most ``config.states`` states are kept,
    and each state that was met is kept with the same probability.
    """
    kept: dict[bytes, list[Met]] = {}  # by combination
    offered: Counter[bytes] = Counter()
    begun = b""
    for observation, origin in play_layout(domain.policies, env, layout_seed, config, rng):
        try:
            values = domain.reader.read(observation)
        except UserError as error:
            where = f"{error.where}, at {', '.join(ORIGINS)} {origin}"
            raise UserError(error.what, where, error.do) from None
        look = digest(values)
        *_, step = origin
        if not step:
            begun = begun or look
            if look != begun:
                raise UserError("reset shows something else in a later episode", f"seed={layout_seed}", PASS_SEEDS)
        if look in seen:
            continue
        seen.add(look)
        labels = ask_labels(env, domain.label_functions)
        changed = labels != ask_labels(env, domain.label_functions)
        if changed.any():
            names = ", ".join(np.array(domain.sub_goals)[changed])
            raise UserError("a label differs when it is asked for again", names, "Have it keep nothing.")
        kept_beside = {name: int(function(env)) for name, function in domain.origins.items()}
        state = Met(values, labels, (*origin, *kept_beside.values()))
        combination = labels.tobytes()
        if by_features:
            features = [number > 0 for name, number in kept_beside.items() if name.startswith(PLANTED)]
            combination += bytes(features)
        sample = kept.setdefault(combination, [])
        offered[combination] += 1
        if len(sample) < config.states:
            sample.append(state)
            continue
        place = int(rng.integers(offered[combination]))
        if place < config.states:
            sample[place] = state
    return sample_evenly(list(kept.values()), config.states, rng)


def sample_evenly(samples: list[list[Met]], size: int, rng: Generator) -> list[Met]:
    """Return up to ``size`` states of all samples, as evenly as possible, in the order in which they were reached."""
    states: list[Met] = []
    samples.sort(key=len)
    for number, sample in enumerate(samples):
        even = (size - len(states)) // (len(samples) - number)
        # The first places of a sample would favour the first states reached, or, in a full sample, exclude states that
        # were reached later.
        order = rng.permutation(len(sample))
        states += [sample[place] for place in order[:even]]
    return sorted(states, key=lambda state: state.origin)


def collect(domain: GymnasiumDomain, config: GymnasiumConfig, seed: int, progress: Any) -> Collected:
    """Collect labelled, unlabelled and held-out states by play, each observation of a layout once.

    Held-out states that look like a labelled or unlabelled state are left out. Origins are ``layout_seed``, ``episode``
    and ``step``, counted from 0, and the domain's own. Raises ``Unmet`` if the labelled states are of one class only
    for a sub-goal, or if a set has no states.
    """
    world = domain.world(config.model_dump())
    reader = domain.reader
    names = *ORIGINS, *domain.origins
    seeds_of_sets = [getattr(config, name) for name in SEEDS]
    progress.total = sum(map(len, seeds_of_sets))
    training: set[bytes] = set()  # digests of labelled and unlabelled states
    sets = []
    for name, seeds in zip(SEEDS, seeds_of_sets, strict=True):
        env = domain.make_env(name.removesuffix("_seeds"), **world)
        met = []
        for layout_seed in seeds:
            seen = set(training) if name == "heldout_seeds" else set()
            rng = rng_for(seed, "play", layout_seed)
            by_features = name != "unlabelled_seeds"  # nobody knows the features of unlabelled states
            met += sample_layout(domain, env, layout_seed, config, seen, rng, by_features=by_features)
            progress.advance()
        env.close()
        if not met:
            raise Unmet(
                f"there are no states for {name}",
                f"steps={config.steps}",
                "Give other seeds, or more steps: states that look like training states do not count.",
            )
        observations, labels, origins = zip(*met, strict=True)
        named = dict(zip(names, np.transpose(origins), strict=True))
        states = States(
            np.array([*observations], reader.dtype),  # a list, because a tuple would be one mixed observation
            np.array(labels),
            named,
        )
        sets.append(states)
        training.update(map(digest, observations))
    labelled, unlabelled, heldout = sets
    require_classes(labelled.labels, domain.sub_goals, f"steps={config.steps}", GET_MORE)
    return Collected(reader.shape, domain.sub_goals, labelled, unlabelled, heldout, reader.features)
