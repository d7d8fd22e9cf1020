"""The paper's network: patches of images pass through it as images do, BatchNorm as unrolled, memory or none (D2)."""

from __future__ import annotations

import copy

import numpy as np
import pytest
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from hypogoal.core.seeding import rng_for
from hypogoal.domains.doorkey.engine import DoorKeyEngine
from hypogoal.hypotheses import patches
from hypogoal.options.choosers import RandomChooser
from hypogoal.options.config import OptionConfig
from hypogoal.options.loop import OptionLoop
from hypogoal.options.paper_network import PaperQNetwork, Patches, looked_at
from hypogoal.options.recording import Recorder
from hypogoal.options.recurrent import RecurrentLearner
from hypogoal.options.termination import oracle_terminations

STEPS = 400  # of random play
CPU = torch.device("cpu")
NORMS = ("features.1", "features.5")
WITHOUT_SLOPE = {f"{norm}.{name}" for norm in NORMS for name in ("running_mean", "running_var", "num_batches_tracked")}
WITHOUT_SLOPE |= {"features.0.bias", "features.4.bias"}  # which BatchNorm takes away again


def learner_of(recurrence: str) -> RecurrentLearner:
    """One option after random play on DoorKey, nothing learned."""
    engine = DoorKeyEngine(100, 4)
    config = OptionConfig.of(
        experience="own", network="paper", environments=4, update_interval=4, recurrence=recurrence
    ).model_copy(update={"warm_up": 0})
    verdicts = oracle_terminations(engine, [0])
    learner = RecurrentLearner(engine, verdicts, config, 0)
    loop = OptionLoop(
        engine, verdicts, learner, RandomChooser(rng_for(0, "choice")), Recorder(1, engine), config, config.option_gamma
    )
    while loop.recorder.steps < STEPS:
        loop.advance()
    return learner


def executions(learner: RecurrentLearner, indices: NDArray[np.int64]) -> list[NDArray[np.int64]]:
    """The states that the network sees for each of the steps, and the one after it."""
    data = learner.members[0].replay.data
    place = data.place * learner.members[0].online.remembers
    return [np.append(data.state[row - place[row] : row + 1], data.next_state[row]) for row in indices.tolist()]


class Plain(nn.Module):
    """The network as one would write it down, with another's weights, in double precision."""

    def __init__(self, network: PaperQNetwork):
        super().__init__()
        self.features, self.values = copy.deepcopy(network.features), copy.deepcopy(network.values)
        weights = {name[4:]: value for name, value in network.state_dict().items() if name.startswith("gru.")}
        self.gru = nn.GRU(weights["weight_ih_l0"].shape[1], network.HIDDEN, batch_first=True)
        self.gru.load_state_dict(weights)
        self.double()

    def forward(self, images: NDArray[np.uint8], lengths: list[int]) -> list[Tensor]:
        """Values (T, actions) of sequences of these lengths, all images in one batch as often as they occur."""
        pixels = torch.from_numpy(np.ascontiguousarray(images.transpose(0, 3, 1, 2))).double() / 255.0
        features = self.features(pixels).flatten(1).split(lengths)
        return [self.values(self.gru(part[None])[0][0]) for part in features]


@pytest.mark.parametrize("tables", [True, False])
@pytest.mark.parametrize("recurrence", ["execution", "none"])
def test_it_is_plain_unrolling(recurrence: str, tables: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    """Values, gradients and running statistics are those of float64 with every image as often as it occurs."""
    if not tables:
        monkeypatch.setattr(patches, "WORTHWHILE", 0.0)
    learner = learner_of(recurrence)
    network, engine = learner.members[0].online.train(), learner.engine
    indices, _ = learner.members[0].replay.sample(16, copy.deepcopy(learner.rng))
    rows = executions(learner, indices)
    plain = Plain(network)
    assert recurrence == "execution" or {len(row) for row in rows} == {2}
    lengths = [len(row) for row in rows] if recurrence == "execution" else [1] * (2 * len(rows))
    expected = torch.cat(plain(engine.images(np.concatenate(rows)), lengths))

    unique, inverse, times = np.unique(np.concatenate(rows), return_inverse=True, return_counts=True)
    images = looked_at(engine.images(unique), times, network, CPU)
    assert isinstance(images[0], Patches) == tables
    parts = network.embed(*images)[torch.from_numpy(inverse)].split([len(row) for row in rows])
    values = torch.cat([network(part[None])[0][0] for part in parts])
    torch.testing.assert_close(values.double(), expected, atol=2e-6, rtol=0)

    steep = torch.randn(expected.shape, generator=torch.Generator().manual_seed(0))
    (values * steep).sum().backward()
    (expected * steep.double()).sum().backward()
    slopes, others = slopes_of(network), slopes_of(plain)
    assert slopes.keys() == others.keys()
    for name, slope in slopes.items():
        error, most = (slope.double() - others[name]).abs().max(), others[name].abs().max()
        assert error <= (1e-5 if tables else 1e-3) * most, name  # torch's own convolutions are less exact
    for name, value in plain.features.state_dict().items():
        if name.endswith(("mean", "var")):
            torch.testing.assert_close(network.features.state_dict()[name].double(), value, atol=1e-5, rtol=1e-4)


def slopes_of(network: nn.Module) -> dict[str, Tensor]:
    """Gradients by the names that artefacts have."""
    gradients = copy.deepcopy(network)
    for parameter, source in zip(gradients.parameters(), network.parameters(), strict=True):
        assert source.grad is not None
        parameter.data = source.grad
    return {name: value for name, value in gradients.state_dict().items() if name not in WITHOUT_SLOPE}


def test_artefacts_have_the_weights_as_nn_gru_has_them() -> None:
    """Saved and loaded they are the same; weights of another shape are refused."""
    network = PaperQNetwork((32, 24, 3), 4)
    state = network.state_dict()
    assert {name for name in state if name.startswith("gru.")} == {
        f"gru.{kind}_{of}_l0" for kind in ("weight", "bias") for of in ("ih", "hh")
    }
    other = PaperQNetwork((32, 24, 3), 4)
    other.load_state_dict(copy.deepcopy(state))
    assert all(torch.equal(one, same) for one, same in zip(network.parameters(), other.parameters(), strict=True))
    with pytest.raises(RuntimeError, match="weight_ih_l0"):
        PaperQNetwork((32, 32, 3), 4).load_state_dict(state)


def test_without_memory_a_state_is_worth_the_same_whatever_came_before() -> None:
    """DEV-16: with it is not."""
    images = torch.from_numpy(DoorKeyEngine(100, 1).images(np.arange(3)))
    for remembers in (True, False):
        network = PaperQNetwork((64, 64, 3), 7, remembers).eval()
        with torch.no_grad():
            embedded = network.embed(images)
            together, hidden = network(embedded[None])
            alone = [network(embedded[step, None, None])[0][0, 0] for step in range(3)]
            after = network(embedded[None, 2:], hidden)[0][0, 0]
        assert torch.allclose(together[0], torch.stack(alone), atol=1e-6) != remembers
        assert torch.allclose(after, alone[2], atol=1e-6) != remembers
