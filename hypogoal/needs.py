"""Forecasts of each stage's memory, disk and time, printed before it starts (``core.preflight``).

A step of ensemble training is measured (``hypotheses.trial``). The rest is computed from the true shapes and the
constants below, which tests/test_needs.py compares with what stages take.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import cache
from math import inf
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from hypogoal.core.errors import UserError
from hypogoal.core.preflight import Needs, available
from hypogoal.dataset import NUMBERS, PICTURE, fields_of, open_dataset, values_in
from hypogoal.domains.base import Domain
from hypogoal.hypotheses.config import EnsembleConfig, TrainEnsembleConfig
from hypogoal.learners.baselines.settings import DQNSettings, PPOSettings
from hypogoal.meta.config import TrainMetaConfig, TrainOptionsConfig
from hypogoal.options.recording import STOPS_KEPT

if TYPE_CHECKING:
    from hypogoal.hypotheses.trial import StepCost

BASE = 400e6  # a process with torch, before it does anything
MEMBER = 8e6  # weights of a member with the user's network, which is not run
PAPER_POLICY = 42e6  # weights of a member's policy in the paper's setting: 10.5 M parameters
LIGHT_POLICIES = 1e6  # weights of all light policies, most of them shared; 0.4 MB for 15 options, 0.7 with a grid
COPIES = 5  # of weights in training: the weights, a target, gradients, Adam's two moments
PER_TRANSITION = 50  # bytes in a replay, with its sum tree
CHECKPOINTS = 2  # on disk: the old one stays until the new one is whole
LOGS = 5e6
DATA = 2  # copies of the states in memory: as read, and joined or as the network sees them; often the first alone
LEARNED = 10  # bytes inside the light networks for each number of a picture in a batch
PASSED = 20  # bytes inside a member for each number of a picture that it predicts
EXPLAINED = 8  # states whose attributions are computed at once
SEARCHED = 3e-8  # seconds of a step of a search for proposals, for each of them and each state
SEARCHING = 100  # bytes inside a search, for the same
SAMPLE_NUMBERS = 2**22  # numbers of the states read for a trial, at most
LARGE = 160  # pixels of a side; larger pictures get the advice to shrink them. At 160 training fits in 2 GB


def ensemble_needs(
    data: Path, unlabelled: Sequence[Path], config: TrainEnsembleConfig, steps: int, workers: int, device: str
) -> Needs:
    """``train-ensemble``: ``steps`` for each sub-goal, each in a process, ``workers`` at once.

    A step is measured on the CPU; on a GPU it takes no main memory, and its time is unknown.
    """
    from hypogoal.hypotheses.proposals import MOST_STATES, search_steps
    from hypogoal.hypotheses.trial import step_cost

    dataset = open_dataset(data)
    goals, counts = config.sub_goals or dataset.sub_goals, dataset.counts()
    shape, dtype = dataset.observation_shape, dataset.observation_dtype
    count = max(counts["labelled"][goal]["states"] for goal in goals)
    count += sum(open_dataset(path).counts()["unlabelled"] for path in unlabelled)
    states, free = DATA * count * dataset.observation_bytes, available() or inf
    cost = weights_only(config.members * member_bytes(config.network, shape, dtype))
    if device == "cpu" and count > 1 and workers * (BASE + states + cost.memory) < free:
        some = min(config.batch_size, max(1, SAMPLE_NUMBERS // values_in(shape, dtype)))
        parts = [(data, f"labelled/{goals[0]}"), *((path, "unlabelled") for path in unlabelled)]
        cost = step_cost(np.concatenate([open_dataset(path).sample(part, some) for path, part in parts]), config)

    process = BASE + states + cost.memory
    fitting = int(min((free / workers - process) / max(1.0, cost.memory_each), config.batch_size))
    ways = [f"--set batch_size={fitting}"] if 2 <= fitting < config.batch_size else []
    ways += ["--set workers=1"] if workers > 1 else []
    if longest_side(shape, dtype) > LARGE:
        ways += [f"pictures of {LARGE} pixels (import them with --resize {LARGE})"]
    searched = config.restarts * config.members * min(MOST_STATES, count) if config.proposals == "joint" else 0
    memory = workers * (process + config.batch_size * cost.memory_each + SEARCHING * searched)
    seconds = steps * (cost.seconds + config.batch_size * cost.seconds_each)
    seconds = len(goals) * (seconds + SEARCHED * search_steps(config) * searched) / workers
    smaller = f"Try {' or '.join(ways or ['fewer or smaller states'])}."
    return Needs(memory, ensemble_disk(len(goals), cost.weights), seconds, smaller)


def longest_side(shape: tuple[int, ...], dtype: np.dtype[Any]) -> int:
    """Of an observation's pictures, in pixels; 0 without any."""
    return max((max(size[:2]) for kind, size in fields_of(shape, dtype).values() if kind == PICTURE), default=0)


def weights_only(weights: float) -> StepCost:
    """The cost of a step if only the bytes of the members' weights are known."""
    from hypogoal.hypotheses.trial import LEARNING, StepCost

    return StepCost(weights, (1 + LEARNING) * weights, 0.0, 0.0, 0.0)


