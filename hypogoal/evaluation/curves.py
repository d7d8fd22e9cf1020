"""From the list of episodes to curves over environment steps and the numbers read off them (Spec F5)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

WINDOW = 100  # episodes
SOLVED = 0.95  # share of the window's episodes
FIRST = 20  # episodes that a curve begins with: of many parallel ones, the first to end are the lucky ones
GAMMA = 0.99  # per environment step, of the discounted return


@dataclass(frozen=True)
class Episodes:
    """A run's training episodes in the order in which they ended; arrays (n,).

    Attributes:
        step: environment steps when it ended, summed over parallel environments and stages.
        length: steps.
        reward: undiscounted.
        terminated: it reached a terminal state; else it was cut at the cap.
    """

    step: NDArray[np.int64]
    length: NDArray[np.int64]
    reward: NDArray[np.float64]
    terminated: NDArray[np.bool_]

    @property
    def succeeded(self) -> NDArray[np.bool_]:
        """Spec F5: it terminated, and with a reward: an agent that dies reaches a terminal state too."""
        return self.terminated & (self.reward > 0)

    def last(self, count: int = WINDOW) -> Episodes:
        """The last ``count`` episodes, or all where there are fewer."""
        start = max(0, len(self.step) - count)
        return Episodes(self.step[start:], self.length[start:], self.reward[start:], self.terminated[start:])


def trailing_mean(
    steps: NDArray[np.int64], values: NDArray[np.float64], grid: NDArray[np.int64], window: int = WINDOW, least: int = 1
) -> NDArray[np.float64]:
    """Spec F5: at each grid point the mean of the last ``window`` values that were known by then.

    Args:
        steps: int (n,), when each value came, ascending.
        values: (n,).
        grid: int (G,).
        window: values; fewer are averaged at the beginning.
        least: values below which there is no mean.

    Returns:
        float64 (G,), NaN where fewer than ``least`` values are known.
    """
    sums = np.concatenate([[0.0], np.cumsum(values, dtype=np.float64)])
    end = np.searchsorted(steps, grid, side="right")
    start = np.maximum(0, end - window)
    counts = end - start
    return np.where(counts >= max(1, least), (sums[end] - sums[start]) / np.maximum(counts, 1), np.nan)


def curves(episodes: Episodes, grid: NDArray[np.int64], window: int = WINDOW) -> dict[str, NDArray[np.float64]]:
    """Figure 6: reward, success and length over environment steps, each float64 (G,), see :func:`trailing_mean`."""
    return {
        "reward": trailing_mean(episodes.step, episodes.reward, grid, window, FIRST),
        "success": trailing_mean(episodes.step, episodes.succeeded.astype(np.float64), grid, window, FIRST),
        "length": trailing_mean(episodes.step, episodes.length.astype(np.float64), grid, window, FIRST),
    }


def steps_to_solve(episodes: Episodes, window: int = WINDOW, share: float = SOLVED) -> int | None:
    """Spec F5: the first step at which ``share`` of the last ``window`` episodes succeeded; None: never, or too few."""
    if len(episodes.step) < window:
        return None
    sums = np.concatenate([[0], np.cumsum(episodes.succeeded.astype(np.int64))])
    recent = sums[window:] - sums[:-window]
    reached = np.flatnonzero(recent >= share * window)
    return int(episodes.step[reached[0] + window - 1]) if len(reached) else None


def discounted_return(episodes: Episodes, gamma: float = GAMMA) -> float:
    """Spec F5: mean of gamma ** (length - 1) * reward, for tasks whose reward comes last; NaN without episodes.

    Unlike success at a cap of 500 steps it tells a short way to the goal from a long one.
    """
    if len(episodes.step) == 0:
        return float("nan")
    return float((gamma ** (episodes.length - 1.0) * episodes.reward).mean())


def run_numbers(episodes: Episodes, shortest_path: int | None, window: int = WINDOW) -> dict[str, float | int | None]:
    """Spec F5: what is said of one run.

    Args:
        episodes: all of its training episodes.
        shortest_path: primitive steps from the start to the goal at least; None where not known.
        window: episodes that the numbers at the end are taken over.

    Returns:
        episodes, window (episodes actually averaged), success, reward, length, length_over_shortest (ratio),
        discounted_return over the last episodes, and steps_to_95; NaN where there is no episode.
    """
    last = episodes.last(window)
    count = len(last.step)
    length = float(last.length.mean()) if count else float("nan")
    return {
        "episodes": len(episodes.step),
        "window": count,
        "success": float(last.succeeded.mean()) if count else float("nan"),
        "reward": float(last.reward.mean()) if count else float("nan"),
        "length": length,
        "length_over_shortest": length / shortest_path if shortest_path else float("nan"),
        "discounted_return": discounted_return(last),
        "steps_to_95": steps_to_solve(episodes, window),
    }
