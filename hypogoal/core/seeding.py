"""Randomness is passed in: every consumer gets its own stream, named after its purpose."""

from __future__ import annotations

import contextlib
import zlib
from collections.abc import Iterator
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


@contextlib.contextmanager
def drawing_from(generator: torch.Generator) -> Iterator[None]:
    """What is drawn from torch's global generator comes from this one: modules cannot be passed any for their weights.

    Afterwards the global one is as it was.
    """
    import torch

    with torch.random.fork_rng(devices=[]):
        torch.set_rng_state(generator.get_state())
        yield
        generator.set_state(torch.get_rng_state())
