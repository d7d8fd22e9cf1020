r"""Members on a frozen backbone: a small vision transformer sees images once, each member is a head on its features.

    hypogoal collect doorkey --out runs/backbone/data.h5
    export HYPOGOAL_TRUST=frozen_backbone:vit
    hypogoal train-ensemble runs/backbone/data.h5 --out runs/backbone/ensemble --set network=frozen_backbone:vit \
        --set encoder=frozen --set hidden_width=64
    hypogoal train-options runs/backbone/ensemble --out runs/backbone/options --set steps=20000
    hypogoal train-meta runs/backbone/ensemble --options runs/backbone/options --out runs/backbone/meta \
        --set steps=20000
    hypogoal evaluate runs/backbone
    hypogoal report runs/backbone

Its weights are random, so that nothing is downloaded; docs/extending.md has the line for one of timm's. It takes some
five minutes of a CPU core.
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


def vit(observation_shape: tuple[int, ...]) -> nn.Module:
    """An encoder: from the shape (H, W, C) of observations to a module."""
    return ViT(observation_shape, width=96, depth=2)
