"""What the light Q-network sees by: every pixel, or layers of one's own (Spec D2, D8, G2, H6)."""

import sys

import numpy as np
import pytest
import torch
from corridor import LongCorridor
from option_loops import BEGIN, QUICK, loop_of, played
from torch import Tensor, nn

from hypogoal.core.errors import UserError
from hypogoal.core.tensors import below
from hypogoal.options.learner import make_policies
from hypogoal.options.networks import LightQNetwork, OwnEmbedding, PictureEmbedding, embedding_for

NAME = f"{__name__}:Small"
LIGHT = {"termination": "learned", "network": "light", "sub_goals": ["a", "b"], "members": 1, "embedding": NAME}


class Small(nn.Module):
    """An encoder whose layers draw or look at other states, unless they are told not to."""

    def __init__(self, observation_shape: tuple[int, ...]):
        super().__init__()
        assert observation_shape == LongCorridor.observation_shape
        self.layers = nn.Sequential(nn.Conv2d(4, 8, 4, 4), nn.BatchNorm2d(8), nn.ReLU(), nn.Dropout(0.5), nn.Flatten())

    def forward(self, images: Tensor) -> Tensor:
        assert images.dtype == torch.float32 and 0 <= images.min() <= images.max() <= 1
        return self.layers(images)


def dense(channels: int) -> tuple[list[nn.Module], tuple[int, ...]]:
    """Layers for numbers: their last axis says how many there are."""
    return [nn.Linear(channels, 6), nn.ReLU()], (5,)


@pytest.mark.parametrize("shape", [(84, 84, 4), *((side, 103 - side, 2) for side in range(20, 52))])
def test_every_pixel_is_seen(shape: tuple[int, ...]) -> None:
    """Spec D2: where no weight is below 0, a pixel that changes nothing is one that nobody looks at."""
    embedding = PictureEmbedding(shape)
    with torch.no_grad():
        for weights in embedding.parameters():
            weights.abs_().add_(1e-3)
    pixels = torch.ones(1, *shape, requires_grad=True)
    features = embedding(pixels)
    features.sum().backward()
    assert features.shape == (1, embedding.features) and (pixels.grad > 0).all()


def test_an_own_embedding_learns_and_plays(monkeypatch: pytest.MonkeyPatch) -> None:
    """Spec D2, H6: an encoder as members have it: both options go straight to their ends, also out of their weights."""
    monkeypatch.setenv("HYPOGOAL_TRUST", "1")
    engine = LongCorridor(4)
    loop = loop_of(engine, **QUICK, **BEGIN, epsilon_final=0.02, embedding=NAME)
    learner = loop.learner
    fresh = {name: value.clone() for name, value in learner.state().items()}
    played(loop, 400)
    for option, shortest in ((0, 2), (1, 3)):
        last = list(loop.recorder.executions[option])[-20:]
        assert np.mean([row.reached for row in last]) >= 0.9
        assert np.median([row.duration for row in last]) == shortest
    state = learner.state()
    moved = {
        name
        for name, value in below("online.cells.", state).items()
        if not torch.equal(value, fresh[f"online.cells.{name}"])
    }
    assert moved == {f"encoder.0.layers.{layer}.{kind}" for layer in (0, 1) for kind in ("weight", "bias")}

    ids = np.arange(engine.n_states - 40, engine.n_states)
    policies = make_policies(LIGHT, state, {"observation_shape": engine.observation_shape})
    for option in (0, 1):
        greedy = learner.act(ids, np.full(40, option), np.ones(40), explore=False)
        assert greedy.tolist() == [policies(option)(image) for image in engine.images(ids)]

    with pytest.raises(UserError, match="these options end at the true sub-goals"):
        make_policies(LIGHT | {"termination": "oracle"}, {}, {})
    monkeypatch.delenv("HYPOGOAL_TRUST")
    monkeypatch.delitem(sys.modules, __name__)
    with pytest.raises(UserError, match=f"a file names code of its own as its network: {NAME}"):
        make_policies(LIGHT, state, {"observation_shape": engine.observation_shape})
    for name in ("tiles", "no-such"):
        with pytest.raises(UserError, match=r"do not fit|unknown network|does not take"):
            make_policies({**LIGHT, "embedding": name}, state, {"observation_shape": engine.observation_shape})


def test_numbers_and_member_networks_by_name(monkeypatch: pytest.MonkeyPatch) -> None:
    """Spec H6: numbers are standardised first; our own networks come up to their last hidden layer."""
    monkeypatch.setenv("HYPOGOAL_TRUST", "1")
    mean, deviation = np.array([1, 2, 3], np.float32), np.array([2, 2, 2], np.float32)
    own = embedding_for((3,), (mean, deviation), f"{__name__}:dense")
    assert isinstance(own, OwnEmbedding) and own.features == 5
    torch.testing.assert_close(own(torch.tensor([[3.0, 4.0, 5.0]])), own.encoder(torch.ones(1, 3)))
    network = LightQNetwork((24, 40, 3), 2, 7, None, "tiles")
    assert network(torch.zeros(5, 24, 40, 3, dtype=torch.uint8)).shape == (5, 2, 7)
    assert network.cells.features == 64
