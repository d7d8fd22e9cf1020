"""A member network of one's own: see docs/own-domain.md. Check it: hypogoal check --network wide_network:wide"""

from torch import nn


def wide(channels: int) -> tuple[list[nn.Module], tuple[int, ...]]:
    """One wide convolution: its layers, and the widths of the dense layers behind them; the last one is hypogoal's."""
    layers = [nn.Conv2d(channels, 64, kernel_size=8, stride=8), nn.BatchNorm2d(64), nn.ReLU()]
    return layers, (64,)
