"""Prioritised experience replay (Schaul et al. 2015), of transitions over one or several steps.

Transitions hold integer state ids, so a transition costs bytes, not images.
"""

from dataclasses import dataclass, replace
from typing import Generic, TypeVar

import numpy as np

from hypogoal.core.arrays import Bools, Columns, Floats, Ints
from hypogoal.core.checkpoints import Resumable

ALPHA = 0.6  # 0 samples uniformly, 1 in full proportion to priority. Source: Schaul et al. 2015
BETA = 0.4  # how far importance weights correct for the priorities. Source: Schaul et al. 2015
Rows = TypeVar("Rows", bound=Columns)


@dataclass(frozen=True)
class Steps(Columns):
    """Steps of sequences, or transitions over several steps, as arrays (n,)."""

    state: Ints  # ids
    action: Ints
    next_state: Ints  # ids
    steps: Ints  # the number of steps from state to next_state


Joined = TypeVar("Joined", bound=Steps)


class PrioritisedReplay(Resumable, Generic[Rows]):
    """A ring of transitions, sampled in proportion to priority ** alpha. In Tables 2 and 4, its length is 1e5.

    ``data`` are the ring's rows, at first of zeros. Transitions are written into ``data``.
    """

    CHANGING = ("data", "priorities", "size", "next", "largest")

    def __init__(self, data: Rows):
        self.data = data
        self.capacity = len(data)
        self.priorities = np.zeros(len(data))  # priority ** alpha of each row
        self.size = 0
        self.next = 0
        self.largest = 1.0  # the largest priority so far

    def add(self, rows: Rows) -> None:
        """Append n transitions with the largest priority so far."""
        count = len(rows)
        indices = (self.next + np.arange(count)) % self.capacity
        self.data.put(indices, rows)
        self.priorities[indices] = self.largest**ALPHA
        self.next = (self.next + count) % self.capacity
        self.size = min(self.size + count, self.capacity)

    def sample(self, count: int, rng: np.random.Generator) -> tuple[Ints, Floats]:
        """Draw ``count`` indices, int64 (count,), by stratified sampling in proportion to priority.

        Also returns importance weights, float32 (count,), scaled so that the largest weight is 1.
        """
        priorities = self.priorities[: self.size]
        sums = priorities.cumsum()
        total = sums[-1]
        strata = np.arange(count) + rng.random(count)
        drawn = strata * (total / count)
        drawn = np.minimum(drawn, np.nextafter(total, 0))
        indices = np.searchsorted(
            sums,
            drawn,
            side="right",
        )
        shares = priorities[indices] / total
        weights = (self.size * shares) ** -BETA
        weights /= weights.max()
        return indices, weights.astype(np.float32)

    def set_priorities(self, indices: Ints, errors: Floats) -> None:
        """Set the priorities of sampled transitions to their absolute TD errors (n,)."""
        priorities = errors.astype(float) + 1e-3
        self.largest = max(self.largest, float(priorities.max()))
        self.priorities[indices] = priorities**ALPHA


class StepsAhead(Resumable):
    """What joins the steps of sequences that are played side by side into transitions over up to n steps.

    A transition reaches n steps on, or to the sequence's end if that comes sooner.
    """

    CHANGING = ("open",)

    def __init__(self, sequences: int, n: int):
        self.n = n
        self.open: list[list[tuple[int, int]]] = [[] for _ in range(sequences)]  # states and actions of each sequence

    def add(self, rows: Joined, ended: Bools) -> Joined:
        """Take one step of every sequence, and return the transitions that are now complete.

        ``ended``, bool (E,), says which sequences end with the step. A transition has ``state`` and ``action`` of its
        first step, and all else of its last step.
        """
        if self.n == 1:
            return rows
        complete = []  # rows of sequence, steps, state, action
        for sequence, steps in enumerate(self.open):
            now = rows.at(sequence)
            steps.append((now.state.item(), now.action.item()))
            while steps and (ended[sequence] or len(steps) == self.n):
                count = len(steps)
                first = steps.pop(0)
                complete.append((sequence, count, *first))
        columns = np.array(complete, int).reshape(-1, 4).T
        sequences, counts, states, actions = columns
        return replace(
            rows.at(sequences),
            state=states,
            action=actions,
            steps=counts,
        )