@cache
def ensemble_process(states: float, config: EnsembleConfig, shape: tuple[int, ...], dtype: np.dtype[Any]) -> Needs:
    """A process of ``train-ensemble`` with this many bytes of states not yet collected; a step is measured on noise.

    A network of the user's is not run.
    """
    from hypogoal.hypotheses.networks import NETWORKS, names_in, network_for
    from hypogoal.hypotheses.trial import step_cost

    cost = weights_only(config.members * member_bytes(config.network, shape, dtype))
    if NETWORKS.keys() >= {*names_in(network_for(config.network, dtype))}:
        noise = np.zeros((4, *shape), dtype)
        if not dtype.names:
            noise[:] = np.random.default_rng(0).integers(0, 256, noise.shape)
        cost = step_cost(noise, config, seconds=0.0)
    memory = BASE + DATA * states + cost.memory + config.batch_size * cost.memory_each
    return Needs(memory, ensemble_disk(1, cost.weights))


@cache
def member_bytes(network: str, shape: tuple[int, ...], dtype: np.dtype[Any]) -> float:
    """Bytes of a member network for observations of this shape and type, from its shapes alone.

    ``MEMBER`` for the user's network, which is not run here, and for one that does not take such observations.
    """
    import torch

    from hypogoal.core.seeding import torch_generator
    from hypogoal.hypotheses.networks import NETWORKS, build_network, names_in, network_for

    name = network_for(network, dtype)
    try:
        with torch.device("meta"):
            built_in = NETWORKS.keys() >= {*names_in(name)}
            built = build_network(name, shape, torch_generator(0, "needs"), dtype=dtype) if built_in else None
    except UserError:
        built = None
    return float(sum(weights.nbytes for weights in built.parameters())) if built else MEMBER


def ensemble_disk(sub_goals: int, weights: float) -> float:
    """Bytes on disk of ensembles with this many bytes of ``weights``, with their checkpoints."""
    return sub_goals * CHECKPOINTS * 3 * weights + LOGS  # the weights and Adam's two moments


def play_needs(domain: Domain, ensemble: dict[str, Any], config: TrainOptionsConfig | TrainMetaConfig) -> Needs:
    """``train-options`` and ``train-meta`` in a domain; ``ensemble`` is the ensemble manifest's configuration."""
    from hypogoal.meta.training import frames_kept  # loads torch

    sub_goals, members = len(ensemble["sub_goals"]), ensemble["members"]
    options = sub_goals * (1 if config.termination == "oracle" else members)
    picture, shape, dtype = domain.observation_bytes, domain.observation_shape, domain.observation_dtype
    paper = config.network == "paper"
    replays = options if paper else 1
    embedding = 0.0 if config.embedding == "auto" else member_bytes(config.embedding, shape, dtype)
    weights = options * PAPER_POLICY if paper else LIGHT_POLICIES + embedding
    kept = domain.played_bytes(config.steps, frames_kept(config, options))
    replay = config.replay * PER_TRANSITION
    stops = STOPS_KEPT * options * picture + config.save_visited * picture
    state = replays * replay + COPIES * weights + kept
    classifiers = sub_goals * members * judging_member(ensemble.get("network", "auto"), shape, dtype)
    batch = config.option_batch + (config.meta_batch if isinstance(config, TrainMetaConfig) else 0)
    packed = stops / domain.packed
    # While a checkpoint is written, memory holds a copy of the state.
    memory = BASE + 2 * (state + stops) + classifiers + batch * LEARNED * np.prod(shape)
    return Needs(memory, weights + packed + CHECKPOINTS * (state + packed) + LOGS)


def judging_member(network: str, shape: tuple[int, ...], dtype: np.dtype[Any]) -> float:
    """Bytes of a member that predicts states, with a second copy of its weights in ``hypotheses.stacked``."""
    return 2 * member_bytes(network, shape, dtype)


def baseline_needs(observation: int, played: float, steps: int, chosen: PPOSettings | DQNSettings) -> Needs:
    """``train-baseline`` on observations of this many bytes, of which the engine keeps ``played`` bytes."""
    replays = isinstance(chosen, DQNSettings)
    state = 2.0 * observation * min(chosen.replay if isinstance(chosen, DQNSettings) else chosen.rollout, steps)
    learned = 2 * LEARNED * observation * chosen.batch * (1 + replays)  # with a replay the next states, too
    memory = BASE + 100e6 + played + 2 * state + learned
    return Needs(memory, CHECKPOINTS * (replays * state + 50e6) + LOGS)


def evaluation_needs(data: Sequence[Path], workers: int = 1) -> Needs:
    """``evaluate``: each process holds the held-out and unlabelled states of one data file at a time."""
    largest = 0.0
    for dataset in map(open_dataset, data):
        counts = dataset.counts()
        heldout = max((row["states"] for row in counts["heldout"].values()), default=0)
        states = (heldout + counts["unlabelled"]) * dataset.observation_bytes
        largest = max(largest, judging(states, dataset.observation_shape, dataset.observation_dtype))
    return Needs((workers + (workers > 1)) * (BASE + largest), 2 * LOGS)  # the parent holds the states too


def judging(states: float, shape: tuple[int, ...], dtype: np.dtype[Any]) -> float:
    """Bytes to predict this many bytes of states: half as much again to read them, and members' activations."""
    from hypogoal.hypotheses.deep_lift import AT_ONCE, INSIDE
    from hypogoal.hypotheses.networks import at_once

    numbers = values_in(shape, dtype)
    some, explained = at_once(AT_ONCE, (numbers,)), at_once(EXPLAINED, (INSIDE, numbers))
    inside = numbers * (some * PASSED + explained * PASSED * INSIDE) if dtype != NUMBERS else 0.0
    return 1.5 * states + float(inside)
