"""Member networks, chosen by name.

Each is an ``nn.Sequential`` from :func:`inputs_of`, for pictures float (N, C, H, W) in 0..1, to logits (N, 2), with
"positive" in column 1. Built-in networks consist of plain modules used once, each ReLU before its MaxPool: DeepLift is
valid for no others. :func:`reordered` has an order that is faster to train. A user's network may begin with any module,
an encoder.

The paper states the number and kinds of layers, not their sizes. These come from the authors' public code
(github.com/AnitadeMelloKoch/portable_options, portable/option/divdis/models), without its dropout of 0.1 in DoorKey's
network, which the paper does not have.
"""

import inspect
from collections.abc import Callable, Iterable
from itertools import pairwise
from math import prod
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn
from torch.nn.utils import fuse_conv_bn_eval

from hypogoal.core.drawing import DrawsFrom
from hypogoal.core.errors import UserError
from hypogoal.core.own_code import load, place_of
from hypogoal.hypotheses.load import ByKey
from hypogoal.observations import PICTURE, DType, Observations, Shape, fields_of, values_in

CLASSES = 2
AUTO = "auto"  # the network that suits the observations
LEAST = {"doorkey": 41, "montezuma": 36, "tiles": 24}  # pixels of a picture's shorter side
OTHERWISE = "mlp"
JOINT = 256  # units of the dense layer that joins the keys of mixed observations
Parts = tuple[list[nn.Module], tuple[int, ...]]  # convolutional part, widths of hidden dense layers
MOST_NUMBERS = 2**24  # in the states of one pass without gradients: some 400 MB inside a network
ENTRY_POINTS = "hypogoal.networks"  # with which other packages add networks


def _convolution(
    channels: int,
    features: int,
    kernel: int,
    stride: int,
) -> list[nn.Module]:
    """A convolution, BatchNorm, ReLU."""
    layer = nn.Conv2d(
        channels,
        features,
        kernel_size=kernel,
        stride=stride,
        bias=False,
    )
    return [layer, nn.BatchNorm2d(features), nn.ReLU()]


def doorkey(channels: int) -> Parts:
    """DoorKey, two convolutions (+ BatchNorm + ReLU) and three dense layers; from 41x41 pixels.

    Source: the paper's appendix; sizes from the authors' code (minigrid_cnn.py).
    """
    layers = [
        *_convolution(channels, 32, 5, 2),
        nn.MaxPool2d(kernel_size=3, stride=2),
        *_convolution(32, 64, 3, 2),
        nn.MaxPool2d(kernel_size=4, stride=2),
    ]
    return layers, (750, 100)


def montezuma(channels: int) -> Parts:
    """Montezuma, three convolutions (+ BatchNorm + ReLU) and two dense layers; from 36x36 pixels.

    Source: the paper's appendix; sizes from the authors' code (monte_cnn.py).
    """
    layers = [
        *_convolution(channels, 32, 8, 4),
        *_convolution(32, 64, 4, 2),
        *_convolution(64, 64, 3, 1),
    ]
    return layers, (512,)


def tiles(channels: int) -> Parts:
    """Pictures of 8x8 tiles: a layer that reads tiles, one of 3x3 tiles, a hidden dense layer; from 24x24 pixels."""
    layers = [
        *_convolution(channels, 16, 8, 8),
        *_convolution(16, 16, 3, 1),
    ]
    return layers, (64,)


def mlp(channels: int) -> Parts:
    """Two hidden dense layers, for observations of any shape."""
    return [], (256, 256)


NETWORKS = {
    "doorkey": doorkey,
    "montezuma": montezuma,
    "tiles": tiles,
    "mlp": mlp,
}
"""By name: channels (size of the last axis) -> convolutional part, and widths of the hidden dense layers behind it."""


