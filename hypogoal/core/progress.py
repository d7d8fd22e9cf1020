"""Progress on stderr: a rich bar with rate and time left in a terminal, plain lines elsewhere."""

import json
import math
import os
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, Self

from hypogoal.core.errors import UserError
from hypogoal.core.terminal import printable, say, screen

FIRST_SECONDS, PLAIN_INTERVAL_SECONDS = 2.0, 10.0  # until the first line, and between lines
LOOK_SECONDS = 1.0


class Progress:
    """``with Progress("train-meta", total=300_000) as progress: progress.advance(32, success=0.5)``."""

    def __init__(self, title: str, total: int, quiet: bool = False):
        self.title, self.total, self.quiet = title, total, quiet
        self.done = self._before = 0
        self._begin()
        self._numbers: dict[str, float] = {}
        self._bar: Any = None
        self._task: Any = None

    def __enter__(self) -> Self:
        if not self.quiet and sys.stderr.isatty():
            from rich.progress import BarColumn, MofNCompleteColumn, ProgressColumn, TextColumn, TimeRemainingColumn
            from rich.progress import Progress as Bar
            from rich.text import Text

            class Pace(ProgressColumn):
                def render(column, task: Any) -> Text:
                    return Text(self.pace(), "progress.data.speed")

            columns = (
                TextColumn("{task.description}", markup=False),
                BarColumn(bar_width=10),
                MofNCompleteColumn(),
                Pace(),
                TextColumn("{task.fields[numbers]}", markup=False),
                TimeRemainingColumn(),
            )
            self._bar = Bar(*columns, console=screen(err=True))
            self._bar.start()
            self._task = self._bar.add_task(printable(self.title), total=self.total, numbers="")
        return self

    def __exit__(self, kind: object, *_: object) -> None:
        if self._bar is not None:
            self._bar.stop()
        elif not self.quiet and kind is None and self.done:
            self._line(f"done in {duration(time.monotonic() - self._start)}")

    @contextmanager
    def paused(self) -> Iterator[None]:
        """Hide the bar within the block, in which something else is printed."""
        if self._bar is not None:
            self._bar.stop()
        yield
        if self._bar is not None:
            self._bar.start()

    def expect(self, total: int) -> None:
        """Set the total number of units, if it becomes known only now."""
        self.total = total
        if self._bar is not None:
            self._bar.update(self._task, total=total)

    def resume(self, done: int) -> None:
        """``done`` units were done before this moment."""
        self._before = done
        self._begin()
        self.update(done)

    def advance(self, n: int = 1, **numbers: float) -> None:
        """``n`` more units are done; ``numbers`` are shown beside the bar, except NaN (not known yet)."""
        self.update(self.done + n, **numbers)

    def update(self, done: int, **numbers: float) -> None:
        """``done`` units are done in total."""
        self.done = done
        if self.quiet:
            return
        numbers = self._numbers = numbers or self._numbers
        text = " ".join(f"{name} {value:.3g}" for name, value in numbers.items() if not math.isnan(value))
        if self._bar is not None:
            self._bar.update(self._task, completed=done, numbers=text)
        elif done < self.total:
            first = done > self._before and not self._said  # the first line estimates the time left
            if time.monotonic() - self._last >= (FIRST_SECONDS if first else PLAIN_INTERVAL_SECONDS):
                self._line(text)

    @contextmanager
    def following(self, count: Callable[[], int]) -> Iterator[None]:
        """Within the block call ``count`` each second for the units done by other processes."""
        over = threading.Event()

        def look() -> None:
            while not over.wait(LOOK_SECONDS):
                self.update(count())

        thread = threading.Thread(target=look, daemon=True)
        thread.start()
        try:
            yield
        finally:
            over.set()
            thread.join()
        self.update(count())

    def pace(self) -> str:
        """The rate, ``12/s`` or ``3 s each``; before anything is done, the time spent."""
        seconds = max(time.monotonic() - self._start, 1e-9)
        rate = max(self.done - self._before, 0) / seconds
        return f"{rate:,.0f}/s" if rate >= 1 else f"{1 / rate:.0f} s each" if rate else f"{duration(seconds)} so far"

    def _begin(self) -> None:
        self._start = self._last = time.monotonic()
        self._said = False

    def _line(self, text: str) -> None:
        self._last, self._said = time.monotonic(), True
        seconds = max(self._last - self._start, 1e-9)
        rate = max(self.done - self._before, 0) / seconds
        left = self.total - self.done
        estimate = f" ({self.pace()}, {duration(left / rate)} left)" if rate and left > 0 else ""
        say(f"{self.title}: {self.done}/{self.total}{estimate}{f', {text}' if text else ''}", err=True)


def duration(seconds: float) -> str:
    """Seconds in readable units: 12 min, 3.4 h."""
    if seconds < 90:
        return f"{max(1, round(seconds))} s"
    if seconds < 90 * 60:
        return f"{round(seconds / 60)} min"
    return f"{seconds / 3600:.1f} h" if seconds < 48 * 3600 else f"{seconds / 86400:.1f} days"


class MetricsLog:
    """``metrics.jsonl``: one JSON object per line; the file is not kept open.

    With a folder ``tensorboard``, which may exist, TensorBoard gets the numbers too; without the extra a ``UserError``.
    """

    def __init__(self, path: Path, tensorboard: Path | None = None):
        self._path = path
        self._board = _board(tensorboard) if tensorboard else None
        path.touch()

    def write(self, **values: Any) -> None:
        """Append one line, with a ``step`` among its values."""
        with self._path.open("a", encoding="utf-8") as file:
            file.write(json.dumps(values) + "\n")
        if self._board is None:
            return
        for name, value in values.items():
            if name != "step" and isinstance(value, int | float):
                self._board.add_scalar(name, value, values["step"])

    def close(self) -> None:
        """Write what TensorBoard has not got yet."""
        if self._board is not None:
            self._board.close()

    def snapshot(self) -> int:
        """Flush the file to disk and return its length in bytes."""
        with self._path.open("a") as file:
            os.fsync(file.fileno())
            return os.fstat(file.fileno()).st_size

    def restore(self, snapshot: int) -> None:
        """Truncate the file to the length of a ``snapshot``."""
        if not 0 <= snapshot <= self._path.stat().st_size:
            raise ValueError(f"the log has fewer bytes than {snapshot}")
        os.truncate(self._path, snapshot)


def _board(folder: Path) -> Any:
    """A writer of TensorBoard's files, torch's; a ``UserError`` if TensorBoard is not installed."""
    try:
        from torch.utils.tensorboard import SummaryWriter
    except ImportError:
        do = "Install it: pip install 'hypogoal[tensorboard]'."
        raise UserError("TensorBoard is not installed", folder, do) from None
    return SummaryWriter(folder)
