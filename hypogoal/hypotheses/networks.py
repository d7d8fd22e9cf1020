"""Spec C5: member networks, chosen by name.

Each is an ``nn.Sequential`` from float (N, C, H, W) in 0..1, or what else :func:`as_input` gives, to logits (N, 2),
column 1 being "sub-goal reached". Ours are of plain modules used once: DeepLift is right only of such, and with each
ReLU before its MaxPool; the same in an order that is faster to train is :func:`reordered`. An own one may begin with
any module, an encoder.

The paper says how many layers of which kind there are, not their sizes. The sizes are those of the authors'
public code (github.com/AnitadeMelloKoch/portable_options, portable/option/divdis/models); its dropout of
0.1 in DoorKey's network is left out, since the paper has none.
"""

from __future__ import annotations

import copy
import inspect
from bisect import bisect_left
from collections.abc import Callable, Iterable
from itertools import pairwise
from math import prod
from typing import Any, TypeAlias

import numpy as np
import torch
from torch import Tensor, nn
from torch.nn.utils import fuse_conv_bn_eval

from hypogoal.core.errors import UserError
from hypogoal.core.own_code import UsersCode, as_number, load_own
from hypogoal.core.tensors import KEPT
from hypogoal.dataset import NUMBERS, PICTURE

CLASSES = 2
AUTO = "auto"  # the network that suits the observations
Parts: TypeAlias = tuple[list[nn.Module], tuple[int, ...]]  # convolutional part, widths of hidden dense layers
MOST_NUMBERS = 2**24  # of the states that a network is given at once where no gradient is kept: some 400 MB inside
MOST_PIXELS = 1024  # of a side, up to which it is looked for how large an image must be
ENTRY_POINTS = "hypogoal.networks"  # through which other packages add networks


def _convolution(channels: int, features: int, kernel: int, stride: int) -> list[nn.Module]:
    """A convolution, BatchNorm, ReLU."""
    layer = nn.Conv2d(channels, features, kernel_size=kernel, stride=stride, bias=False)
    return [layer, nn.BatchNorm2d(features), nn.ReLU()]


def doorkey(channels: int) -> Parts:
    """Spec C5: DoorKey, two convolutions (+ BatchNorm + ReLU) and three dense layers; from 41x41 pixels.

    Source: the paper's appendix; sizes from the authors' code (minigrid_cnn.py).
    """
    first = [*_convolution(channels, 32, 5, 2), nn.MaxPool2d(kernel_size=3, stride=2)]
    second = [*_convolution(32, 64, 3, 2), nn.MaxPool2d(kernel_size=4, stride=2)]
    return first + second, (750, 100)


def montezuma(channels: int) -> Parts:
    """Spec C5: Montezuma, three convolutions (+ BatchNorm + ReLU) and two dense layers; from 36x36 pixels.

    Source: the paper's appendix; sizes from the authors' code (monte_cnn.py).
    """
    return [*_convolution(channels, 32, 8, 4), *_convolution(32, 64, 4, 2), *_convolution(64, 64, 3, 1)], (512,)


def montezuma_crop(channels: int) -> Parts:
    """Windows of 24x32 pixels around Montezuma's agent: two convolutions (+ BatchNorm + ReLU), two dense layers.

    Beyond the paper. Its Montezuma network needs 36x36 pixels, of which its first layer sees a quarter of the places.
    Here the first layer looks at every other pixel, since the agent is 4 pixels wide and a ladder's rung 1 high; the
    second sees 13x13 pixels, the agent and what it stands on. Where in the window things are is left to the dense
    layers: the base of a ladder and its middle differ in nothing else. A twentieth of the paper's multiplications.
    """
    return [*_convolution(channels, 16, 5, 2), *_convolution(16, 32, 5, 2)], (64,)


def tiles(channels: int) -> Parts:
    """Pictures of 8x8 tiles: a layer that reads tiles, one of 3x3 tiles, one hidden dense layer; from 24x24 pixels."""
    return [*_convolution(channels, 16, 8, 8), *_convolution(16, 16, 3, 1)], (64,)


def mlp(channels: int) -> Parts:
    """Two hidden dense layers, for observations of any shape."""
    return [], (256, 256)