def network_for(name: str, shape: Shape, dtype: DType) -> str:
    """Resolve ``auto`` by the shape and type of observations; any other name stays.

    Of mixed observations the names by key, ``front=doorkey,state=mlp``. A name without a key is for all pictures; a
    key that they lack is a ``UserError``.
    """
    if not dtype.names:
        return _suitable(shape, dtype) if name == AUTO else name
    named = {}
    for part in name.split(","):
        key, _, network = part.strip().rpartition("=")
        named[key] = network
    if unknown := {*named} - {"", *dtype.names}:
        raise UserError(
            "no such key in the observations",
            ", ".join(unknown),
            f"Known are {', '.join(dtype.names)}.",
        )
    resolved = []
    for key, (kind, size) in fields_of((), dtype).items():
        general = named.get("", AUTO) if kind == PICTURE else AUTO
        resolved.append(f"{key}={network_for(named.get(key, general), size, kind)}")
    return ",".join(resolved)


def _suitable(shape: Shape, dtype: DType) -> str:
    """The network for pictures of this size, or for numbers."""
    if dtype == PICTURE:
        for network, least in LEAST.items():
            if min(shape[:2]) >= least:
                return network
    return OTHERWISE


def names_in(network: str) -> list[str]:
    """The names of networks in a setting, which may have one for each key."""
    return [part.strip().rpartition("=")[2] for part in network.split(",")]


def load_network(name: str) -> Callable[[Shape], Parts]:
    """A function from an observation shape to network ``name``: of :data:`NETWORKS`, an entry point, or
    ``module:function``.

    An unknown network, one that cannot be loaded, or code that the user did not allow (see
    :mod:`hypogoal.core.own_code`) is a ``UserError``.
    """
    built_in = dict.fromkeys(NETWORKS, __name__)
    function: Any = NETWORKS.get(name) or load(name, "network", ENTRY_POINTS, built_in)
    if not callable(function):
        raise UserError(
            "this is not a member network",
            name,
            "Give a function of channels or of observation_shape.",
        )

    def parts(shape: Shape) -> Parts:
        by_shape = "observation_shape" in inspect.signature(function).parameters
        network = function(shape if by_shape else shape[-1])
        if isinstance(network, nn.Module):  # an encoder
            return [network], ()
        return _layers(name, network)

    return parts


def _layers(name: str, network: Any) -> Parts:
    """A user's parts, if they are some."""
    try:
        layers, hidden = network
        widths = tuple(map(int, hidden))
        proper = min(widths, default=1) > 0 and all(isinstance(layer, nn.Module) for layer in layers)
    except (TypeError, ValueError):
        proper = False
    if not proper:
        raise UserError(
            f"the network gave {network!r}",
            name,
            "Give (modules, hidden widths above 0), or an encoder.",
        )
    return list(layers), widths


def build_network(
    name: str,
    observation_shape: Shape,
    generator: torch.Generator | None,
    dtype: DType = PICTURE,
) -> nn.Sequential:
    """A member network, :func:`as_input` -> logits (N, 2), on the CPU, for observations of this shape.

    ``generator`` draws the initial weights (PyTorch's default distributions); None: that of the ``DrawsFrom`` around.
    Of mixed observations, of type ``dtype``, each key has its network without the last layer; a dense layer joins them.
    An unknown network (see :func:`load_network`), or observations that it does not take, for example images too small
    for it, are a ``UserError``.
    """
    by_key = _by_key(name, generator, dtype) if dtype.names else None
    example = torch.zeros(1, values_in((), dtype)) if by_key else as_input(torch.zeros(1, *observation_shape))
    seed = int(torch.randint(2**62, (), generator=generator, device="cpu"))
    with DrawsFrom(torch.Generator().manual_seed(seed)):
        layers, hidden = ([by_key], (JOINT,)) if by_key else load_network(name)(observation_shape)
        widths = [_features(name, layers, example, observation_shape), *hidden]
        dense = []
        for inputs, outputs in pairwise(widths):
            dense += [nn.Linear(inputs, outputs), nn.ReLU()]
        dense.append(nn.Linear(widths[-1], CLASSES))
    return nn.Sequential(*layers, nn.Flatten(), *dense).train()


