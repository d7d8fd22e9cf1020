"""Randomness is passed in: every consumer gets its own stream, named after its purpose."""

from __future__ import annotations

import zlib
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    import torch


def _sequence(seed: int, names: tuple[str | int, ...]) -> np.random.SeedSequence:
    keys = [int(seed)]
    for name in names:
        key = zlib.crc32(name.encode()) if isinstance(name, str) else name
        keys.append(int(key))
    return np.random.SeedSequence(keys)


def seed_for(seed: int, *names: str | int) -> int:
    """A 63-bit seed for the stream called ``names`` of run ``seed``."""
    state = _sequence(seed, names).generate_state(1, np.uint64)
    return int(state[0] >> 1)


def rng_for(seed: int, *names: str | int) -> np.random.Generator:
    """A NumPy generator for the stream called ``names`` of run ``seed``."""
    sequence = _sequence(seed, names)
    return np.random.default_rng(sequence)


def torch_generator(seed: int, *names: str | int) -> torch.Generator:
    """A torch CPU generator for the stream called ``names`` of run ``seed``."""
    import torch

    generator = torch.Generator()
    generator.manual_seed(seed_for(seed, *names))
    return generator


def global_state(device: torch.device) -> list[torch.Tensor]:
    """The states of torch's global generators (CPU and a CUDA ``device``), for code that cannot be passed another."""
    import torch

    states = [torch.get_rng_state()]
    if device.type == "cuda":
        states.append(torch.cuda.get_rng_state(device))
    return states


def restore_global(states: list[torch.Tensor], device: torch.device) -> None:
    """Restore torch's global generators to a :func:`global_state`."""
    import torch

    torch.set_rng_state(states[0])
    if device.type == "cuda":
        torch.cuda.set_rng_state(states[1], device)