NETWORKS: dict[str, Callable[[int], Parts]] = {
    "doorkey": doorkey,
    "montezuma": montezuma,
    "montezuma-crop": montezuma_crop,
    "tiles": tiles,
    "mlp": mlp,
}
"""By name: number of channels, the last axis -> convolutional part, and widths of the hidden dense layers behind it."""


def network_for(name: str, dtype: np.dtype[Any]) -> str:
    """``auto`` by what observations are; any other name as it is."""
    return {PICTURE: "doorkey", NUMBERS: "mlp"}[dtype] if name == AUTO else name


def load_network(name: str) -> Callable[[tuple[int, ...]], Parts]:
    """What makes network ``name`` of a shape: of :data:`NETWORKS`, an entry point, or ``module:function``.

    No such network, one that cannot be loaded, or code that the user did not allow (see :mod:`hypogoal.core.own_code`)
    is a ``UserError``.
    """
    if name in NETWORKS:
        return lambda shape: NETWORKS[name](shape[-1])
    built_in = {network: f"{__name__}:{function.__name__}" for network, function in NETWORKS.items()}
    made_for = load_own(name, "network", ENTRY_POINTS, built_in)
    if not callable(made_for):
        raise UserError("this is not a member network", name, "Give a function of channels or of observation_shape.")
    return _checked(name, made_for)


def _checked(name: str, made_for: Callable[..., Parts | nn.Module]) -> Callable[[tuple[int, ...]], Parts]:
    """A network of someone's own: what :data:`NETWORKS` give, or an encoder, what :func:`as_input` gives -> (N, F).

    It is given the observations' shape where its argument is called ``observation_shape``, else their channels.
    """

    def checked(shape: tuple[int, ...]) -> Parts:
        with UsersCode(f"the network {name!r}", made_for) as code:
            made = made_for(shape if "observation_shape" in inspect.signature(made_for).parameters else shape[-1])
            if isinstance(made, nn.Module):
                with torch.no_grad():
                    features = made.eval()(as_input(torch.zeros(1, *shape)))
                kind, size = getattr(features, "dtype", type(features)), tuple(getattr(features, "shape", ()))
                if kind != torch.float32 or size[:-1] != (1,) or not all(size):
                    code.refuse(f"is an encoder that makes {kind} {size} of a state", "Make features, float32 (N, F).")
                return keeping([made], code), ()
            layers, hidden = made
            widths = bool(hidden) and all((as_number(width) or 0) > 0 for width in hidden)
            if not widths or not all(isinstance(layer, nn.Module) for layer in layers):
                code.refuse(f"gave layers {layers} and widths {hidden}", "Give (modules, hidden widths above 0).")
            return keeping(layers, code), tuple(hidden)

    def keeping(layers: Iterable[nn.Module], code: UsersCode) -> list[nn.Module]:
        parts = nn.ModuleList(layers)
        for kind in {str(tensor.dtype) for tensor in parts.state_dict().values()} - KEPT:
            code.refuse(f"keeps weights of type {kind}", "Keep them as float32.")
        return [*parts]

    return checked


def build_network(
    name: str, observation_shape: tuple[int, ...], generator: torch.Generator, hidden_width: int = 0
) -> nn.Sequential:
    """A member network, what :func:`as_input` gives -> logits (N, 2), on the CPU, for observations of this shape.

    ``generator`` draws the initial weights (PyTorch's default distributions); before the last layer there is one of
    ``hidden_width`` units. An unknown network (see :func:`load_network`), or observations that it does not take, images
    too small for it, say, are a ``UserError``.
    """
    parts_of = load_network(name)
    where = f"observation shape {tuple(observation_shape)}"
    channels = observation_shape[-1]
    sizes = as_input(torch.zeros(1, *observation_shape)).shape[1:]
    seed = int(torch.randint(2**62, (), generator=generator, device="cpu"))
    with torch.random.fork_rng(devices=[]):  # modules draw their weights from the global state: lend it ours
        torch.manual_seed(seed)
        layers, hidden = parts_of(observation_shape)
        features = _features(layers, *sizes)
        if features is None and len(observation_shape) != 3:
            do = "Give --set network=mlp, or a network of your own (--set network=module:function)."
            raise UserError(f"the network {name!r} takes images (H, W, C)", where, do)
        if features is None:
            side = smallest_side(layers, channels)
            if side is None:
                what = f"the network {name!r} takes no images of {channels} channels"
                raise UserError(what, where, "Its layers must take (N, channels, height, width).")
            raise UserError(f"images too small for the network {name!r}", where, _way_out(side, observation_shape))
        if not isinstance(features, Tensor):
            what = f"the network {name!r} makes {features!r} of images, not a tensor"  # type: ignore[unreachable]
            raise UserError(what, where, "Make a tensor.")
        layers.append(nn.Flatten())
        *widths, last = filter(None, (features.numel(), *hidden, hidden_width))
        for inputs, outputs in pairwise((*widths, last)):
            layers += [nn.Linear(inputs, outputs), nn.ReLU()]
        layers.append(nn.Linear(last, CLASSES))
    return nn.Sequential(*layers).train()


