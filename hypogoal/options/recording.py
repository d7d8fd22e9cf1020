"""What happened while options were played: episodes, choices, where options stopped (Spec E5, F3, F4, F5, F6)."""

import math
from collections import deque
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from hypogoal.core.checkpoints import Resumable
from hypogoal.data import create_hdf5
from hypogoal.domains.base import Engine, Step
from hypogoal.learners.episodes import LAST, EpisodeRecorder
from hypogoal.observations import Observations
from hypogoal.options.choosers import Outcome
from hypogoal.options.tables import Choices, Episodes, Executions, Exploits

STOPS_KEPT = 128  # per option


class Execution(NamedTuple):
    """One option from its beginning to its end."""

    step: int  # when it ended
    option: int  # g*K + k
    duration: int  # its steps
    reached: bool  # its own classifier ended it
    inside_at_start: bool  # its own classifier was positive where it began
    terminated: bool  # it ended in a terminal state of the episode
    states: list[int]  # the ids of those that it came to, the last one that it ended in
    began: int  # the id of the one before them


class Recorder(Resumable):
    """Counts choices per ``window`` of steps, lists episodes, keeps the last executions and stops of each of O options.

    Of an engine that forgets states, stops are kept as pictures.
    """

    CHANGING = ("episodes", "choices", "stops", "executions", "_pictures", "_states", "_window", "_window_start")

    def __init__(self, options: int, engine: Engine, window: int = 5_000):
        self.options, self.engine, self.window = options, engine, window
        self.episodes = EpisodeRecorder(engine.count)
        self.choices: list[tuple[int, int, int, int, float, int, int]] = []
        self.stops: list[deque[int]] = [deque(maxlen=STOPS_KEPT) for _ in range(options)]
        self.executions: list[deque[Execution]] = [deque(maxlen=LAST) for _ in range(options)]
        self._pictures: list[deque[Observations]] = [deque(maxlen=STOPS_KEPT) for _ in range(options)]
        self._states: list[list[int]] = [[] for _ in range(engine.count)]  # that running executions came to
        self._window_start = 0
        self._window = np.zeros((options, 5))  # offered, chosen, expected, reached, duration

    @property
    def steps(self) -> int:
        """Environment steps so far, summed over the environments."""
        return self.episodes.steps

    def start_at(self, steps: int) -> None:
        """Environment steps spent before (those of ``train-options``) count in every curve."""
        self.episodes.steps = self._window_start = steps

    def see(self, step: Step) -> None:
        """A step of every environment."""
        self.episodes.see(step)
        for states, state in zip(self._states, step.next_ids.tolist(), strict=True):
            states.append(state)

    def chose(self, options: NDArray[np.int64], offered: NDArray[np.bool_]) -> None:
        """Decisions: the options chosen (n,) among those offered, bool (n, O)."""
        if self.steps - self._window_start >= self.window:
            self.flush()
        self._window[:, 0] += offered.sum(0)
        np.add.at(self._window[:, 1], options, 1)
        self._window[:, 2] += (offered / offered.sum(1, keepdims=True)).sum(0)

    def finished(self, outcome: Outcome) -> None:
        """Executions that ended."""
        options, reached, ids = outcome.options, outcome.reached, outcome.next_ids
        np.add.at(self._window[:, 3], options, reached)
        np.add.at(self._window[:, 4], options, outcome.durations)
        columns = (options, outcome.durations, reached, outcome.inside, outcome.terminated)
        environments, began = outcome.environments.tolist(), outcome.began.tolist()
        states = [self._states[environment] for environment in environments]
        for row in zip(*(values.tolist() for values in columns), states, began, strict=True):
            self.executions[row[0]].append(Execution(self.steps, *row))
        for environment in environments:
            self._states[environment] = []
        for option, identity in zip(options[reached], ids[reached], strict=True):
            self.stops[option].append(int(identity))
        if self.engine.memory is not None and reached.any():
            for option, picture in zip(options[reached], self.engine.images(ids[reached]), strict=True):
                self._pictures[option].append(picture)

    def recent(self, *, restarted: bool) -> dict[str, float]:
        """Numbers to show, none before the first episode: of the last episodes or, ``restarted``, of executions."""
        if not restarted:
            return self.episodes.recent() if self.episodes else {}
        rows = self._executions()
        names = ("reached", "terminated", "duration") if rows else ()
        return {name: sum(getattr(row, name) for row in rows) / len(rows) for name in names}

    def _executions(self) -> list[Execution]:
        return [execution for option in self.executions for execution in option]

    def flush(self) -> None:
        """Close the current window of choices."""
        for option, (offered, chosen, expected, reached, duration) in enumerate(self._window.tolist()):
            row = (int(offered), int(chosen), round(expected, 6), int(reached), int(duration))
            self.choices.append((self.steps, option, *row))
        self._window_start = self.steps
        self._window[:] = 0

    def restore(self, snapshot: Mapping[str, Any]) -> None:
        super().restore(snapshot)
        self.executions = [deque((Execution(*row) for row in rows), LAST) for rows in self.executions]

    def write(self, folder: Path) -> None:
        """``episodes.csv``, ``choices.csv`` and ``terminations.h5`` into ``folder``."""
        self.flush()
        Episodes.of_rows(self.episodes).write(folder)
        Choices.of_rows(self.choices).write(folder)
        with create_hdf5(folder / "terminations.h5") as file:
            for option, stops in enumerate(self.stops):
                if stops:
                    kept = self._pictures[option]
                    states = np.stack(kept) if kept else self.engine.images(np.array(stops, dtype=np.int64))
                    file.create_dataset(str(option), data=states, compression="gzip", compression_opts=1)

    def write_executions(
        self, folder: Path, distances: Callable[[NDArray[np.int64], NDArray[np.int64]], NDArray[np.int64]]
    ) -> None:
        """``executions.csv`` into ``folder``: the last executions, option by option, in the order in which they ended.

        ``distances`` are of positions (n, 3) from where the sub-goals of their options (n,) truly hold, int (n,).
        """
        executions = self._executions()
        stops = np.array([execution.states[-1] for execution in executions], dtype=np.int64)
        places = self.engine.positions(stops)
        away = distances(places, np.array([execution.option for execution in executions], dtype=np.int64))
        Executions.of_rows(
            (run.step, run.option, run.duration, run.reached, run.inside_at_start, run.terminated, *place, far)
            for run, place, far in zip(executions, places.tolist(), away.tolist(), strict=True)
        ).write(folder)

    def write_exploits(
        self,
        folder: Path,
        near: Callable[[NDArray[np.int64], NDArray[np.int64]], NDArray[np.bool_]],
        log_odds: Callable[[NDArray[np.int64], NDArray[np.int64]], NDArray[np.float32]],
    ) -> None:
        """Spec H5: ``exploits.csv`` into ``folder``, of the same executions: how sure its own classifier was at most.

        Of states (n,) and the options (n,) that came to them ``near`` says whether these options' true sub-goals hold
        there, or nearly, ``log_odds`` how sure their classifiers are. A cell is empty where there was no such state.
        """
        rows = []
        for run in self._executions():
            states = np.array(run.states, dtype=np.int64)
            options = np.full_like(states, run.option)
            is_near, sure = near(states, options), log_odds(states, options)
            best_near, best_far = (sure[part].max().item() if part.any() else math.nan for part in (is_near, ~is_near))
            rows.append((run.step, run.option, run.reached, is_near[-1], best_near, best_far))
        Exploits.of_rows(rows).write(folder)
