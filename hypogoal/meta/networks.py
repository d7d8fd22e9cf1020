"""Actor and critic over options, and the two ways an option is drawn from the actor's output."""

from abc import ABC, abstractmethod

import torch
from torch import Tensor, nn
from torch.distributions import Normal
from torch.nn import Conv2d, Linear, ReLU

from hypogoal.hypotheses.networks import AUTO, as_input
from hypogoal.observations import Shape, Standard
from hypogoal.options.networks import WIDTH, LightNetwork, embedding_for


class LightMetaNetwork(LightNetwork):
    """An embedding and two dense layers, which actor and critic share."""

    def __init__(
        self,
        observation_shape: Shape,
        options: int,
        standard: Standard | None,
        name: str,
    ):
        embedding = AUTO if name == "light" else name
        super().__init__(embedding_for(observation_shape, standard, embedding))
        self.outputs = _outputs(WIDTH, options)

    def head(self, features: Tensor) -> Tensor:
        """Return a score for each option, then the value, float32 (N, O + 1)."""
        return self.outputs(features)


class PaperMetaNetwork(nn.Module):
    """The paper's network of pictures: three convolutions with ReLU and a dense layer, which actor and critic share.

    The paper gives no sizes. 16, 32 and 32 channels, kernels of 3, strides of 2 and a dense layer of 256 are ours.
    """

    def __init__(self, observation_shape: Shape, options: int):
        super().__init__()
        height, width, depth = observation_shape
        layers = []
        for before, after in ((depth, 16), (16, 32), (32, 32)):
            layers += [Conv2d(before, after, 3, stride=2), ReLU()]
        self.features = nn.Sequential(*layers, nn.Flatten())
        with torch.no_grad():
            blank = torch.zeros(1, depth, height, width)
            size = self.features(blank).numel()
        self.dense = nn.Sequential(Linear(size, 256), ReLU())
        self.outputs = _outputs(256, options)

    def forward(self, images: Tensor) -> Tensor:
        """Return a score for each option, then the value, float32 (N, O + 1), of images uint8 (N, H, W, C)."""
        features = self.features(as_input(images))
        return self.outputs(self.dense(features))


def _outputs(width: int, options: int) -> Linear:
    """Return an output layer whose choices are nearly uniform, so that early updates do not rest on chance weights."""
    layer = Linear(width, options + 1)
    with torch.no_grad():
        layer.weight.mul_(0.01)
        layer.bias.zero_()
    return layer


def among(scores: Tensor, offered: Tensor) -> Tensor:
    """Return scores (N, O), which are minus infinity for options that are not offered."""
    return scores.masked_fill(~offered, -torch.inf)


class Head(nn.Module, ABC):
    """A way to draw an option from the actor's scores (N, O), among the options ``offered``, bool (N, O).

    Attributes:
        remembered: R, the number of numbers that are remembered of a draw.
    """

    remembered: int

    @abstractmethod
    def draw(
        self,
        scores: Tensor,
        offered: Tensor,
        generator: torch.Generator,
    ) -> tuple[Tensor, Tensor]:
        """Draw options, int64 (N,). Return the options and what is remembered of the draws, float32 (N, R)."""

    @abstractmethod
    def log_prob(
        self,
        scores: Tensor,
        offered: Tensor,
        drawn: Tensor,
    ) -> tuple[Tensor, Tensor]:
        """Return the log probability of the draws ``drawn``, and the entropy of the distribution, float32 (N,) each."""


class CategoricalHead(Head):
    """A softmax over the options offered. The number of the option drawn is remembered."""

    remembered = 1

    def draw(
        self,
        scores: Tensor,
        offered: Tensor,
        generator: torch.Generator,
    ) -> tuple[Tensor, Tensor]:
        probabilities = among(scores, offered).log_softmax(1).exp()
        option = torch.multinomial(probabilities, 1, generator=generator)
        return option[:, 0], option.float()

    def log_prob(
        self,
        scores: Tensor,
        offered: Tensor,
        drawn: Tensor,
    ) -> tuple[Tensor, Tensor]:
        log = among(scores, offered).log_softmax(1)
        entropy = -(log.exp() * log.masked_fill(~offered, 0.0)).sum(1)
        return log.gather(1, drawn.long()).squeeze(1), entropy


class GaussianHead(Head):
    """The paper's Gaussian policy head, which draws scores (N, O) and plays the offered option with the highest score.

    The drawn scores are remembered. The entropy is that of the drawn scores. The entropy depends on their spread alone,
    so an entropy bonus cannot keep the choice from becoming certain.
    """

    def __init__(self, options: int):
        super().__init__()
        self.remembered = options
        self.log_std = nn.Parameter(torch.zeros(options))

    def draw(
        self,
        scores: Tensor,
        offered: Tensor,
        generator: torch.Generator,
    ) -> tuple[Tensor, Tensor]:
        noise = torch.randn(scores.shape, generator=generator).to(scores.device)
        drawn = scores + self._spread(scores) * noise
        return among(drawn, offered).argmax(1), drawn

    def log_prob(
        self,
        scores: Tensor,
        offered: Tensor,
        drawn: Tensor,
    ) -> tuple[Tensor, Tensor]:
        normal = Normal(scores, self._spread(scores).expand_as(scores))
        log = normal.log_prob(drawn)
        return log.sum(1), normal.entropy().sum(1)

    def _spread(self, scores: Tensor) -> Tensor:
        return self.log_std.to(scores.device).exp()


def make_head(name: str, options: int) -> Head:
    """Return the head that the setting ``head`` names, for ``options`` options."""
    return GaussianHead(options) if name == "gaussian" else CategoricalHead()
