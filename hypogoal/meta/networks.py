"""Actor and critic over options (Spec E2), and the two ways an option is drawn from the actor's output."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from hypogoal.options.networks import CellEmbedding, TileNetwork


class LightMetaNetwork(TileNetwork):
    """Cells, two dense layers, actor and critic."""

    def __init__(self, observation_shape: tuple[int, ...], options: int, width: int = 128):
        super().__init__()
        self.cells = CellEmbedding(observation_shape)
        self.trunk = nn.Sequential(nn.Linear(self.cells.features, width), nn.ReLU(), nn.Linear(width, width), nn.ReLU())
        self.outputs = nn.Linear(width, options + 1)
        _quiet_start(self.outputs)

    def forward(self, images: Tensor) -> Tensor:
        """uint8 (N, H, W, C) -> float32 (N, O + 1): a score per option, then the value."""
        return self.outputs(self.trunk(self.cells(images)))

    def from_codes(self, codes: Tensor, tiles: NDArray[np.uint8]) -> Tensor:
        """The same from tile codes; see :class:`hypogoal.options.networks.CellEmbedding`."""
        return self.outputs(self.trunk(self.cells.from_codes(codes, tiles)))


class PaperMetaNetwork(nn.Module):
    """The paper's: three convolutions with ReLU between, a dense layer, shared by actor and critic.

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


class CategoricalHead(nn.Module):
    """A softmax over the options offered."""

    def __init__(self, options: int):
        super().__init__()
        self.options = options

    def draw(self, scores: Tensor, offered: Tensor, generator: torch.Generator) -> tuple[Tensor, Tensor]:
        """Options int64 (N,) and what must be remembered of the draw, float32 (N, 1)."""
        chance = self._log(scores, offered).exp()
        option = torch.multinomial(chance, 1, generator=generator)
        return option[:, 0], option.float()

    def best(self, scores: Tensor, offered: Tensor) -> Tensor:
        """The most likely option, int64 (N,)."""
        return scores.masked_fill(~offered, -torch.inf).argmax(1)

    def log_prob(self, scores: Tensor, offered: Tensor, drawn: Tensor) -> tuple[Tensor, Tensor]:
        """Log probability of the draws and the entropy, float32 (N,) each."""
        log = self._log(scores, offered)
        entropy = -(log.exp() * log.masked_fill(~offered, 0.0)).sum(1)
        return log.gather(1, drawn.long()).squeeze(1), entropy

    @staticmethod
    def _log(scores: Tensor, offered: Tensor) -> Tensor:
        return scores.masked_fill(~offered, -torch.inf).log_softmax(1)


class GaussianHead(nn.Module):
    """The paper's Gaussian policy head: scores drawn from a Gaussian, the arg-max of those offered is played."""

    def __init__(self, options: int):
        super().__init__()
        self.log_std = nn.Parameter(torch.zeros(options))

    def draw(self, scores: Tensor, offered: Tensor, generator: torch.Generator) -> tuple[Tensor, Tensor]:
        """Options int64 (N,) and the drawn scores, float32 (N, O)."""
        spread = self.log_std.to(scores.device).exp()
        drawn = scores + spread * torch.randn(scores.shape, generator=generator).to(scores.device)
        return drawn.masked_fill(~offered, -torch.inf).argmax(1), drawn

    def best(self, scores: Tensor, offered: Tensor) -> Tensor:
        """The option whose mean score is highest, int64 (N,)."""
        return scores.masked_fill(~offered, -torch.inf).argmax(1)

    def log_prob(self, scores: Tensor, offered: Tensor, drawn: Tensor) -> tuple[Tensor, Tensor]:
        """Log density of the drawn scores and the entropy, float32 (N,) each."""
        normal = torch.distributions.Normal(scores, self.log_std.to(scores.device).exp().expand_as(scores))
        return normal.log_prob(drawn).sum(1), normal.entropy().sum(1)


Head = CategoricalHead | GaussianHead
HEADS: dict[str, Callable[[int], Head]] = {"categorical": CategoricalHead, "gaussian": GaussianHead}
NETWORKS: dict[str, Callable[[tuple[int, ...], int], nn.Module]] = {
    "light": LightMetaNetwork,
    "paper": PaperMetaNetwork,
}
