"""Weights on disk: safetensors only, no pickle is ever loaded."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

from hypogoal.core.artefacts import AGAIN
from hypogoal.core.errors import NumericalError, UserError
from hypogoal.core.files import reading

if TYPE_CHECKING:
    from torch import Tensor, nn

    M = TypeVar("M", bound=nn.Module)


def stored(tensors: Mapping[str, Any], owner: str) -> bytes:
    """Tensors or arrays by name as a file has them. NaN or Inf is a ``NumericalError``."""
    import torch
    from safetensors.torch import save

    weights = {}
    for name, values in tensors.items():
        tensor = torch.as_tensor(values)
        if not tensor.isfinite().all():
            raise NumericalError(f"the weight {name} of {owner} is NaN or Inf; a mask of these needs persistent=False")
        # a copy: where two layers share a weight, safetensors would refuse it
        weights[name] = tensor.detach().cpu().clone(memory_format=torch.contiguous_format)
    return save(weights)


def save_tensors(path: Path, tensors: Mapping[str, Any]) -> None:
    """Write what is :func:`stored` of tensors or arrays by name; nothing where they cannot be."""
    path.write_bytes(stored(tensors, path.stem))


def load_tensors(path: Path) -> dict[str, Tensor]:
    """Read tensors by name. A file that is missing, cut or not safetensors is a ``UserError``."""
    from safetensors.torch import load_file

    with reading(path, AGAIN, "the weights"):
        return load_file(path)


def below(prefix: str, tensors: Mapping[str, Tensor]) -> dict[str, Tensor]:
    """The tensors whose names begin with a prefix, by the rest of the name."""
    inner = {}
    for name, tensor in tensors.items():
        if name.startswith(prefix):
            inner[name.removeprefix(prefix)] = tensor
    return inner


def load_into(module: M, weights: Mapping[str, Tensor], where: str) -> M:
    """The module with these weights; a ``UserError`` if they do not fit it."""
    try:
        module.load_state_dict(weights)
    except RuntimeError as error:
        raise UserError(f"the weights do not fit the network ({error})", where, AGAIN) from None
    return module


def load_fitting(make: Callable[[], M], weights: Mapping[str, Tensor], where: str) -> M:
    """The module that ``make`` builds, with these weights; a ``UserError`` if they do not fit it."""
    import torch

    with torch.random.fork_rng(devices=[]):  # the first weights, which are replaced
        module = make()
    return load_into(module, weights, where)
