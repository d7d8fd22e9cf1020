"""Prioritised experience replay (Schaul et al. 2015) over integer state ids, of transitions over one or several steps.

A transition costs bytes, not images.
"""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any, Generic, TypeVar

import numpy as np
from numpy.typing import NDArray

from hypogoal.core.arrays import Columns
from hypogoal.core.checkpoints import Resumable, State

Rows = TypeVar("Rows", bound=Columns)


@dataclass(frozen=True)
class Steps(Columns):
    """Steps of sequences, or transitions over several of these."""

    state: NDArray[np.int32]  # ids
    action: NDArray[np.int16]
    next_state: NDArray[np.int32]  # ids
    steps: NDArray[np.int16]  # from state to next_state


Joined = TypeVar("Joined", bound=Steps)


class PrioritisedReplay(Resumable, Generic[Rows]):
    """A ring of transitions (Tables 2 and 4: 1e5), sampled in proportion to priority ** alpha.

    What is stored is written into ``data``, rows of zeros, as many as there is room for. An ``alpha`` of 0 samples
    uniformly, 1 in full proportion; ``beta`` is the strength of the importance weights that correct for it. Source of
    both: Schaul et al. 2015.
    """

    CHANGING = ("size", "next", "largest")  # and the rows stored

    def __init__(
        self,
        data: Rows,
        *,
        alpha: float = 0.6,
        beta: float = 0.4,
    ):
        self.data = data
        self.capacity = len(data)
        self.alpha = alpha
        self.beta = beta
        self.priorities = np.zeros(len(data))  # to the power alpha
        self.size = 0
        self.next = 0
        self.largest = 1.0  # priority so far

    def add(self, rows: Rows) -> None:
        """Append n transitions with the largest priority so far."""
        count = len(rows)
        indices = (self.next + np.arange(count)) % self.capacity
        self.data.put(indices, rows)
        self.priorities[indices] = self.largest**self.alpha
        self.next = (self.next + count) % self.capacity
        self.size = min(self.size + count, self.capacity)

    def sample(self, count: int, rng: np.random.Generator) -> tuple[NDArray[np.int64], NDArray[np.float32]]:
        """Stratified in proportion to priority: indices and importance weights (count,), the largest of these 1."""
        priorities = self.priorities[: self.size]
        sums = priorities.cumsum()
        total = sums[-1]
        drawn = (np.arange(count) + rng.random(count)) * (total / count)
        drawn = np.minimum(drawn, np.nextafter(total, 0))
        indices = np.searchsorted(sums, drawn, side="right")
        shares = priorities[indices] / total
        weights = (self.size * shares) ** -self.beta
        return indices, (weights / weights.max()).astype(np.float32)

    def set_priorities(self, indices: NDArray[np.int64], errors: NDArray[np.floating]) -> None:
        """New priorities of sampled transitions: their absolute TD errors (n,)."""
        priorities = errors.astype(np.float64) + 1e-3
        self.largest = max(self.largest, float(priorities.max()))
        self.priorities[indices] = priorities**self.alpha

    def snapshot(self) -> State:
        rows = slice(self.size)
        return {
            **super().snapshot(),
            "data": self.data.at(rows).snapshot(),
            "priorities": self.priorities[rows].copy(),
        }

    def restore(self, snapshot: Mapping[str, Any]) -> None:
        """Continue, on a fresh replay, from a ``snapshot`` of one of the same capacity and fields."""
        super().restore(snapshot)
        rows = slice(self.size)
        self.data.put(rows, type(self.data)(**snapshot["data"]))
        self.priorities[rows] = snapshot["priorities"]


class StepsAhead(Resumable):
    """Joins the steps of many sequences played side by side into transitions over up to n steps.

    A transition from a step reaches n steps on, or to the sequence's end where that comes sooner; never beyond.
    """

    CHANGING = ("open",)

    def __init__(self, sequences: int, n: int):
        self.n = n
        self.open: list[list[tuple[int, int]]] = [[] for _ in range(sequences)]  # states and actions

    def add(self, rows: Joined, ended: NDArray[np.bool_]) -> Joined:
        """One step of every sequence, and which sequences end with it, bool (E,); returns the transitions now complete.

        A transition has ``state`` and ``action`` of its first step, and all else of its last.
        """
        if self.n == 1:
            return rows
        complete: list[tuple[int, int, int, int]] = []  # sequence, steps, state, action
        for sequence, steps in enumerate(self.open):
            state, action = int(rows.state[sequence]), int(rows.action[sequence])
            steps.append((state, action))
            while steps and (ended[sequence] or len(steps) == self.n):
                complete.append((sequence, len(steps), *steps.pop(0)))
        sequences, counts, states, actions = np.array(complete, dtype=np.int64).reshape(-1, 4).T
        return replace(
            rows.at(sequences),
            state=states.astype(np.int32),
            action=actions.astype(np.int16),
            steps=counts.astype(np.int16),
        )
