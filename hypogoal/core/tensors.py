"""Weights on disk: safetensors only, no pickle is ever loaded (Spec G2)."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from hypogoal.core.errors import UserError

if TYPE_CHECKING:
    from torch import Tensor


def save_tensors(path: Path, tensors: dict[str, Tensor]) -> None:
    """Write tensors by name."""
    from safetensors.torch import save_file

    save_file({name: tensor.detach().cpu().contiguous() for name, tensor in tensors.items()}, path)


def load_tensors(path: Path) -> dict[str, Tensor]:
    """Read tensors by name.

    Raises:
        UserError: missing, truncated or not safetensors.
    """
    from safetensors import SafetensorError
    from safetensors.torch import load_file

    if not path.is_file():
        raise UserError("the weights are missing", path, "Make the artefact again.")
    try:
        return load_file(path)
    except SafetensorError as error:
        raise UserError(f"the weights are damaged ({error})", path, "Make the artefact again.") from None
