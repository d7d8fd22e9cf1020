"""Prioritised experience replay (Schaul et al. 2015) over integer state ids, of transitions over one or several steps.

A transition costs bytes, not images.
"""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Any, Generic, TypeVar

import numpy as np
from numpy.typing import NDArray

from hypogoal.core.arrays import Columns
from hypogoal.core.checkpoints import Resumable

FAN = 64  # children of a node: 1e5 leaves are three levels, and NumPy's cost is by the call
Rows = TypeVar("Rows", bound=Columns)


@dataclass(frozen=True)
class Steps(Columns):
    """Steps of sequences, or transitions over several of these."""

    state: NDArray[np.int32]  # ids
    action: NDArray[np.int16]
    next_state: NDArray[np.int32]  # ids
    steps: NDArray[np.int16]  # from state to next_state


Joined = TypeVar("Joined", bound=Steps)


class SumTree:
    """Priorities whose prefix sums are found in a few steps, for many indices at once."""

    def __init__(self, capacity: int):
        self.levels = [np.zeros(-(-capacity // FAN) * FAN)]  # leaves first; each level in whole families
        while len(self.levels[-1]) > FAN:
            families = len(self.levels[-1]) // FAN
            self.levels.append(np.zeros(-(-families // FAN) * FAN))

    @property
    def total(self) -> float:
        """The sum of all priorities."""
        return float(self.levels[-1].sum())

    def get(self, indices: NDArray[np.int64]) -> NDArray[np.float64]:
        """The priorities at ``indices``."""
        return self.levels[0][indices]

    def set(self, indices: NDArray[np.int64], priorities: NDArray[np.float64]) -> None:
        """Write priorities (the last one wins where an index repeats) and mend the sums above them."""
        self.levels[0][indices] = priorities
        for below, above in pairwise(self.levels):
            indices = indices // FAN  # repeated parents get the same sum twice, which is cheaper than finding them
            above[indices] = below.reshape(-1, FAN)[indices].sum(axis=1)

    def find(self, sums: NDArray[np.float64]) -> NDArray[np.int64]:
        """For each prefix sum in [0, total) the leaf it falls on."""
        places = np.zeros(len(sums), dtype=np.int64)
        rows = np.arange(len(sums))
        rest = sums.copy()
        before = np.zeros((len(sums), FAN + 1))  # the sum of the children before each
        for level in reversed(self.levels):
            children = level.reshape(-1, FAN)[places]
            np.cumsum(children, axis=1, out=before[:, 1:])
            child = (before[:, 1:] <= rest[:, None]).sum(axis=1)
            # Rounding may leave a sum beyond the last child that has any: stay with that one.
            child = np.minimum(child, FAN - 1 - (children[:, ::-1] > 0).argmax(axis=1))
            rest -= before[rows, child]
            places = places * FAN + child
        return places


class PrioritisedReplay(Resumable, Generic[Rows]):
    """A ring of transitions (Tables 2 and 4: 1e5), sampled in proportion to priority ** alpha.

    ``kind`` is the class of what is stored, ``data``. An ``alpha`` of 0 samples uniformly, 1 in full proportion;
    ``beta`` is the strength of the importance weights that correct for it. Source of both: Schaul et al. 2015.
    """

    def __init__(self, capacity: int, kind: type[Rows], *, alpha: float = 0.6, beta: float = 0.4):
        self.capacity, self.alpha, self.beta = capacity, alpha, beta
        self.data = kind.zeros(capacity)
        self.tree = SumTree(capacity)
        self.size = self._next = 0
        self._largest = 1.0

    def add(self, rows: Rows) -> NDArray[np.int64]:
        """Append n transitions with the largest priority seen; returns their indices, int64 (n,)."""
        count = len(rows)
        if not count:
            return np.empty(0, dtype=np.int64)
        indices = (self._next + np.arange(count)) % self.capacity
        self.data.put(indices, rows)
        self.tree.set(indices, np.full(count, self._largest**self.alpha))
        self._next = int((self._next + count) % self.capacity)
        self.size = min(self.size + count, self.capacity)
        return indices

    def sample(self, count: int, rng: np.random.Generator) -> tuple[NDArray[np.int64], NDArray[np.float32]]:
        """Stratified in proportion to priority: indices and importance weights (count,), the largest of these 1."""
        total = self.tree.total
        sums = (np.arange(count) + rng.random(count)) * (total / count)
        indices = np.minimum(self.tree.find(np.minimum(sums, np.nextafter(total, 0))), self.size - 1)
        share = self.tree.get(indices) / total
        weights = (self.size * np.maximum(share, 1e-12)) ** -self.beta
        return indices, (weights / weights.max()).astype(np.float32)

    def set_priorities(self, indices: NDArray[np.int64], priorities: NDArray[np.float64]) -> None:
        """New priorities (absolute TD errors) of sampled transitions."""
        priorities = np.asarray(priorities, dtype=np.float64) + 1e-3
        self._largest = max(self._largest, float(priorities.max()))
        self.tree.set(indices, priorities**self.alpha)

    def snapshot(self) -> dict[str, Any]:
        return {
            "data": {name: values[: self.size].copy() for name, values in vars(self.data).items()},
            "priorities": self.tree.get(np.arange(self.size)),
            "largest": self._largest,
            "next": self._next,
        }

    def restore(self, snapshot: Mapping[str, Any]) -> None:
        """Continue, on a fresh replay, from a ``snapshot`` of one of the same capacity and fields."""
        self.size = len(snapshot["priorities"])
        for name, values in snapshot["data"].items():
            getattr(self.data, name)[: self.size] = values
        if self.size:
            self.tree.set(np.arange(self.size), snapshot["priorities"])
        self._largest, self._next = snapshot["largest"], snapshot["next"]


class StepsAhead(Resumable):
    """Joins the steps of many sequences played side by side into transitions over up to n steps.

    A transition from a step reaches n steps on, or to the sequence's end where that comes sooner; never beyond.
    """

    CHANGING = ("_open",)

    def __init__(self, sequences: int, n: int):
        self.n = n
        self._open: list[list[tuple[int, int]]] = [[] for _ in range(sequences)]

    def add(self, rows: Joined, ended: NDArray[np.bool_]) -> Joined:
        """One step of every sequence, and which sequences end with it, bool (E,); returns the transitions now complete.

        A transition has ``state`` and ``action`` of its first step, and all else of its last.
        """
        if self.n == 1:
            return rows
        complete: list[tuple[int, int, int, int]] = []  # sequence, state, action, steps
        for e, steps in enumerate(self._open):
            steps.append((int(rows.state[e]), int(rows.action[e])))
            if ended[e]:
                complete.extend((e, *first, len(steps) - place) for place, first in enumerate(steps))
                steps.clear()
            elif len(steps) == self.n:
                complete.append((e, *steps.pop(0), self.n))
        sequence, state, action, count = np.array(complete, dtype=np.int64).reshape(-1, 4).T
        return replace(
            rows.at(sequence),
            state=state.astype(np.int32),
            action=action.astype(np.int16),
            steps=count.astype(np.int16),
        )
