"""What happened while options were played: episodes, choices, where options stopped (Spec E5, F3, F4, F5, F6)."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from hypogoal.core.files import write_table
from hypogoal.core.hdf5 import create_hdf5
from hypogoal.domains.base import Engine

STOPS_KEPT = 128  # per option
EXECUTIONS_KEPT = 100  # per option: Spec F3
EPISODE_COLUMNS = ("step", "length", "reward", "terminated")
CHOICE_COLUMNS = ("step", "option", "offered", "chosen", "expected", "reached", "duration")


class Execution(NamedTuple):
    """One option from its beginning to its end.

    Attributes:
        step: when it ended.
        option: g*K + k.
        duration: its steps.
        reached: its own classifier ended it.
        inside_at_start: its own classifier said yes where it began.
        terminated: it ended in a terminal state of the episode.
        state: the id of the state it ended in.
    """

    step: int
    option: int
    duration: int
    reached: bool
    inside_at_start: bool
    terminated: bool
    state: int


EXECUTION_COLUMNS = (*Execution._fields[:-1], "room", "x", "y", "distance")


class Recorder:
    """Counts choices per window of steps, lists episodes, keeps the last executions and stops of each option.

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
        self.executions: list[deque[Execution]] = [deque(maxlen=EXECUTIONS_KEPT) for _ in range(options)]
        self._pictures: list[deque[NDArray[np.uint8]]] = [deque(maxlen=STOPS_KEPT) for _ in range(options)]
        self._forgetful: Engine | None = None
        self._clear()

    def watch(self, engine: Engine) -> None:
        """Where it is played: of an engine that forgets states, stops are kept as pictures."""
        self._forgetful = engine if engine.memory is not None else None

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
        *,
        inside: NDArray[np.bool_],
        terminated: NDArray[np.bool_],
        counts: NDArray[np.bool_],
    ) -> None:
        """Executions that ended; arrays (n,).

        Args:
            options, durations, reached: see :class:`Execution`.
            ids: the states they ended in.
            inside: their own sub-goal held where they began.
            terminated: the episode ended in a terminal state.
            counts: they belong to ``executions``, because they began where the domain says they should.
        """
        np.add.at(self._duration, options, durations)
        np.add.at(self._reached, options, reached)
        columns = (options, durations, reached, inside, terminated, ids)
        for row in zip(*(values[counts].tolist() for values in columns), strict=True):
            self.executions[row[0]].append(Execution(self.steps, *row))
        for option, identity in zip(options[reached], ids[reached], strict=True):
            self.stops[option].append(int(identity))
        if self._forgetful and reached.any():
            pictures = self._forgetful.images(ids[reached])
            for option, picture in zip(options[reached], pictures, strict=True):
                self._pictures[option].append(picture)

    def episode(self, length: int, reward: float, terminated: bool) -> None:
        """An episode ended now."""
        self.episodes.append((self.steps, length, reward, int(terminated)))

    def success(self, last: int = 100) -> float:
        """Share of the last episodes that terminated with a reward above 0; NaN before the first."""
        tail = self.episodes[-last:]
        return sum(bool(row[3]) and row[2] > 0 for row in tail) / len(tail) if tail else float("nan")

    def length(self, last: int = 100) -> float:
        """Mean steps of the last episodes; NaN before the first."""
        tail = self.episodes[-last:]
        return sum(row[1] for row in tail) / len(tail) if tail else float("nan")

    def reached(self) -> list[float]:
        """By option, the share of its last executions that its own classifier ended; NaN before the first."""
        return [sum(row.reached for row in rows) / len(rows) if rows else float("nan") for rows in self.executions]

    def recent(self, *, restarted: bool) -> dict[str, float]:
        """Numbers to show, none before the first episode: of the last episodes or, ``restarted``, of executions."""
        if not restarted:
            return {"success": self.success(), "length": self.length()} if self.episodes else {}
        rows = [row for option in self.executions for row in option]
        if not rows:
            return {}
        return {
            "reached": sum(row.reached for row in rows) / len(rows),
            "terminated": sum(row.terminated for row in rows) / len(rows),
            "duration": sum(row.duration for row in rows) / len(rows),
        }

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

    def snapshot(self) -> dict[str, Any]:
        """What a resumed run needs to go on exactly."""
        return {
            "steps": [self.steps, self._window_start],
            "episodes": np.array(self.episodes, np.float64).reshape(-1, len(EPISODE_COLUMNS)),
            "choices": np.array(self.choices, np.float64).reshape(-1, len(CHOICE_COLUMNS)),
            "stops": [list(stops) for stops in self.stops],
            "executions": [[list(row) for row in rows] for rows in self.executions],
            "pictures": [np.stack(kept) if kept else None for kept in self._pictures],
            "window": [self._offered, self._chosen, self._expected, self._reached, self._duration],
        }

    def restore(self, snapshot: Mapping[str, Any]) -> None:
        """Continue from a ``snapshot`` of a recorder of as many options."""
        self.steps, self._window_start = snapshot["steps"]
        rows = snapshot["episodes"].tolist()
        self.episodes = [(int(row[0]), int(row[1]), row[2], int(row[3])) for row in rows]
        rows = snapshot["choices"].tolist()
        self.choices = [
            (int(step), int(option), int(offered), int(chosen), expected, int(reached), int(duration))
            for step, option, offered, chosen, expected, reached, duration in rows
        ]
        for kept, stops in zip(self.stops, snapshot["stops"], strict=True):
            kept.extend(stops)
        for executions, ended in zip(self.executions, snapshot["executions"], strict=True):
            executions.extend(Execution(*row) for row in ended)
        for pictures, shown in zip(self._pictures, snapshot["pictures"], strict=True):
            pictures.extend(() if shown is None else shown)
        self._offered, self._chosen, self._expected, self._reached, self._duration = snapshot["window"]

    def write(self, folder: Path, images: Callable[[NDArray[np.int64]], NDArray[np.uint8]]) -> None:
        """``episodes.csv``, ``choices.csv`` and ``terminations.h5`` into ``folder``."""
        self.flush()
        write_table(folder / "episodes.csv", EPISODE_COLUMNS, self.episodes)
        write_table(folder / "choices.csv", CHOICE_COLUMNS, self.choices)
        with create_hdf5(folder / "terminations.h5") as file:
            for option, stops in enumerate(self.stops):
                if stops:
                    kept = self._pictures[option]
                    states = np.stack(kept) if kept else images(np.array(stops, dtype=np.int64))
                    file.create_dataset(str(option), data=states, compression="gzip", compression_opts=1)

    def write_executions(
        self,
        folder: Path,
        positions: Callable[[NDArray[np.int64]], NDArray[np.int64]],
        distance: Callable[[NDArray[np.int64]], NDArray[np.int64]],
    ) -> None:
        """``executions.csv`` into ``folder``: the last executions, option by option, in the order in which they ended.

        Args:
            folder: where.
            positions: of states (n,), int (n, 3).
            distance: of positions (n, 3) from where the sub-goal truly holds, int (n,).
        """
        rows = [row for option in self.executions for row in option]
        at = positions(np.array([row.state for row in rows], dtype=np.int64).reshape(-1))
        away = distance(at)
        write_table(
            folder / "executions.csv",
            EXECUTION_COLUMNS,
            [(*map(int, row[:-1]), *map(int, at[n]), int(away[n])) for n, row in enumerate(rows)],
        )
