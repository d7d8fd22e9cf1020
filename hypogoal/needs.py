"""What each stage will need of memory and disk, in bytes, said before it starts (``core.preflight``).

Estimates on the high side, from what is kept: states, replays, networks with their optimiser. ``BASE`` is what a
process with torch has before any of it (450 MB were measured while ``train-meta`` ran on DoorKey, light).
"""

from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from hypogoal.core.errors import UserError
from hypogoal.dataset import open_dataset
from hypogoal.domains.base import Domain
from hypogoal.hypotheses.config import EnsembleConfig
from hypogoal.meta.config import TrainMetaConfig, TrainOptionsConfig
from hypogoal.options.recording import STOPS_KEPT

BASE = 450e6
MEMBER = 8e6  # weights of a member network, the largest that come with hypogoal (the paper's for Montezuma)
WINDOWS = 6e6  # of a member's numbers for known windows (hypotheses.windows), while their table grows
PAPER_POLICY = 42e6  # weights of a member's policy in the paper's setting: 10.5 M parameters
LIGHT_POLICIES = 1e6  # weights of all light policies, which share most of them; 0.4 MB of 15 options, 0.7 with a grid
COPIES = 5  # of weights in training: those, a target or gradients beside them, and two of Adam's
PER_TRANSITION = 50  # bytes in a replay, its sum tree included
CHECKPOINTS = 2  # on disk: the last one stays until the next one is whole
LOGS = 5e6


class Needs(NamedTuple):
    """Bytes of memory, of all processes of a stage together, and of disk."""

    memory: float
    disk: float


def ensemble_needs(
    data: Path, unlabelled: Sequence[Path], config: EnsembleConfig, sub_goals: int, workers: int
) -> Needs:
    """``train-ensemble``: each process holds a sub-goal's states three times (read, as seen, prepared)."""
    dataset = open_dataset(data)
    labelled = max((row["states"] for row in dataset.counts()["labelled"].values()), default=0)
    others = sum(open_dataset(path).counts()["unlabelled"] for path in unlabelled)
    states = (labelled + others) * dataset.observation_bytes
    each = member_bytes(config.network, dataset.observation_shape, dataset.observation_dtype)
    return Needs(workers * ensemble_process(states, config.members), ensemble_disk(sub_goals, config.members, each))


def ensemble_process(states: float, members: int) -> float:
    """Memory of a process that trains a sub-goal's ensemble on so many bytes of states."""
    return BASE + 3 * states + COPIES * members * MEMBER


def member_bytes(network: str, shape: tuple[int, ...], dtype: np.dtype[Any]) -> float:
    """Bytes of a member network for observations of this shape and type.

    ``MEMBER`` for a network of someone's own, which is not run here, or for one that does not take them.
    """
    from hypogoal.core.seeding import torch_generator
    from hypogoal.hypotheses.networks import NETWORKS, build_network, network_for

    name = network_for(network, dtype)
    try:
        made = build_network(name, shape, torch_generator(0, "needs")) if name in NETWORKS else None
    except UserError:
        made = None
    return 4.0 * sum(weights.numel() for weights in made.parameters()) if made else MEMBER


def ensemble_disk(sub_goals: int, members: int, each: float) -> float:
    """What an ensemble of members of ``each`` bytes needs on the disk, its checkpoints included."""
    training = (COPIES - 1) * members * each  # gradients are not kept
    return sub_goals * (members * each + training) + LOGS


def play_needs(domain: Domain, about: dict[str, Any], config: TrainOptionsConfig | TrainMetaConfig) -> Needs:
    """``train-options`` and ``train-meta`` in a domain; ``about`` is the ensemble manifest's configuration."""
    from hypogoal.meta.training import frames_kept  # with torch, which nobody else here needs

    oracle = config.termination == "oracle"
    options = len(about["sub_goals"]) * (1 if oracle else about["members"])
    picture = domain.observation_bytes
    paper = config.network == "paper"
    replays = options if paper else 1
    own = 0.0 if config.embedding in ("auto", "grid") else MEMBER
    weights = options * PAPER_POLICY if paper else LIGHT_POLICIES + own
    kept = domain.played_bytes(config.steps, frames_kept(config, options))
    stops = STOPS_KEPT * options * picture + config.save_visited * picture
    state = replays * config.replay * PER_TRANSITION + COPIES * weights + kept
    members = len(about["sub_goals"]) * about["members"] * (MEMBER + WINDOWS)
    packed = stops / domain.packed
    # A checkpoint is a copy of the state, in memory while it is written.
    memory = BASE + 2 * (state + stops) + members
    return Needs(memory, weights + packed + CHECKPOINTS * (state + packed) + LOGS)


def baseline_needs(observation: int, replay: int, members: int = 0) -> Needs:
    """``train-baseline``: ``replay`` transitions of two observations of so many bytes; ``members`` who earn a bonus."""
    state = 2.0 * observation * replay
    return Needs(BASE + 100e6 + 2 * state + members * (MEMBER + WINDOWS), CHECKPOINTS * (state + 50e6) + LOGS)


def evaluation_needs(data: list[Path], workers: int = 1) -> Needs:
    """``evaluate``: the held-out and unlabelled states of one data file at a time, twice, in each of its processes."""
    largest = 0
    for dataset in map(open_dataset, data):
        counts = dataset.counts()
        heldout = max((row["states"] for row in counts["heldout"].values()), default=0)
        largest = max(largest, (heldout + counts["unlabelled"]) * dataset.observation_bytes)
    processes = workers + (workers > 1)  # the one that asks holds the states too
    return Needs(300e6 + processes * (BASE + 2.0 * largest), 2 * LOGS)
