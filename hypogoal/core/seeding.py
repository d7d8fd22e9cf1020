"""Randomness is passed in: every consumer gets its own stream, named after its purpose."""

from __future__ import annotations

import zlib
from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    import torch


def _sequence(seed: int, names: tuple[str | int, ...]) -> np.random.SeedSequence:
    keys = [zlib.crc32(name.encode()) if isinstance(name, str) else int(name) for name in names]
    return np.random.SeedSequence([int(seed), *keys])


def seed_for(seed: int, *names: str | int) -> int:
    """A 63-bit seed for the stream called ``names`` of run ``seed``."""
    return int(_sequence(seed, names).generate_state(1, np.uint64)[0] >> 1)


def rng_for(seed: int, *names: str | int) -> np.random.Generator:
    """A NumPy generator for the stream called ``names`` of run ``seed``."""
    return np.random.default_rng(_sequence(seed, names))


def torch_generator(seed: int, *names: str | int) -> torch.Generator:
    """A torch CPU generator for the stream called ``names`` of run ``seed``."""
    import torch

    generator = torch.Generator()
    generator.manual_seed(seed_for(seed, *names))
    return generator


def global_state(device: torch.device) -> list[torch.Tensor]:
    """The states of torch's global generators (CPU and a CUDA ``device``), for code that cannot be passed another."""
    import torch

    return [torch.get_rng_state(), *([torch.cuda.get_rng_state(device)] if device.type == "cuda" else [])]


def restore_global(state: Sequence[torch.Tensor], device: torch.device) -> None:
    """Restore torch's global generators to a :func:`global_state`."""
    import torch

    torch.set_rng_state(state[0])
    if device.type == "cuda":
        torch.cuda.set_rng_state(state[1], device)
