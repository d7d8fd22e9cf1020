"""What happened while options were played: episodes, choices, where options stopped."""

from collections import deque
from collections.abc import Callable, Mapping
from itertools import chain
from pathlib import Path
from statistics import fmean
from typing import Any, NamedTuple

import numpy as np

from hypogoal.core.arrays import Bools, Floats, Ints
from hypogoal.core.checkpoints import Resumable
from hypogoal.core.hdf5 import create_hdf5
from hypogoal.domains.base import Engine, Step
from hypogoal.domains.episodes import LAST, EpisodeRecorder
from hypogoal.options.choosers import Outcome
from hypogoal.options.tables import ChoiceCounts, Episodes, Executions, Exploits

STOPS_KEPT = 128  # per option
WINDOW = 5_000  # steps in which choices are counted together


class Execution(NamedTuple):
    """One option from its beginning to its end."""

    step: int  # when it ended
    option: int  # g*K + k
    duration: int  # its steps
    reached: bool  # its own classifier ended it
    inside_at_start: bool  # its own classifier was positive where it began
    terminated: bool  # it ended in a terminal state of the episode
    truncated: bool  # it ended because its episode was cut
    began: int  # the id of the state in which it was chosen
    states: list[int]  # the ids of those that it came to, the last one that it ended in


class Recorder(Resumable):
    """Counts choices per ``WINDOW`` of steps, lists episodes, keeps the last executions and stops of each of O options.

    Stops are states, of an engine that forgets these their pictures.
    """

    CHANGING = ("episodes", "choices", "stops", "executions", "paths", "counts", "counted_from")

    def __init__(self, options: int, engine: Engine):
        self.options, self.engine = options, engine
        self.episodes = EpisodeRecorder(engine.count)
        self.choices: list[tuple[float, ...]] = []
        self.stops = latest(options, STOPS_KEPT)
        self.executions = latest(options, LAST)
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

    def chose(self, options: Ints, offered: Bools) -> None:
        """Decisions: the options chosen (n,) among those offered, bool (n, O)."""
        if self.steps - self.counted_from >= WINDOW:
            self.flush()
        self.counts[:, 0] += offered.sum(0)
        np.add.at(
            self.counts[:, 1],
            options,
            1,
        )
        shares = offered / offered.sum(1, keepdims=True)
        self.counts[:, 2] += shares.sum(0)

    def finished(self, outcome: Outcome) -> None:
        """Executions that ended."""
        np.add.at(
            self.counts[:, 3],
            outcome.options,
            outcome.reached,
        )
        np.add.at(
            self.counts[:, 4],
            outcome.options,
            outcome.durations,
        )
        columns = (
            outcome.environments,
            outcome.options,
            outcome.durations,
            outcome.reached,
            outcome.inside,
            outcome.terminated,
            outcome.truncated,
            outcome.began,
        )
        plain = [column.tolist() for column in columns]
        for environment, *facts in zip(*plain, strict=True):
            run = Execution._make([self.steps, *facts, self.paths[environment]])
            self.executions[run.option].append(run)
            self.paths[environment] = []
            if not run.reached:
                continue
            stop = run.states[-1]
            if self.engine.memory is not None:
                [stop] = self.engine.images(np.array([stop]))
            self.stops[run.option].append(stop)

    def recent(self, *, restarted: bool) -> dict[str, float]:
        """Numbers to show, none before the first episode: of the last episodes or, ``restarted``, of executions."""
        if not restarted:
            return self.episodes.recent() if self.episodes.rows else {}
        numbers = {}
        if runs := self._executions():
            for name in ("reached", "terminated", "duration"):
                numbers[name] = fmean(getattr(run, name) for run in runs)
        return numbers

    def _executions(self) -> list[Execution]:
        """The last of all options, option by option."""
        return [*chain(*self.executions)]

    def flush(self) -> None:
        """Close the current window of choices."""
        for option, counts in enumerate(self.counts.round(6).tolist()):
            self.choices.append((self.steps, option, *counts))
        self.counted_from = self.steps
        self.counts[:] = 0

    def restore(self, snapshot: Mapping[str, Any]) -> None:
        super().restore(snapshot)
        for runs in self.executions:
            for index, run in enumerate(runs):
                runs[index] = Execution(*run)

    def write(self, folder: Path) -> None:
        """``episodes.csv``, ``choices.csv`` and ``terminations.h5`` into ``folder``."""
        self.flush()
        Episodes.of_rows(self.episodes.rows).write(folder)
        ChoiceCounts.of_rows(self.choices).write(folder)
        with create_hdf5(folder / "terminations.h5") as file:
            for option, stops in enumerate(self.stops):
                if stops:
                    states = np.array(stops)
                    if self.engine.memory is None:
                        states = self.engine.images(states)
                    file.create_dataset(
                        str(option),
                        data=states,
                        compression="gzip",
                        compression_opts=1,
                    )

    def write_executions(
        self,
        folder: Path,
        distances: Callable[[Ints, Ints], Ints],
    ) -> None:
        """``executions.csv`` into ``folder``: the last executions, option by option, in the order in which they ended.

        ``distances`` are of positions (n, 3) from where the sub-goals of their options (n,) truly hold, int (n,).
        """
        runs = self._executions()
        stopped = [run.states[-1] for run in runs]
        stops = np.array(stopped, int)
        options = np.array([run.option for run in runs], int)
        places = self.engine.positions(stops)
        aways = distances(places, options)
        rows = [(*run[:6], *place, away) for run, place, away in zip(runs, places, aways, strict=True)]
        Executions.of_rows(rows).write(folder)

    def write_exploits(
        self,
        folder: Path,
        near: Callable[[Ints, Ints], Bools],
        log_odds: Callable[[Ints, Ints], Floats],
    ) -> None:
        """``exploits.csv`` into ``folder``, of the same executions: how sure its own classifier was at most.

        Of states (n,) and the options (n,) that came to them ``near`` says whether these options' true sub-goals hold
        there, or nearly, ``log_odds`` how sure their classifiers are. A cell is empty where there was no such state.
        """
        rows = []
        for run in self._executions():
            states = np.array(run.states, int)
            options = np.full_like(states, run.option)
            is_near, sure = near(states, options), log_odds(states, options)
            best_near = np.fmax.reduce(sure[is_near], initial=np.nan)  # NaN of none
            best_far = np.fmax.reduce(sure[~is_near], initial=np.nan)
            row = (run.step, run.option, run.reached, is_near[-1], best_near, best_far)
            rows.append(row)
        Exploits.of_rows(rows).write(folder)


def latest(options: int, most: int) -> list[deque[Any]]:
    """For each option an empty list that keeps the last so many."""
    return [deque(maxlen=most) for _ in range(options)]
