"""Member networks, chosen by name.

Each network is an ``nn.Sequential`` from :func:`inputs_of`, for pictures float (N, C, H, W) in 0..1, to logits (N, 2),
with "positive" in column 1. Built-in networks consist of plain modules, each used once, with each ReLU before its
MaxPool, because DeepLift is valid for such networks only. :func:`reordered` gives a faster order. A user's network may
begin with any module, an encoder.

The paper has no sizes of layers. They come from the authors' public code (github.com/AnitadeMelloKoch/portable_options,
portable/option/divdis/models), without its dropout of 0.1 in DoorKey's network, which the paper does not have.
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
LEAST = {"doorkey": 41, "montezuma": 36, "tiles": 24}  # the fewest pixels of a picture's shorter side
OTHERWISE = "mlp"
JOINT = 256  # units of the dense layer that joins the keys of mixed observations
Parts = tuple[list[nn.Module], tuple[int, ...]]  # the convolutional layers, and the widths of hidden dense layers
MOST_NUMBERS = 2**24  # numbers in the states of one pass without gradients, which take some 400 MB inside a network
ENTRY_POINTS = "hypogoal.networks"  # the entry point group by which other packages add networks


def _convolution(
    channels: int,
    features: int,
    kernel: int,
    stride: int,
) -> list[nn.Module]:
    """Return a convolution, BatchNorm and ReLU."""
    layer = nn.Conv2d(
        channels,
        features,
        kernel_size=kernel,
        stride=stride,
        bias=False,
    )
    return [layer, nn.BatchNorm2d(features), nn.ReLU()]


def doorkey(channels: int) -> Parts:
    """Return DoorKey's layers: two convolutions (+ BatchNorm + ReLU), for three dense layers behind them.

    Pictures need at least 41x41 pixels. Source: the paper's appendix. The sizes are from the authors' code
    (minigrid_cnn.py).
    """
    layers = [
        *_convolution(channels, 32, 5, 2),
        nn.MaxPool2d(kernel_size=3, stride=2),
        *_convolution(32, 64, 3, 2),
        nn.MaxPool2d(kernel_size=4, stride=2),
    ]
    return layers, (750, 100)


def montezuma(channels: int) -> Parts:
    """Return Montezuma's layers: three convolutions (+ BatchNorm + ReLU), for two dense layers behind them.

    Pictures need at least 36x36 pixels. Source: the paper's appendix. The sizes are from the authors' code
    (monte_cnn.py).
    """
    layers = [
        *_convolution(channels, 32, 8, 4),
        *_convolution(32, 64, 4, 2),
        *_convolution(64, 64, 3, 1),
    ]
    return layers, (512,)


def tiles(channels: int) -> Parts:
    """Return layers for pictures made of 8x8 tiles, of at least 24x24 pixels.

    The first layer reads single tiles, the second layer reads 3x3 tiles, and a hidden dense layer follows.
    """
    layers = [
        *_convolution(channels, 16, 8, 8),
        *_convolution(16, 16, 3, 1),
    ]
    return layers, (64,)


def mlp(channels: int) -> Parts:
    """Return no convolutions and two hidden dense layers, for observations of any shape."""
    return [], (256, 256)


NETWORKS = {
    "doorkey": doorkey,
    "montezuma": montezuma,
    "tiles": tiles,
    "mlp": mlp,
}
"""By name: channels (size of the last axis) -> convolutional part, and widths of the hidden dense layers behind it."""


def network_for(name: str, shape: Shape, dtype: DType) -> str:
    """Replace the name ``auto`` by the network that suits the shape and type of observations. Keep any other name.

    For mixed observations, return the names by key, such as ``front=doorkey,state=mlp``. A name without a key is for
    all pictures. Raises ``UserError`` if ``name`` has a key that the observations lack.
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
    """Return the name of the network for pictures of this size, or for numbers."""
    if dtype == PICTURE:
        for network, least in LEAST.items():
            if min(shape[:2]) >= least:
                return network
    return OTHERWISE


