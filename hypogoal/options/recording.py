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

STOPS_KEPT = 128  # the number of stops kept of each option
WINDOW = 5_000  # the number of steps whose choices are counted together


class Execution(NamedTuple):
    """An execution of an option, from its beginning to its end."""

    step: int  # the number of environment steps when the execution ended
    option: int  # g*K + k
    duration: int  # the number of steps of the execution
    reached: bool  # whether the option's own classifier ended the execution
    inside_at_start: bool  # whether that classifier was positive already where the execution began
    terminated: bool  # whether the execution ended in a terminal state of the episode
    truncated: bool  # whether the execution ended because its episode was cut
    began: int  # the id of the state in which the option was chosen
    states: list[int]  # the ids of the states that followed, up to the state in which the execution ended


class Recorder(Resumable):
    """A recorder of episodes, choices per ``WINDOW`` of steps, and the last executions and stops of each of O options.

    A stop is the id of a state. If the engine forgets states, a stop is the state's picture.
    """

    CHANGING = ("episodes", "choices", "stops", "executions", "paths", "counts", "counted_from")

    def __init__(self, options: int, engine: Engine):
        self.options, self.engine = options, engine
        self.episodes = EpisodeRecorder(engine.count)
        self.choices: list[tuple[float, ...]] = []
        self.stops = latest(options, STOPS_KEPT)
        self.executions = latest(options, LAST)
        self.paths: list[list[int]] = [[] for _ in range(engine.count)]  # the states so far of the executions that run
        self.counts = np.zeros((options, 5))  # of the window: offered, chosen, expected, reached, duration
        self.counted_from = 0  # the step at which the window began

    @property
    def steps(self) -> int:
        """The number of environment steps so far, summed over the environments."""
        return self.episodes.steps

    def start_at(self, steps: int) -> None:
        """Begin every curve at ``steps``, the number of environment steps spent earlier, in ``train-options``."""
        self.episodes.steps = self.counted_from = steps

    def see(self, step: Step) -> None:
        """Record one step of every environment."""
        self.episodes.see(step)
        for path, state in zip(self.paths, step.next_ids.tolist(), strict=True):
            path.append(state)

    def chose(self, options: Ints, offered: Bools) -> None:
        """Count n decisions for ``options`` (n,), among the options ``offered``, bool (n, O)."""
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
        """Record executions that ended."""
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
        """Return numbers to show of the last episodes or, with ``restarted``, of the last executions.

        The result is an empty dictionary while none has ended.
        """
        if not restarted:
            return self.episodes.recent() if self.episodes.rows else {}
        numbers = {}
        if runs := self._executions():
            for name in ("reached", "terminated", "duration"):
                numbers[name] = fmean(getattr(run, name) for run in runs)
        return numbers

    def _executions(self) -> list[Execution]:
        """Return the last executions of all options, option by option."""
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
        """Write ``episodes.csv``, ``choices.csv`` and ``terminations.h5`` into ``folder``."""
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
        """Write ``executions.csv`` into ``folder``: the last executions, option by option, in the order of their ends.

        ``distances`` returns the distances, int (n,), of positions (n, 3) from where the true sub-goals of options (n,)
        hold.
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
        """Write ``exploits.csv`` into ``folder``: how sure the classifier of each of the last executions was at most.

        Both functions take states (n,) and options (n,). ``near`` returns whether each option's true sub-goal holds, or
        nearly holds, in the state, and ``log_odds`` how sure the option's classifier is. If an execution came to no
        state near (or far from) its sub-goal, the cell is empty.
        """
        rows = []
        for run in self._executions():
            states = np.array(run.states, int)
            options = np.full_like(states, run.option)
            is_near, sure = near(states, options), log_odds(states, options)
            best_near = np.fmax.reduce(sure[is_near], initial=np.nan)  # NaN if there is no such state
            best_far = np.fmax.reduce(sure[~is_near], initial=np.nan)
            row = (run.step, run.option, run.reached, is_near[-1], best_near, best_far)
            rows.append(row)
        Exploits.of_rows(rows).write(folder)


def latest(options: int, most: int) -> list[deque[Any]]:
    """Return for each option an empty list that keeps its last ``most`` entries."""
    return [deque(maxlen=most) for _ in range(options)]
