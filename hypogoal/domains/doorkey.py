"""Three-key DoorKey (Spec B1-B3): the domain, and how its states are collected.

See also ``doorkey_env`` (the Gymnasium environment and the sub-goals) and ``doorkey_engine`` (many environments, fast).
"""

import itertools
import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace
from typing import Any, TypeAlias

import numpy as np

from hypogoal.core.config import setting
from hypogoal.core.errors import UserError
from hypogoal.core.seeding import rng_for
from hypogoal.dataset import Collected, States, joined, leave_out, require_classes
from hypogoal.domains import doorkey_env as env
from hypogoal.domains.base import Domain
from hypogoal.domains.doorkey_defaults import DEFAULTS, SOURCES
from hypogoal.domains.doorkey_engine import DoorKeyEngine


@dataclass(frozen=True)
class DoorKeyConfig:
    """Settings of ``hypogoal collect doorkey``."""

    regime: str = setting(
        "fixed",
        "labelled states: 'fixed', the layout as it is; 'shuffled', new key placements within its walls",
        source="paper, MiniGrid experiment",
        choices=("fixed", "shuffled"),
    )
    draws: int = setting(20, "key placements of the regime 'shuffled'", source="own choice", low=1, high=1000)
    labelled_seed: int = setting(0, "layout seed of the labelled states", source="paper, MiniGrid experiment", low=0)
    unlabelled_seeds: tuple[int, ...] = setting(
        (1, 2), "layout seeds of the unlabelled states", source="paper, MiniGrid experiment", low=0
    )
    heldout_first: int = setting(
        1000,
        "first held-out layout seed; seeds that repeat a training grid or an earlier one are skipped",
        low=0,
    )
    heldout_layouts: int = setting(20, "held-out layouts", source="paper, MiniGrid experiment", low=1, high=500)
    door_label: str = setting(
        "open",
        "open-red-door holds when the door is 'open', or when the agent is also 'in-front', facing it",
        source="in-front: paper; open: the authors' code",
        choices=env.DOOR_LABELS,
    )
    keyring: bool = setting(True, "several keys can be held", source="the authors' code")
    wrong_key: str = setting(
        "harmless",
        "holding the blue or the green key is 'harmless', or 'ends' the episode without reward",
        source="own: a task in which the choice of options matters",
        choices=env.WRONG_KEYS,
    )


Source: TypeAlias = tuple[int, int, env.Layout]  # layout seed, draw (see ``collect``), layout


def _labelled_layouts(config: DoorKeyConfig, seed: int) -> list[Source]:
    layout = env.layout_of(config.labelled_seed)
    if config.regime == "fixed":
        return [(config.labelled_seed, 0, layout)]
    placements = list(itertools.permutations(layout.key_cells(), 3))
    if len(placements) < config.draws:
        fault = f"the layout has only {len(placements)} key placements"
        raise UserError(fault, f"draws={config.draws}", "Ask for fewer.")
    chosen = rng_for(seed, "doorkey", "key-placements").choice(len(placements), config.draws, replace=False)
    return [
        (config.labelled_seed, number, replace(layout, keys=placements[index]))
        for number, index in enumerate(chosen.tolist(), start=1)
    ]


def _heldout_layouts(config: DoorKeyConfig, avoid: Iterable[env.Layout]) -> list[Source]:
    """The first layouts from ``heldout_first`` on whose grids are new."""
    grids = {layout.grid for layout in [*avoid, env.layout_of(config.labelled_seed)]}
    chosen: list[Source] = []
    for layout_seed in itertools.count(config.heldout_first):
        if len(chosen) == config.heldout_layouts:
            break
        layout = env.layout_of(layout_seed)
        if layout.grid not in grids:
            grids.add(layout.grid)
            chosen.append((layout_seed, 0, layout))
    return chosen


