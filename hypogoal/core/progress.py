"""Progress on stderr, a bar in a terminal and plain lines elsewhere; and the log of a training."""

import json
import math
import os
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from datetime import timedelta
from pathlib import Path
from typing import Any, Self

from hypogoal.core.errors import UserError
from hypogoal.core.terminal import say, screen

LINE_SECONDS = 10.0  # between plain lines
LOOK_SECONDS = 1.0


class Progress:
    """``with Progress("train-meta", total=300_000) as progress: progress.advance(32, success=0.5)``.

    ``total`` may be set later, where it is not known at the beginning.
    """

    def __init__(self, title: str, total: int, quiet: bool = False):
        self.title, self.total, self.quiet = title, total, quiet
        self.done = 0
        self._terminal = sys.stderr.isatty()
        self._bar = _bar()
        self._bar.add_task(title, total=total, numbers="")
        self._task = self._bar.tasks[0]
        self._said = time.monotonic()

    def __enter__(self) -> Self:
        if self._terminal and not self.quiet:
            self._bar.start()
        return self

    def __exit__(self, kind: object, *_: object) -> None:
        if self.quiet:
            return
        if self._terminal:
            self._bar.stop()
        elif kind is None and self.done:
            self._line(f"done in {duration(self._task.elapsed)}")

    def resume(self, done: int) -> None:
        """``done`` units were done before this moment."""
        self.done = done
        self._bar.reset(self._task.id, completed=done)

    def advance(self, n: int = 1, **numbers: float) -> None:
        """``n`` more units are done; ``numbers`` are shown beside the bar, except NaN (not known yet)."""
        self.update(self.done + n, **numbers)

    def update(self, done: int, **numbers: float) -> None:
        """``done`` units are done in total."""
        self.done = done
        if numbers:
            texts = [f"{name} {value:.3g}" for name, value in numbers.items() if not math.isnan(value)]
            self._task.fields["numbers"] = " ".join(texts)
        self._bar.update(self._task.id, completed=done, total=self.total)
        overdue = time.monotonic() - self._said >= LINE_SECONDS
        if overdue and done < self.total and not self.quiet and not self._terminal:
            left = f"{duration(self._task.time_remaining)} left"
            self._line(" ".join([left, self._task.fields["numbers"]]))

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

    def _line(self, text: str) -> None:
        self._said = time.monotonic()
        say(f"{self.title}: {self.done}/{self.total}, {text}", err=True)


def _bar() -> Any:
    """rich's bar, which also knows how much time is left where it is not drawn."""
    from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

    return Progress(
        TextColumn("{task.description}", markup=False),
        BarColumn(bar_width=10),
        MofNCompleteColumn(),
        TextColumn("{task.fields[numbers]}", markup=False),
        TimeRemainingColumn(),
        console=screen(err=True),
    )


def duration(seconds: float | None) -> str:
    """Seconds as ``0:01:30``; None, not known yet, as a question mark."""
    return "?" if seconds is None else str(timedelta(seconds=round(seconds)))


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
        os.truncate(self._path, snapshot)


def _board(folder: Path) -> Any:
    """A writer of TensorBoard's files, torch's; a ``UserError`` if TensorBoard is not installed."""
    try:
        from torch.utils.tensorboard import SummaryWriter
    except ImportError:
        do = "Install it: pip install 'hypogoal[tensorboard]'."
        raise UserError("TensorBoard is not installed", folder, do) from None
    return SummaryWriter(folder)
