"""Three-key DoorKey: the domain, and how its states are collected.

See also ``env`` (the Gymnasium environment and the sub-goals) and ``engine`` (many environments, fast).
"""

from collections.abc import Iterable
from dataclasses import replace
from types import MappingProxyType
from typing import Any

import numpy as np

from hypogoal.core.config import Config, Values, setting
from hypogoal.data import Collected, States, joined, leave_out
from hypogoal.domains.base import EQUATION_1, Domain
from hypogoal.domains.doorkey import env
from hypogoal.domains.doorkey.engine import DoorKeyEngine
from hypogoal.label_checks import require_classes


class DoorKeyConfig(Config):
    """Settings of ``hypogoal collect doorkey``."""

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
    wrong_key: str = setting(
        "harmless",
        "holding the blue or the green key is 'harmless', or 'ends' the episode without reward",
        source="own: a task in which the choice of options matters",
        choices=env.WRONG_KEYS,
    )


def _make_grid(layout_seed: int) -> env.GridLayout:
    """Return a layout without its agent. Layouts with the same grid have the same states."""
    return replace(env.make_layout(layout_seed), start=0, direction=0)


def _heldout_seeds(config: DoorKeyConfig) -> list[int]:
    """Return the first layout seeds from ``heldout_first`` on whose grids are new."""
    grids = set(map(_make_grid, (config.labelled_seed, *config.unlabelled_seeds)))
    chosen: list[int] = []
    layout_seed = config.heldout_first
    while len(chosen) < config.heldout_layouts:
        grid = _make_grid(layout_seed)
        if grid not in grids:
            grids.add(grid)
            chosen.append(layout_seed)
        layout_seed += 1
    return chosen


def _sweep(config: DoorKeyConfig, layout_seeds: Iterable[int], progress: Any) -> States:
    """Return all states of the layouts that the expert reaches, with images, labels and origins."""
    swept = []
    for layout_seed in layout_seeds:
        engine = DoorKeyEngine(layout_seed, door_label=config.door_label, wrong_key=config.wrong_key)
        ids = engine.reachable()
        origins = {"layout_seed": np.full(len(ids), layout_seed), **engine.origins(ids)}
        swept.append(States(engine.images(ids), engine.labels(ids), origins))
        progress.advance()
    return joined(swept)


class DoorKeyDomain(Domain[DoorKeyConfig]):
    """Three-key DoorKey."""

    name = "doorkey"
    sub_goals = env.SUB_GOALS
    observation_shape = env.OBSERVATION_SHAPE
    config_class = DoorKeyConfig
    engine_settings = ("door_label", "wrong_key")
    env_id = "hypogoal.envs:hypogoal/DoorKey-8x8-v0"
    many_layouts = True
    sources = MappingProxyType({"train-ensemble": "paper, Table 3, Eq. (1)", "train-meta": "paper"})
    defaults = MappingProxyType(
        {"train-ensemble": {"diversity_weight": 1e-4, **EQUATION_1}, "train-meta": {"chooser": "ppo"}}
    )

    def collect(self, config: DoorKeyConfig, seed: int, progress: Any) -> Collected:
        """Collect labelled, unlabelled and held-out states, each with its origin.

        The scripted expert is an exhaustive breadth-first sweep, which never drops a key. The sweep reaches every
        position and direction at every stage of the task (which keys are held, and whether the door is locked, open or
        closed again). Each image of a layout is taken once. Held-out states that look like a training state are left
        out, because a layout whose keys are picked up can look like another layout.

        Nothing is random, so ``seed`` changes nothing. All three sets have labels, but those of the unlabelled states
        are for tests only. Origins are layout_seed and those of ``DoorKeyEngine.origins``, int64 (N,) each. Raises
        ``UserError`` if the labelled states are of one class only for a sub-goal.
        """
        heldout_seeds = _heldout_seeds(config)
        progress.total = 1 + len(config.unlabelled_seeds) + len(heldout_seeds)
        labelled = _sweep(config, [config.labelled_seed], progress)
        unlabelled = _sweep(config, config.unlabelled_seeds, progress)
        heldout = _sweep(config, heldout_seeds, progress)
        heldout = leave_out(heldout, labelled.observations, unlabelled.observations)
        where = f"labelled_seed={config.labelled_seed}, wrong_key={config.wrong_key}"
        require_classes(labelled.labels, env.SUB_GOALS, where, "Choose another labelled_seed, or wrong_key=harmless.")
        return Collected(env.OBSERVATION_SHAPE, env.SUB_GOALS, labelled, unlabelled, heldout)

    def task(self, world: Values) -> str:
        ends = world.get("wrong_key") == "ends"
        keys = "the blue or the green key ends the episode" if ends else "the blue and the green key open nothing"
        return f"Take the red key, open the red door and reach the goal behind it, for a reward of 1; {keys}."

    def make_engine(
        self, layout_seed: int, count: int, max_steps: int = env.MAX_STEPS, **arguments: Any
    ) -> DoorKeyEngine:
        return DoorKeyEngine(arguments.pop("layouts", layout_seed), count, max_steps=max_steps, **arguments)


DOMAIN = DoorKeyDomain()
