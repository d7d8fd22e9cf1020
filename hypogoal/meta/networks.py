"""Actor and critic over options (Spec E2), and the two ways an option is drawn from the actor's output."""

import math
from collections.abc import Callable

import numpy as np
import torch
from torch import Tensor, nn

from hypogoal.observations import Standard
from hypogoal.options.networks import WIDTH, CellEmbedding, Embedding, LightNetwork, NumberEmbedding, OwnEmbedding


class LightMetaNetwork(LightNetwork):
    """Cells, or numbers where there is a ``standard`` of them, or an own embedding; two dense layers, actor, critic."""

    def __init__(
        self, observation_shape: tuple[int, ...], options: int, standard: Standard | None = None, name: str = "light"
    ):
        embedding: Embedding
        if name != "light":
            embedding = OwnEmbedding(name, observation_shape, standard)
        elif standard is not None:
            embedding = NumberEmbedding(observation_shape, standard)
        else:
            embedding = CellEmbedding(observation_shape)
        super().__init__(embedding)
        self.outputs = nn.Linear(WIDTH, options + 1)
        _quiet_start(self.outputs)

    def head(self, features: Tensor) -> Tensor:
        """float32 (N, O + 1): a score per option, then the value."""
        return self.outputs(features)


class PaperMetaNetwork(nn.Module):
    """The paper's, of pictures: three convolutions with ReLU between, a dense layer, shared by actor and critic.

    The paper gives no sizes; 16, 32 and 32 channels with kernel 3 and stride 2, dense 256, are ours.
    """

    def __init__(self, observation_shape: tuple[int, ...], options: int):
        super().__init__()
        height, width, depth = observation_shape
        self.features = nn.Sequential(
            nn.Conv2d(depth, 16, 3, stride=2), nn.ReLU(),
            nn.Conv2d(16, 32, 3, stride=2), nn.ReLU(),
            nn.Conv2d(32, 32, 3, stride=2), nn.ReLU(),
            nn.Flatten(),
        )  # fmt: skip
        with torch.no_grad():
            size = self.features(torch.zeros(1, depth, height, width)).shape[1]
        self.dense = nn.Sequential(nn.Linear(size, 256), nn.ReLU())
        self.outputs = nn.Linear(256, options + 1)
        _quiet_start(self.outputs)

    def forward(self, images: Tensor) -> Tensor:
        """uint8 (N, H, W, C) -> float32 (N, O + 1): a score per option, then the value."""
        return self.outputs(self.dense(self.features(images.permute(0, 3, 1, 2).float() / 255.0)))


def _quiet_start(layer: nn.Linear) -> None:
    """Begin with nearly uniform choices, so that early updates do not rest on the initialisation."""
    with torch.no_grad():
        layer.weight.mul_(0.01)
        layer.bias.zero_()


class Head(nn.Module):
    """How an option is drawn from the actor's scores (N, O) among those offered, bool (N, O)."""

    remembered: int  # numbers of each draw, see :meth:`draw`

    def draw(self, scores: Tensor, offered: Tensor, generator: torch.Generator) -> tuple[Tensor, Tensor]:
        """Options int64 (N,) and what must be remembered of the draw, float32 (N, ``remembered``)."""
        raise NotImplementedError

    def log_prob(self, scores: Tensor, offered: Tensor, drawn: Tensor) -> tuple[Tensor, Tensor]:
        """Log probability of the draws and the entropy of what is drawn, float32 (N,) each."""
        raise NotImplementedError

    def probabilities(self, scores: Tensor, offered: Tensor) -> Tensor:
        """Of each option to be chosen, float32 (N, O); rows sum to 1, and options not offered have 0."""
        raise NotImplementedError

    def best(self, scores: Tensor, offered: Tensor) -> Tensor:
        """The option with the highest score, int64 (N,)."""
        return scores.masked_fill(~offered, -torch.inf).argmax(1)


class CategoricalHead(Head):
    """A softmax over the options offered; an option is remembered as its number, (N, 1)."""

    def __init__(self, options: int):
        super().__init__()
        self.options, self.remembered = options, 1

    def draw(self, scores: Tensor, offered: Tensor, generator: torch.Generator) -> tuple[Tensor, Tensor]:
        option = torch.multinomial(self._log(scores, offered).exp(), 1, generator=generator)
        return option[:, 0], option.float()

    def log_prob(self, scores: Tensor, offered: Tensor, drawn: Tensor) -> tuple[Tensor, Tensor]:
        log = self._log(scores, offered)
        entropy = -(log.exp() * log.masked_fill(~offered, 0.0)).sum(1)
        return log.gather(1, drawn.long()).squeeze(1), entropy

    def probabilities(self, scores: Tensor, offered: Tensor) -> Tensor:
        return self._log(scores, offered).exp()

    @staticmethod
    def _log(scores: Tensor, offered: Tensor) -> Tensor:
        return scores.masked_fill(~offered, -torch.inf).log_softmax(1)


class GaussianHead(Head):
    """The paper's Gaussian policy head: scores (N, O) are drawn, and remembered; the best offered is played.

    Its entropy is that of the drawn scores. It depends on their spread alone, so an entropy bonus cannot keep the
    choice from becoming certain.
    """

    NODES = 16  # of the quadrature; a test holds it against draws

    def __init__(self, options: int):
        super().__init__()
        self.remembered = options
        self.log_std = nn.Parameter(torch.zeros(options))

    def draw(self, scores: Tensor, offered: Tensor, generator: torch.Generator) -> tuple[Tensor, Tensor]:
        spread = self.log_std.to(scores.device).exp()
        drawn = scores + spread * torch.randn(scores.shape, generator=generator).to(scores.device)
        return self.best(drawn, offered), drawn

    def log_prob(self, scores: Tensor, offered: Tensor, drawn: Tensor) -> tuple[Tensor, Tensor]:
        normal = torch.distributions.Normal(scores, self.log_std.to(scores.device).exp().expand_as(scores))
        return normal.log_prob(drawn).sum(1), normal.entropy().sum(1)

    def probabilities(self, scores: Tensor, offered: Tensor) -> Tensor:
        """That an option's draw is the highest of those offered, by Gauss-Hermite quadrature over that draw."""
        spread = self.log_std.to(scores.device).exp()
        chosen = torch.zeros_like(scores)
        for node, weight in zip(*np.polynomial.hermite_e.hermegauss(self.NODES), strict=True):
            lead = (scores + spread * node)[:, :, None] - scores[:, None, :]
            below = torch.special.log_ndtr(lead / spread).masked_fill(~offered[:, None, :], 0.0)
            others = below.sum(2) - below.diagonal(dim1=1, dim2=2)
            chosen += weight / math.sqrt(2 * math.pi) * others.exp()
        chosen = chosen.masked_fill(~offered, 0.0)
        return chosen / chosen.sum(1, keepdim=True)


HEADS: dict[str, Callable[[int], Head]] = {"categorical": CategoricalHead, "gaussian": GaussianHead}


def meta_network(
    name: str, observation_shape: tuple[int, ...], options: int, standard: Standard | None = None
) -> LightMetaNetwork | PaperMetaNetwork:
    """The network of this ``name``: ``light``, ``paper``, or ``module:function``, as a light network's embedding."""
    if name == "paper":
        return PaperMetaNetwork(observation_shape, options)
    return LightMetaNetwork(observation_shape, options, standard, name)