def names_in(network: str) -> list[str]:
    """Return the names of networks in a setting, which may have one name for each key."""
    return [part.strip().rpartition("=")[2] for part in network.split(",")]


def load_network(name: str) -> Callable[[Shape], Parts]:
    """Return the function that builds network ``name`` for an observation shape.

    ``name`` is one of :data:`NETWORKS`, an installed entry point, or ``module:function``. Raises ``UserError`` if the
    network is unknown or cannot be loaded, or if the user did not allow the code (see :mod:`hypogoal.core.own_code`).
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
    """Return the layers and widths that a user's function gave. Raises ``UserError`` if they are something else."""
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
    """Build a member network on the CPU: from :func:`as_input` of observations to logits (N, 2).

    For mixed observations, each key has its own network without the last layer, and a dense layer joins the networks.

    Args:
        name: the name of the network, see :func:`load_network`.
        observation_shape: the shape of one observation.
        generator: the random generator that draws the initial weights, by PyTorch's default distributions. With None,
            the generator of the surrounding ``DrawsFrom`` draws.
        dtype: the type of observations.

    Raises:
        UserError: if the network is unknown, or does not take the observations, for example because images are too
            small.
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
    """Build the encoders of mixed observations."""
    shapes, encoders = [], []
    names = names_in(network_for(name, (), dtype))
    for of_key, (_, shape) in zip(names, fields_of((), dtype).values(), strict=True):
        shapes.append(as_input(torch.zeros(1, *shape)).shape[1:])
        encoders.append(build_network(of_key, shape, generator)[:-1])
    return ByKey(shapes, encoders)


def _features(name: str, layers: Iterable[nn.Module], example: Tensor, shape: Shape) -> int:
    """Return how many features a convolutional part makes of an input. Raises ``UserError`` if the part makes none."""
    changes = example._version  # PyTorch counts the operations that changed the tensor in place
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
    """Return a network of the same function with each ReLU after its MaxPool, so that fewer activations are kept.

    Modules with weights are shared with ``network``. ReLU is monotone, so the order changes neither values nor
    gradients. Behind the pooling, ReLU has a quarter of the work. Only attribution needs the other order.
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
    """Return a network of the same function in evaluation mode, with each BatchNorm folded into a convolution."""
    layers: list[nn.Module] = []
    for layer in network:
        before = layers[-1] if layers else None
        if type(layer) is nn.BatchNorm2d and type(before) is nn.Conv2d and layer.track_running_stats:
            layers[-1] = fuse_conv_bn_eval(before, layer)
        else:
            layers.append(layer)
    return nn.Sequential(*layers).eval()


def as_input(observations: Tensor) -> Tensor:
    """Convert pictures uint8 (N, H, W, C) to float32 (N, C, H, W) in 0..1, in the same memory order (channels last).

    Other observations keep their values. If they have the shape (N, H, W, C), their last axis moves to the front, too.
    """
    ordered = observations.permute(0, 3, 1, 2) if observations.ndim == 4 else observations
    return ordered.to(torch.float32).div_(255.0) if observations.dtype == torch.uint8 else ordered


def inputs_of(observations: Observations, device: torch.device | str = "cpu") -> Tensor:
    """Return what networks take of observations (N, ...), see :func:`as_input`.

    For mixed observations, return the numbers of all keys in a row, (N, D).
    """
    if not observations.dtype.names:
        return as_input(torch.from_numpy(observations).to(device))
    parts = []
    for key in observations.dtype.names:
        part = np.ascontiguousarray(observations[key])
        parts.append(inputs_of(part, device).flatten(1))
    return torch.cat(parts, dim=1)


def at_once(most: int, shape: Shape) -> int:
    """Return how many states of ``shape`` may pass a network at once: ``most``, or fewer if states are large."""
    return max(1, min(most, MOST_NUMBERS // prod(shape)))