def _by_key(
    name: str,
    generator: torch.Generator | None,
    dtype: DType,
) -> ByKey:
    """The encoders of mixed observations."""
    shapes, encoders = [], []
    names = names_in(network_for(name, (), dtype))
    for of_key, (_, shape) in zip(names, fields_of((), dtype).values(), strict=True):
        shapes.append(as_input(torch.zeros(1, *shape)).shape[1:])
        encoders.append(build_network(of_key, shape, generator)[:-1])
    return ByKey(shapes, encoders)


def _features(name: str, layers: Iterable[nn.Module], example: Tensor, shape: Shape) -> int:
    """How many features a convolutional part makes of an input; a ``UserError`` where it makes none of such a shape."""
    changes = example._version  # counts what is done in place
    try:
        with torch.no_grad():
            features = nn.Sequential(*layers).eval()(example)
    except (RuntimeError, NotImplementedError, ValueError) as error:
        if place_of(error):
            raise
        raise UserError(
            f"the network {name!r} does not take these observations",
            f"observation shape {tuple(shape)}: {error}",
            "Give another (mlp takes any), larger pictures, or your own, of float32 (N, C, H, W) or (N, *shape).",
        ) from None
    if example._version > changes:
        raise UserError("the network changes its input, which all members see", name, "Have it change a copy.")
    kind = getattr(features, "dtype", type(features))
    size = tuple(getattr(features, "shape", ()))
    if kind != torch.float32 or size[:1] != (1,) or len(size) < 2 or not all(size):
        raise UserError(f"the network makes {kind} {size} of a state", name, "Make features, float32 (N, F).")
    return prod(size)


def reordered(network: nn.Sequential) -> nn.Sequential:
    """The same function with each ReLU after its MaxPool, which keeps less; modules with weights are shared.

    ReLU is monotone, so the order changes neither values nor gradients, but behind the pooling it has a quarter of the
    work. Only attribution needs the other order.
    """
    layers: list[nn.Module] = []
    for layer in network:
        if isinstance(layer, ByKey):
            encoders = [reordered(each) for each in layer.encoders if isinstance(each, nn.Sequential)]
            layer = ByKey(layer.shapes, encoders)
        place = len(layers)
        if isinstance(layer, nn.MaxPool2d) and layers and isinstance(layers[-1], nn.ReLU):
            place -= 1
        layers.insert(place, layer)
    return nn.Sequential(*layers)


def folded(network: nn.Sequential) -> nn.Sequential:
    """The same function in evaluation mode, each BatchNorm folded into (a copy of) the convolution before it."""
    layers: list[nn.Module] = []
    for layer in network:
        before = layers[-1] if layers else None
        if type(layer) is nn.BatchNorm2d and type(before) is nn.Conv2d and layer.track_running_stats:
            layers[-1] = fuse_conv_bn_eval(before, layer)
        else:
            layers.append(layer)
    return nn.Sequential(*layers).eval()


def as_input(observations: Tensor) -> Tensor:
    """uint8 (N, H, W, C) -> float32 (N, C, H, W) in 0..1, in the same memory order (channels last).

    Other observations stay as they are, except that the last axis of (N, H, W, C) moves to the front, too.
    """
    ordered = observations.permute(0, 3, 1, 2) if observations.ndim == 4 else observations
    return ordered.to(torch.float32).div_(255.0) if observations.dtype == torch.uint8 else ordered


def inputs_of(observations: Observations, device: torch.device | str = "cpu") -> Tensor:
    """What networks take of observations (N, ...), see :func:`as_input`; of mixed ones all keys' in a row, (N, D)."""
    if not observations.dtype.names:
        return as_input(torch.from_numpy(observations).to(device))
    parts = []
    for key in observations.dtype.names:
        part = np.ascontiguousarray(observations[key])
        parts.append(inputs_of(part, device).flatten(1))
    return torch.cat(parts, dim=1)


def at_once(most: int, shape: Shape) -> int:
    """How many states of this shape to pass through a network at once: ``most``, or fewer if they are large."""
    return max(1, min(most, MOST_NUMBERS // prod(shape)))
