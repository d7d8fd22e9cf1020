"""The contract of a member network, as tests for its author (Spec C5; ``hypogoal.hypotheses.networks``)."""

from collections.abc import Iterator
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import nn

from hypogoal.core.seeding import rng_for, torch_generator
from hypogoal.hypotheses.deep_lift import method_of
from hypogoal.hypotheses.ensemble import Ensemble
from hypogoal.hypotheses.networks import as_input, build_network
from hypogoal.hypotheses.stacked import StackedMembers
from hypogoal.hypotheses.views import FullView
from hypogoal.observations import NUMBERS, PICTURE, standard_of
from hypogoal.testing.verdict import Test, Verdict, promise, run

CLOSE = 1e-4


def check_network(
    name: str, observation_shape: tuple[int, ...] = (64, 64, 3), observation_dtype: np.dtype[Any] = PICTURE
) -> Iterator[Verdict]:
    """Whether a member network, by its ``--set network`` name, can be trained, stored, used and explained."""
    view = FullView(observation_shape, standard_of(observation_shape) if observation_dtype == NUMBERS else None)
    return run(_Network(name, view).tests())


class _Network:
    def __init__(self, name: str, view: FullView):
        self.name, self.shape, self.view = name, view.shape, view

    def tests(self) -> Iterator[Test]:
        yield "builds", self.builds
        yield "explained", lambda: f"by {method_of(self.network())}"
        yield "same weights for the same seed", self.repeats
        yield "same answers however asked", self.agrees
        yield "gradients", self.gradients
        yield "stored and read", self.stored

    def ensemble(self) -> Ensemble:
        return Ensemble(self.name, self.shape, 2, torch_generator(0, "check"), self.view)

    def network(self) -> nn.Sequential:
        return build_network(self.name, self.shape, torch_generator(0, "check"))

    def images(self, count: int) -> NDArray[Any]:
        rng, size = rng_for(0, "check"), (count, *self.shape)
        return rng.integers(256, size=size, dtype=np.uint8) if self.view.dtype == PICTURE else rng.random(size, NUMBERS)

    def builds(self) -> str:
        network = self.network()
        logits = network(as_input(torch.from_numpy(self.images(3))))
        text = f"3 images give logits {tuple(logits.shape)}"
        promise(logits.shape == (3, 2), text, "Leave the last layer to hypogoal: it gives 2.")
        count = sum(weight.numel() for weight in network.parameters())
        return f"{self.shape} images, {count} weights"

    def repeats(self) -> str:
        first, second = self.network(), self.network()
        for left, right in zip(first.parameters(), second.parameters(), strict=True):
            promise(torch.equal(left, right), "two networks of one seed differ", "Make new layers at every call.")
        return "weights come from the generator"

    def agrees(self) -> str:
        """One image, many images, all members joined: different code, the same function."""
        ensemble = self.ensemble().eval()
        images = self.images(300)
        images[40:] = images[:260]  # repeated pictures take another code path
        many, few = ensemble.predict(images), np.concatenate([ensemble.predict(images[i : i + 1]) for i in range(40)])
        stacked = 1 / (1 + np.exp(-StackedMembers([ensemble]).log_odds(images[:40])))
        for other, way in ((few, "one by one"), (stacked, "all members at once")):
            worst = float(np.abs(many[:40] - other).max())
            text = f"probabilities computed {way} differ by {worst:.2g}"
            promise(worst < CLOSE, text, "Use layers that act on each image.")
        return "one by one, in batches, all members at once"

    def gradients(self) -> str:
        network = self.network()
        network(as_input(torch.from_numpy(self.images(8)))).square().sum().backward()
        learning = [(name, weight) for name, weight in network.named_parameters() if weight.requires_grad]
        for name, weight in learning:
            learns = weight.grad is not None and bool(weight.grad.isfinite().all() and weight.grad.any())
            promise(learns, f"weight {name} gets no gradient", "Is it used, and not detached?")
        return "every weight that is not frozen learns"

    def stored(self) -> str:
        ensemble = self.ensemble().eval()
        again = Ensemble.from_state(self.name, self.shape, 2, ensemble.state(), self.view)
        same = np.array_equal(ensemble.predict(self.images(5)), again.predict(self.images(5)))
        promise(same, "a stored network gives other answers", "Keep all state in parameters and buffers.")
        return "the same after safetensors"
