"""Random streams: randomness is passed in, and every consumer gets its own stream, named after its purpose.

Names of 0 at a stream's end make no difference, because NumPy pads what it is given with zeros: ``seed_for(0, "x")`` is
``seed_for(0, "x", 0)``. No two streams in use differ by such a name alone. This behaviour is kept, because other seeds
would give other results.
"""

from __future__ import annotations

import zlib
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    import torch


def _sequence(seed: int, names: tuple[str | int, ...]) -> np.random.SeedSequence:
    keys = [int(seed)]
    for name in names:
        if isinstance(name, str):
            name = zlib.crc32(name.encode())
        keys.append(int(name))
    return np.random.SeedSequence(keys)


def seed_for(seed: int, *names: str | int) -> int:
    """Return a 63-bit seed for the stream called ``names`` of run ``seed``."""
    sequence = _sequence(seed, names)
    state = sequence.generate_state(1, np.uint64)
    return int(state[0] >> 1)


def rng_for(seed: int, *names: str | int) -> np.random.Generator:
    """Return a NumPy generator for the stream called ``names`` of run ``seed``."""
    sequence = _sequence(seed, names)
    return np.random.default_rng(sequence)


def torch_generator(seed: int, *names: str | int) -> torch.Generator:
    """Return a torch CPU generator for the stream called ``names`` of run ``seed``."""
    import torch

    generator = torch.Generator()
    return generator.manual_seed(seed_for(seed, *names))
