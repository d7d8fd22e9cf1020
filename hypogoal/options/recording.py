"""What happened while options were played: episodes, choices, where options stopped (Spec E5, F3, F4, F5, F6)."""

import math
from collections import deque
from collections.abc import Callable, Mapping
from pathlib import Path
from statistics import fmean
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from hypogoal.core.checkpoints import Resumable
from hypogoal.data import create_hdf5
from hypogoal.domains.base import Engine, Step
from hypogoal.learners.episodes import LAST, EpisodeRecorder
from hypogoal.observations import Observations
from hypogoal.options.choosers import Outcome
from hypogoal.options.parts import Flags, Floats, Ids
from hypogoal.options.tables import (
    Choices,
    Episodes,
    Executions,
    Exploits,
)

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

    CHANGING = ("episodes", "choices", "stops", "executions", "pictures", "paths", "counts", "counted_from")

    def __init__(
        self,
        options: int,
        engine: Engine,
        window: int = 5_000,
    ):
        self.options, self.engine, self.window = options, engine, window
        self.episodes = EpisodeRecorder(engine.count)
        self.choices: list[tuple[int, int, int, int, float, int, int]] = []
        self.stops: list[deque[int]] = [deque(maxlen=STOPS_KEPT) for _ in range(options)]
        self.executions: list[deque[Execution]] = [deque(maxlen=LAST) for _ in range(options)]
        self.pictures: list[deque[Observations]] = [deque(maxlen=STOPS_KEPT) for _ in range(options)]
        self.paths: list[list[int]] = [[] for _ in range(engine.count)]  # states that running executions came to
        self.counts = np.zeros((options, 5))  # in the window: offered, chosen, expected, reached, duration
        self.counted_from = 0  # the step at which the window began

    @property
    def steps(self) -> int:
        """Environment steps so far, summed over the environments."""
        return self.episodes.steps

    def start_at(self, steps: int) -> None:
        """Environment steps spent before (those of ``train-options``) count in every curve."""
        self.episodes.steps = self.counted_from = steps

    def see(self, step: Step) -> None:
        """A step of every environment."""
        self.episodes.see(step)
        for path, state in zip(self.paths, step.next_ids.tolist(), strict=True):
            path.append(state)

    def chose(self, options: Ids, offered: Flags) -> None:
        """Decisions: the options chosen (n,) among those offered, bool (n, O)."""
        if self.steps - self.counted_from >= self.window:
            self.flush()
        self.counts[:, 0] += offered.sum(0)
        np.add.at(self.counts[:, 1], options, 1)
        self.counts[:, 2] += (offered / offered.sum(1, keepdims=True)).sum(0)

    def finished(self, outcome: Outcome) -> None:
        """Executions that ended."""
        np.add.at(self.counts[:, 3], outcome.options, outcome.reached)
        np.add.at(self.counts[:, 4], outcome.options, outcome.durations)
        forgets = self.engine.memory is not None
        for row, environment in enumerate(outcome.environments.tolist()):
            option = int(outcome.options[row])
            run = Execution(
                step=self.steps,
                option=option,
                duration=int(outcome.durations[row]),
                reached=bool(outcome.reached[row]),
                inside_at_start=bool(outcome.inside[row]),
                terminated=bool(outcome.terminated[row]),
                states=self.paths[environment],
                began=int(outcome.began[row]),
            )
            self.executions[option].append(run)
            self.paths[environment] = []
            if run.reached:
                stop = outcome.next_ids[row]
                self.stops[option].append(int(stop))
                if forgets:
                    self.pictures[option].append(self.engine.images(stop[None])[0])

    def recent(self, *, restarted: bool) -> dict[str, float]:
        """Numbers to show, none before the first episode: of the last episodes or, ``restarted``, of executions."""
        if not restarted:
            return self.episodes.recent() if self.episodes else {}
        runs = self._executions()
        if not runs:
            return {}
        return {
            "reached": fmean(run.reached for run in runs),
            "terminated": fmean(run.terminated for run in runs),
            "duration": fmean(run.duration for run in runs),
        }

    def _executions(self) -> list[Execution]:
        """The last of all options, option by option."""
        runs: list[Execution] = []
        for of_option in self.executions:
            runs.extend(of_option)
        return runs

    def flush(self) -> None:
        """Close the current window of choices."""
        for option, (offered, chosen, expected, reached, duration) in enumerate(self.counts.tolist()):
            row = (int(offered), int(chosen), round(expected, 6), int(reached), int(duration))
            self.choices.append((self.steps, option, *row))
        self.counted_from = self.steps
        self.counts[:] = 0

    def restore(self, snapshot: Mapping[str, Any]) -> None:
        super().restore(snapshot)
        for runs in self.executions:
            restored = [Execution(*run) for run in runs]
            runs.clear()
            runs.extend(restored)

    def write(self, folder: Path) -> None:
        """``episodes.csv``, ``choices.csv`` and ``terminations.h5`` into ``folder``."""
        self.flush()
        Episodes.of_rows(self.episodes).write(folder)
        Choices.of_rows(self.choices).write(folder)
        with create_hdf5(folder / "terminations.h5") as file:
            for option, stops in enumerate(self.stops):
                if stops:
                    kept = self.pictures[option]
                    states = np.stack(kept) if kept else self.engine.images(np.array(stops, dtype=np.int64))
                    file.create_dataset(
                        str(option),
                        data=states,
                        compression="gzip",
                        compression_opts=1,
                    )

    def write_executions(self, folder: Path, distances: Callable[[Ids, Ids], Ids]) -> None:
        """``executions.csv`` into ``folder``: the last executions, option by option, in the order in which they ended.

        ``distances`` are of positions (n, 3) from where the sub-goals of their options (n,) truly hold, int (n,).
        """
        runs = self._executions()
        stops = np.array([run.states[-1] for run in runs], dtype=np.int64)
        options = np.array([run.option for run in runs], dtype=np.int64)
        places = self.engine.positions(stops)
        away = distances(places, options)
        rows = []
        for run, place, distance in zip(
            runs,
            places.tolist(),
            away.tolist(),
            strict=True,
        ):
            rows.append((*run[:6], *place, distance))
        Executions.of_rows(rows).write(folder)

    def write_exploits(
        self,
        folder: Path,
        near: Callable[[Ids, Ids], Flags],
        log_odds: Callable[[Ids, Ids], Floats],
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
            best_near, best_far = highest(sure[is_near]), highest(sure[~is_near])
            rows.append((run.step, run.option, run.reached, is_near[-1], best_near, best_far))
        Exploits.of_rows(rows).write(folder)


def highest(values: NDArray[np.floating]) -> float:
    """The highest of some numbers, NaN of none."""
    return values.max().item() if len(values) else math.nan
