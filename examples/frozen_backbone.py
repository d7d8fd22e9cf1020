r"""Members on a frozen backbone: a small vision transformer, the same in each member, and layers of its own behind it.

    hypogoal collect doorkey --out runs/backbone/data.h5
    hypogoal train-ensemble runs/backbone/data.h5 --out runs/backbone/ensemble --set network=frozen_backbone:vit
    hypogoal train-options runs/backbone/ensemble --out runs/backbone/options --set steps=20000 --trust
    hypogoal train-meta runs/backbone/ensemble --options runs/backbone/options --out runs/backbone/meta \
        --set steps=20000 --trust
    hypogoal evaluate runs/backbone --trust
    hypogoal report runs/backbone --trust

Its weights are random, so that nothing is downloaded. It takes some five minutes of a CPU core.
"""

import torch
from torch import Tensor, nn


class ViT(nn.Module):
    """Patches of 8x8 pixels attend to each other; what they make on average are the features."""

    def __init__(self, observation_shape: tuple[int, ...], width: int = 192, depth: int = 12, heads: int = 3):
        super().__init__()
        rows, columns, channels = observation_shape
        self.patches = nn.Conv2d(channels, width, 8, stride=8)
        self.places = nn.Parameter(0.02 * torch.randn((rows // 8) * (columns // 8), width))
        block = nn.TransformerEncoderLayer(width, heads, 4 * width, 0.0, "gelu", batch_first=True, norm_first=True)
        self.blocks = nn.TransformerEncoder(block, depth, nn.LayerNorm(width), enable_nested_tensor=False)

    def forward(self, images: Tensor) -> Tensor:
        """Float (N, C, H, W) in 0..1 -> features (N, width)."""
        return self.blocks(self.patches(images).flatten(2).mT + self.places).mean(1)


class Frozen(nn.Module):
    """A backbone that stays as it is: weights without gradient, BatchNorm and Dropout always in evaluation mode."""

    def __init__(self, backbone: nn.Module):
        super().__init__()
        self.backbone = backbone.requires_grad_(False).eval()

    def train(self, mode: bool = True) -> nn.Module:
        """Leave the backbone in evaluation mode."""
        return super().train(False)

    def forward(self, images: Tensor) -> Tensor:
        """Float (N, C, H, W) in 0..1 -> features (N, F)."""
        return self.backbone(images)


def vit(observation_shape: tuple[int, ...]) -> tuple[list[nn.Module], tuple[int, ...]]:
    """From the shape (H, W, C) of observations: the backbone, and the width of a hidden layer of each member's own."""
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(0)  # every member gets the same backbone
        backbone = ViT(observation_shape, width=96, depth=2)
    return [Frozen(backbone)], (64,)
