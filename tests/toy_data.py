"""A small data file in the real format."""

from pathlib import Path

import numpy as np

from hypogoal.dataset import Collected, States, write_dataset

SHAPE = (4, 5, 3)


def write(path: Path, states: int = 7, domain: str = "toy") -> Path:
    """Two sub-goals, three sets of random states; ``path``."""
    rng = np.random.default_rng(0)

    def some(count: int) -> States:
        images = rng.integers(0, 256, size=(count, *SHAPE), dtype=np.uint8)
        return States(images, rng.random((count, 2)) < 0.5, {"layout_seed": np.arange(count)})

    collected = Collected(SHAPE, ("one", "two"), some(states), some(states), some(states))
    write_dataset(path, collected, domain=domain, config={"a": 1}, seed=3)
    return path
