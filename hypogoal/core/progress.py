"""Progress on stderr, one line that changes in a terminal and lines elsewhere; and the log of a training."""

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

LINE_SECONDS = 10.0  # between lines
REDRAW_SECONDS = 0.2  # of the line in a terminal
LOOK_SECONDS = 1.0
WIDTH = 79  # of the line in a terminal


class Progress:
    """``with Progress("train-meta", total=300_000) as progress: progress.advance(32, success=0.5)``.

    ``total`` may be set later, where it is not known at the beginning.
    """

    def __init__(self, title: str, total: int, quiet: bool = False):
        self.title, self.total, self.quiet = title, total, quiet
        self.done = 0
        self._terminal = sys.stderr.isatty()
        self._numbers = ""
        self.resume(0)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: object, *_: object) -> None:
        if kind is None and self.done:
            self._say(f"done in {duration(time.monotonic() - self._began)}")
        if self._terminal and not self.quiet:
            print(file=sys.stderr)

    def resume(self, done: int) -> None:
        """``done`` units were done before this moment."""
        self.done = self._before = done
        self._began = self._said = time.monotonic()

    def advance(self, n: int = 1, **numbers: float) -> None:
        """``n`` more units are done; ``numbers`` are shown beside them, except NaN (not known yet)."""
        self.update(self.done + n, **numbers)

    def update(self, done: int, **numbers: float) -> None:
        """``done`` units are done in total."""
        self.done = done
        if numbers:
            texts = [f"{name} {value:.3g}" for name, value in numbers.items() if not math.isnan(value)]
            self._numbers = " ".join(texts)
        now = time.monotonic()
        pause = REDRAW_SECONDS if self._terminal else LINE_SECONDS
        if now - self._said < pause or done >= self.total:
            return
        self._said = now
        fresh = done - self._before
        left = duration((now - self._began) * (self.total - done) / fresh) if fresh else "?"
        self._say(f"{left} left {self._numbers}")

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

    def _say(self, text: str) -> None:
        line = f"{self.title}: {self.done}/{self.total}, {text}"
        if self.quiet:
            return
        if self._terminal:
            print(f"\r{line[:WIDTH]:{WIDTH}}", end="", file=sys.stderr, flush=True)
        else:
            print(line, file=sys.stderr, flush=True)


def duration(seconds: float) -> str:
    """Seconds as ``0:01:30``."""
    return str(timedelta(seconds=round(seconds)))


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
