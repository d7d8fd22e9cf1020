"""What happened while options were played: episodes, choices and where options stopped (Spec E5, F5, F6)."""

from __future__ import annotations

import csv
from collections import deque
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

STOPS_KEPT = 128  # per option
EPISODE_COLUMNS = ("step", "length", "reward", "terminated")
CHOICE_COLUMNS = ("step", "option", "offered", "chosen", "expected", "reached", "duration")


class Recorder:
    """Counts choices per window of steps, lists episodes, keeps the last stops of each option.

    Args:
        options: the number of options, O.
        window: steps per row of ``choices.csv``.
    """

    def __init__(self, options: int, window: int = 5_000):
        self.options, self.window = options, window
        self.steps = self._window_start = 0
        self.episodes: list[tuple[int, int, float, int]] = []
        self.choices: list[tuple[int, int, int, int, float, int, int]] = []
        self.stops: list[deque[int]] = [deque(maxlen=STOPS_KEPT) for _ in range(options)]
        self._clear()

    def start_at(self, steps: int) -> None:
        """Environment steps spent before (those of ``train-options``) count in every curve."""
        self.steps = self._window_start = steps

    def _clear(self) -> None:
        self._offered = np.zeros(self.options, dtype=np.int64)
        self._chosen = np.zeros(self.options, dtype=np.int64)
        self._expected = np.zeros(self.options)
        self._reached = np.zeros(self.options, dtype=np.int64)
        self._duration = np.zeros(self.options, dtype=np.int64)

    def chose(self, options: NDArray[np.int64], offered: NDArray[np.bool_]) -> None:
        """Decisions: the options chosen (n,) among those offered, bool (n, O)."""
        if self.steps - self._window_start >= self.window:
            self.flush()
        self._offered += offered.sum(0)
        self._expected += (offered / offered.sum(1, keepdims=True)).sum(0)
        np.add.at(self._chosen, options, 1)

    def finished(
        self,
        options: NDArray[np.int64],
        durations: NDArray[np.int64],
        reached: NDArray[np.bool_],
        ids: NDArray[np.int64],
    ) -> None:
        """Executions that ended, in states ``ids``; arrays (n,)."""
        np.add.at(self._duration, options, durations)
        np.add.at(self._reached, options, reached)
        for option, identity in zip(options[reached], ids[reached], strict=True):
            self.stops[option].append(int(identity))

    def episode(self, length: int, reward: float, terminated: bool) -> None:
        """An episode ended now."""
        self.episodes.append((self.steps, length, reward, int(terminated)))

    def success(self, last: int = 100) -> float:
        """Share of the last episodes that reached a terminal state; NaN before the first."""
        tail = self.episodes[-last:]
        return sum(row[3] for row in tail) / len(tail) if tail else float("nan")

    def length(self, last: int = 100) -> float:
        """Mean steps of the last episodes; NaN before the first."""
        tail = self.episodes[-last:]
        return sum(row[1] for row in tail) / len(tail) if tail else float("nan")

    def flush(self) -> None:
        """Close the current window of choices."""
        for option in range(self.options):
            self.choices.append(
                (
                    self.steps,
                    option,
                    int(self._offered[option]),
                    int(self._chosen[option]),
                    round(float(self._expected[option]), 6),
                    int(self._reached[option]),
                    int(self._duration[option]),
                )
            )
        self._window_start = self.steps
        self._clear()

    def write(self, folder: Path, images: Callable[[NDArray[np.int64]], NDArray[np.uint8]]) -> None:
        """``episodes.csv``, ``choices.csv`` and ``terminations.h5`` into ``folder``."""
        import h5py

        self.flush()
        write_table(folder / "episodes.csv", EPISODE_COLUMNS, self.episodes)
        write_table(folder / "choices.csv", CHOICE_COLUMNS, self.choices)
        with h5py.File(folder / "terminations.h5", "w") as file:
            for option, stops in enumerate(self.stops):
                if stops:
                    states = images(np.array(stops, dtype=np.int64))
                    file.create_dataset(str(option), data=states, compression="gzip", compression_opts=1)


def write_table(path: Path, columns: tuple[str, ...], rows: Sequence[tuple[int | float, ...]]) -> None:
    """A CSV file with a header."""
    with path.open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file)
        writer.writerow(columns)
        writer.writerows(rows)