def _sweep(config: DoorKeyConfig, layout_seed: int, draw: int, layout: env.Layout, progress: Any) -> States:
    """All states of one layout that an expert can reach: images, labels and origins."""
    engine = DoorKeyEngine(layout, keyring=config.keyring, door_label=config.door_label, wrong_key=config.wrong_key)
    ids = engine.reachable()
    progress.advance()
    origins = {"layout_seed": np.full(len(ids), layout_seed), "draw": np.full(len(ids), draw)}
    return States(engine.images(ids), engine.labels(ids), origins | engine.origins(ids))


class DoorKeyDomain(Domain):
    """Spec B6: three-key DoorKey."""

    name = "doorkey"
    reading = "The triangle is the agent; a key that it carries has left the grid."
    sub_goals = env.SUB_GOALS
    observation_shape = env.OBSERVATION_SHAPE
    config_class = DoorKeyConfig
    engine_settings = ("keyring", "door_label", "wrong_key")
    env_id = "hypogoal/DoorKey-8x8-v0"
    many_layouts = True
    packed = 20  # 26 measured
    defaults, sources = DEFAULTS, SOURCES

    def collected_bytes(self, config: DoorKeyConfig) -> int:
        """An upper bound: layout 0 has some 1,640 states, others up to 2,500."""
        draws = config.draws if config.regime == "shuffled" else 1
        layouts = draws * (1 + len(config.unlabelled_seeds)) + config.heldout_layouts
        return layouts * 2_500 * math.prod(self.observation_shape)

    def collect(self, config: DoorKeyConfig, seed: int, progress: Any) -> Collected:
        """Spec B3: labelled, unlabelled and held-out states, each with its origin.

        The scripted expert is an exhaustive breadth-first sweep: every position and direction at every stage of the
        task (keys held; door locked, open, closed again) that is reachable without dropping a key, each image once.
        Held-out states that look like a training state are left out: with its keys picked up, a layout can look like
        another. The regime ``shuffled`` keeps a random sample, as large as the set that ``fixed`` has.

        ``seed`` draws the key placements and that sample; ``fixed`` does not depend on it. All three sets have labels
        (the unlabelled states' are for tests only). Origins, int64 (N,) each: layout_seed, draw (0: the seed's own key
        placement), and those of ``DoorKeyEngine.origins``. A sub-goal with one class only among the labelled states, or
        too many draws, is a ``UserError``.
        """
        labelled = _labelled_layouts(config, seed)
        unlabelled = [(layout_seed, 0, env.layout_of(layout_seed)) for layout_seed in config.unlabelled_seeds]
        heldout = _heldout_layouts(config, avoid=[layout for _, _, layout in [*labelled, *unlabelled]])
        sources = labelled, unlabelled, heldout
        progress.expect(sum(map(len, sources)))
        training, others, test = (joined([_sweep(config, *source, progress) for source in group]) for group in sources)
        if config.regime == "shuffled":
            amount = len(DoorKeyEngine(config.labelled_seed, keyring=config.keyring).reachable())
            kept = np.zeros(len(training.labels), np.bool_)
            rng = rng_for(seed, "doorkey", "shuffled-states")
            kept[rng.choice(len(kept), min(amount, len(kept)), replace=False)] = True
            training = training.where(kept)
        test = leave_out(test, training.observations, others.observations)
        where = f"labelled_seed={config.labelled_seed}, keyring={config.keyring}"
        require_classes(training.labels, env.SUB_GOALS, where, "Choose another labelled_seed, or keyring=true.")
        return Collected(env.OBSERVATION_SHAPE, env.SUB_GOALS, training, others, test)

    def task(self, world: Mapping[str, Any]) -> str:
        ends = world.get("wrong_key") == "ends"
        keys = "the blue or the green key ends the episode" if ends else "the blue and the green key open nothing"
        return f"Take the red key, open the red door and reach the goal behind it, for a reward of 1; {keys}."

    def make_engine(
        self, layout_seed: int, count: int, max_steps: int = env.MAX_STEPS, **arguments: Any
    ) -> DoorKeyEngine:
        return DoorKeyEngine(arguments.pop("layouts", layout_seed), count, max_steps=max_steps, **arguments)


DOMAIN = DoorKeyDomain()
