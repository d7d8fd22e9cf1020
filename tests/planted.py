"""DoorKey with fifteen planted hypotheses whose worth is known, in a world where a wrong key ends the episode."""

import numpy as np
from numpy.typing import NDArray

from hypogoal.domains.doorkey.engine import DoorKeyEngine
from hypogoal.domains.doorkey.env import make_layout
from hypogoal.options.termination import Terminations


def planted(engine: DoorKeyEngine) -> Terminations:
    """Fifteen hypotheses that agree where the agent holds one key at a time, in the order blue, green, red, on one
    layout: keys by colour, by the cell that is empty, by how many are gone; wrong doors and wrong goals.
    """
    layout = make_layout(engine.layouts.seeds[0])
    cells = np.array(layout.keys)[[1, 2, 0]]  # each key's "own" cell is another's

    def classify(ids: NDArray[np.int64]) -> NDArray[np.bool_]:
        labels, origins = engine.labels(ids), engine.origins(ids)
        empty = ~((engine.codes(ids)[:, cells] >= 3) & (engine.codes(ids)[:, cells] < 6))
        gone = labels[:, :3].sum(axis=1)[:, None] > np.arange(3)
        x, y = origins["agent_x"], origins["agent_y"]
        near_door = np.abs(y * 8 + x - layout.door) == 1
        columns = [np.stack([labels[:, key], empty[:, key], gone[:, key]], axis=1) for key in range(3)]
        columns.append(np.stack([labels[:, 3], near_door, labels[:, 2]], axis=1))
        columns.append(np.stack([labels[:, 4], (x == 1) & (y == 1), (x == 1) & (y == 6)], axis=1))
        return np.concatenate(columns, axis=1)

    return Terminations.of_predictions(classify, 15)


def harsh(layout_seed: int, count: int) -> DoorKeyEngine:
    """A wrong key ends the episode, and so do three times as many steps as it takes."""
    engine = DoorKeyEngine(layout_seed, count, wrong_key="ends")
    shortest = engine.shortest_path()
    assert shortest is not None
    engine.max_steps = 3 * shortest
    return engine
