"""Weights on disk, as safetensors only: no pickle is ever loaded."""

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
    """Return tensors or arrays by name as the bytes of a file. Raises ``NumericalError`` for NaN or Inf."""
    import torch
    from safetensors.torch import save

    weights = {}
    for name, values in tensors.items():
        tensor = torch.as_tensor(values)
        if not tensor.isfinite().all():
            raise NumericalError(f"the weight {name} of {owner} is NaN or Inf; a mask of these needs persistent=False")
        # Cloned, because safetensors would refuse a weight that two layers share.
        weights[name] = tensor.detach().cpu().clone(memory_format=torch.contiguous_format)
    return save(weights)


def save_tensors(path: Path, tensors: Mapping[str, Any]) -> None:
    """Write tensors or arrays by name as :func:`stored` gives them. Nothing is written if :func:`stored` raises."""
    path.write_bytes(stored(tensors, path.stem))


def load_tensors(path: Path) -> dict[str, Tensor]:
    """Return the tensors of a file by name. Raises ``UserError`` if the file is missing, cut, or not safetensors."""
    from safetensors.torch import load_file

    with reading(path, AGAIN, "the weights"):
        return load_file(path)


def below(prefix: str, tensors: Mapping[str, Tensor]) -> dict[str, Tensor]:
    """Return the tensors whose names begin with a prefix, by the rest of the name."""
    inner = {}
    for name, tensor in tensors.items():
        if name.startswith(prefix):
            inner[name.removeprefix(prefix)] = tensor
    return inner


def load_into(module: M, weights: Mapping[str, Tensor], where: str) -> M:
    """Load weights into a module, and return the module. Raises ``UserError`` if the weights do not fit."""
    try:
        module.load_state_dict(weights)
    except RuntimeError as error:
        raise UserError(f"the weights do not fit the network ({error})", where, AGAIN) from None
    return module


def load_fitting(make: Callable[[], M], weights: Mapping[str, Tensor], where: str) -> M:
    """Return the module that ``make`` builds, with ``weights``. Raises ``UserError`` if the weights do not fit."""
    import torch

    with torch.random.fork_rng(devices=[]):  # so that drawing the first weights, which are replaced, has no effect
        module = make()
    return load_into(module, weights, where)
