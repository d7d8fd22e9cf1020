"""DEV-51: what BatchNorm of the paper's network takes its statistics over."""

from __future__ import annotations

import copy

import numpy as np
import pytest
import torch
from numpy.typing import NDArray

from hypogoal.core.seeding import rng_for
from hypogoal.domains.doorkey_engine import DoorKeyEngine
from hypogoal.options.choosers import RandomChooser
from hypogoal.options.config import OptionConfig
from hypogoal.options.loop import OptionLoop
from hypogoal.options.networks import PaperQNetwork
from hypogoal.options.recording import Recorder
from hypogoal.options.recurrent import RecurrentLearner
from hypogoal.options.termination import oracle_terminations

STEPS = 400  # of random play


@pytest.fixture(scope="module")
def learner() -> RecurrentLearner:
    """One option after random play on DoorKey, nothing learned."""
    engine = DoorKeyEngine(100, 4)
    config = OptionConfig(experience="own", network="paper", environments=4, warm_up=0, update_interval=4)
    verdicts = oracle_terminations(engine, [0])
    made = RecurrentLearner(engine, verdicts, config, 0)
    loop = OptionLoop(
        engine, verdicts, made, RandomChooser(rng_for(0, "choice")), Recorder(1, engine), config, config.option_gamma
    )
    while loop.recorder.steps < STEPS:
        loop.advance()
    return made


def executions(learner: RecurrentLearner, indices: NDArray[np.int64]) -> list[NDArray[np.int64]]:
    """The states of the execution up to each of the steps, and the one after it."""
    data = learner.members[0].replay.data
    return [np.append(data.state[row - data.place[row] : row + 1], data.next_state[row]) for row in indices.tolist()]


def unrolled(
    network: PaperQNetwork, learner: RecurrentLearner, rows: list[NDArray[np.int64]], distinct: bool
) -> NDArray[np.float32]:
    """Values after every state of the executions, in training mode: images looked at once each, or as they occur."""
    states = np.concatenate(rows)
    looked, places = np.unique(states, return_inverse=True) if distinct else (states, np.arange(len(states)))
    with torch.no_grad():
        embedded = network.train().embed(learner.tensor(learner.engine.images(looked)))[learner.tensor(places)]
        parts = embedded.split([len(row) for row in rows])
        return torch.cat([network(part[None])[0][0] for part in parts]).numpy()


def test_statistics_are_over_a_batchs_distinct_images(learner: RecurrentLearner) -> None:
    """An update's running statistics are those of each image once; values differ a little from those of occurrences."""
    member = learner.members[0]
    before, draws = copy.deepcopy(member.online), copy.deepcopy(learner.rng)
    indices, _ = member.replay.sample(learner.config.option_batch, draws)
    rows = executions(learner, indices)
    once, often = copy.deepcopy(before), copy.deepcopy(before)
    values, plain = unrolled(once, learner, rows, distinct=True), unrolled(often, learner, rows, distinct=False)
    member.due = learner.config.update_interval
    learner.learn()
    assert member.updates == 1
    for layer in (1, 5):
        mean, same, other = (of.features[layer].running_mean for of in (member.online, once, often))
        torch.testing.assert_close(mean, same)
        assert (mean - other).abs().max() > 1e-4
    assert 0.0003 < np.abs(values - plain).mean() < 0.01
    assert 0.05 < plain.std() < 0.3


def test_without_repeated_images_both_are_the_same(learner: RecurrentLearner) -> None:
    """Then there is nothing to leave out."""
    rows, network = np.split(learner.engine.reachable()[:60], 10), learner.members[0].online
    values = [unrolled(copy.deepcopy(network), learner, rows, distinct) for distinct in (True, False)]
    np.testing.assert_allclose(*values, atol=1e-5)
    values = [unrolled(copy.deepcopy(network), learner, [*rows, *rows[:5]], distinct) for distinct in (True, False)]
    assert np.abs(values[0] - values[1]).max() > 1e-4