def another(head: nn.Sequential, generator: torch.Generator) -> nn.Sequential:
    """The same dense layers with weights of their own, drawn as PyTorch does."""
    made = copy.deepcopy(head)
    for layer in (layer for layer in made if isinstance(layer, nn.Linear)):
        for value in layer.parameters():
            nn.init.uniform_(value, -(layer.in_features**-0.5), layer.in_features**-0.5, generator=generator)
    return made


def _features(layers: list[nn.Module], *sizes: int) -> Tensor | None:
    """What a convolutional part makes of an input (1, *sizes); None where it does not take that, too small an image."""
    try:
        with torch.no_grad():
            return nn.Sequential(*layers).eval()(torch.zeros(1, *sizes))
    except (RuntimeError, ValueError):
        return None


def smallest_side(layers: list[nn.Module], channels: int) -> int | None:
    """The side, in pixels, of the smallest square image that a convolutional part takes; None where it takes none."""
    takes = 1
    while _features(layers, channels, takes, takes) is None:
        takes *= 2
        if takes > MOST_PIXELS:
            return None
    return bisect_left(range(takes), True, lo=1, key=lambda side: _features(layers, channels, side, side) is not None)


def _way_out(side: int, observation_shape: tuple[int, ...]) -> str:
    """What to do with images smaller than ``side`` pixels, which networks take them as they are among it."""
    height, width, channels = observation_shape
    ways = ["give larger ones"]
    for name, parts_of in NETWORKS.items():
        if _features(parts_of(channels)[0], channels, height, width) is not None:
            ways.append(f"--set network={name}")
    own = "a network of your own (--set network=module:function)"
    return f"It takes {side}x{side} pixels: {', '.join(ways)}, or {own}."


def reordered(network: nn.Sequential) -> nn.Sequential:
    """The same function with each ReLU after its MaxPool; the modules, and so the weights, are shared.

    ReLU is monotone, so the order does not matter to values or gradients, but behind the pooling it has a
    quarter of the work. Only attribution needs the other order.
    """
    layers = list(network)
    for index, (layer, following) in enumerate(pairwise(network)):
        if isinstance(layer, nn.ReLU) and isinstance(following, nn.MaxPool2d):
            layers[index], layers[index + 1] = following, layer
    return nn.Sequential(*layers)


def folded(network: nn.Sequential) -> nn.Sequential:
    """The same function in evaluation mode, each BatchNorm made part of (a copy of) the convolution before it."""
    layers: list[nn.Module] = []
    for layer in network:
        before = layers[-1] if layers else None
        if type(layer) is nn.BatchNorm2d and type(before) is nn.Conv2d and layer.track_running_stats:
            layers[-1] = fuse_conv_bn_eval(before, layer)
        else:
            layers.append(layer)
    return nn.Sequential(*layers).eval()


def as_input(observations: Tensor) -> Tensor:
    """uint8 (N, H, W, C) -> float32 (N, C, H, W) in 0..1, in the memory order (channels last) it came in.

    What is no picture stays as it is, but that of (N, H, W, C) the last axis comes first, too.
    """
    ordered = observations.permute(0, 3, 1, 2) if observations.ndim == 4 else observations
    return ordered.to(torch.float32).div_(255.0) if observations.dtype == torch.uint8 else ordered


def at_once(most: int, shape: tuple[int, ...]) -> int:
    """How many states of this shape a network is given at once: ``most``, or fewer of large ones."""
    return max(1, min(most, MOST_NUMBERS // prod(shape)))
