"""Weights on disk: safetensors only, no pickle is ever loaded (Spec G2)."""

from __future__ import annotations

import os
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, TypeVar

from hypogoal.core.artefacts import AGAIN as AGAIN
from hypogoal.core.errors import NumericalError, UserError
from hypogoal.core.files import open_file

if TYPE_CHECKING:
    from torch import Tensor, nn

    M = TypeVar("M", bound=nn.Module)

KEPT = frozenset(f"torch.{name}" for name in ("float32", "float64", "int64", "int32", "uint8", "bool"))
MAX_HEADER_BYTES = 16 * 2**20  # names and shapes take 100 bytes a tensor


def save_tensors(path: Path, tensors: dict[str, Tensor]) -> None:
    """Write tensors by name. NaN or Inf is a ``NumericalError`` and nothing is written (Spec G3).

    Types other than ``KEPT`` are a ``UserError``.
    """
    import torch
    from safetensors.torch import save

    check_types(tensors, path.stem, "Have the network keep its weights as float32.")
    for name, tensor in tensors.items():
        if tensor.dtype.is_floating_point and not torch.isfinite(tensor).all():
            raise NumericalError(f"the weight {name} of {path.stem} is NaN or Inf at the end of training")
    path.write_bytes(save({name: tensor.detach().cpu().contiguous() for name, tensor in tensors.items()}))


def load_tensors(path: Path, only: str | None = None) -> dict[str, Tensor]:
    """Read tensors by name, or ``only`` one; never more bytes than the file has, whatever its header declares.

    A file that is missing, truncated or not safetensors, types other than ``KEPT``, NaN and Inf are a ``UserError``.
    """
    import torch
    from safetensors import SafetensorError, safe_open

    with open_file(path, "the weights are", AGAIN) as file:
        header, size = int.from_bytes(file.read(8), "little"), file.seek(0, os.SEEK_END)
    if header > min(size - 8, MAX_HEADER_BYTES):
        raise UserError(f"the weights are damaged (a header of {header} bytes in a file of {size})", path, AGAIN)
    try:
        with safe_open(path, framework="pt") as weights:
            names = [name for name in weights.keys() if only in (None, name)]  # noqa: SIM118
            tensors: dict[str, Tensor] = {name: weights.get_tensor(name) for name in names}
    except (SafetensorError, ValueError, KeyError, TypeError, AttributeError) as error:
        raise UserError(f"the weights are damaged ({error})", path, AGAIN) from None
    check_types(tensors, path, AGAIN)
    for name, tensor in tensors.items():
        if tensor.dtype.is_floating_point and not torch.isfinite(tensor).all():
            raise UserError(f"the weights hold NaN or Inf (at {name})", path, AGAIN)
    return tensors


def check_types(tensors: Mapping[str, Tensor], where: object, do: str) -> None:
    """Refuse (``UserError``) types other than ``KEPT``: not all of them can be computed with or compared."""
    for name, tensor in tensors.items():
        if str(tensor.dtype) not in KEPT:
            raise UserError(f"weights of type {tensor.dtype} are not kept (at {name})", where, do)


def below(prefix: str, tensors: Mapping[str, Tensor]) -> dict[str, Tensor]:
    """The tensors whose names begin with a prefix, by the rest of the name."""
    return {name[len(prefix) :]: value for name, value in tensors.items() if name.startswith(prefix)}


def check_fit(expected: Mapping[str, Tensor], weights: Mapping[str, Tensor], where: object, do: str) -> None:
    """Refuse (``UserError``) weights that differ from a network's in name, shape or dtype."""
    for name in sorted({*expected, *weights}):
        target, source = expected.get(name), weights.get(name)
        if target is None or source is None or target.shape != source.shape or target.dtype != source.dtype:
            raise UserError(f"the weights do not fit the network (at {name})", where, do)


def load_fitting(make: Callable[[], M], weights: Mapping[str, Tensor], where: object, *, custom: bool = False) -> M:
    """The module built by ``make``, with these weights; a ``UserError`` if they do not fit it or it cannot be built.

    Nothing is allocated before the weights are known to fit, unless the network is ``custom``, the user's code, which
    may need real numbers.
    """
    import torch

    try:
        # Shapes without numbers: a manifest may ask for a network a thousand times too large.
        with torch.device("cpu" if custom else "meta"):
            module = make()
    except (RuntimeError, ValueError, TypeError, ZeroDivisionError, OverflowError):
        raise UserError("the weights do not fit the manifest", where, AGAIN) from None
    check_fit(module.state_dict(), weights, where, AGAIN)
    if custom:
        module.load_state_dict(weights)
    else:
        module.load_state_dict({name: tensor.clone() for name, tensor in weights.items()}, assign=True)
    return module
