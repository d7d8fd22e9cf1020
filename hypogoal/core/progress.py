"""What is printed: lines, and progress, which is a changing line on stderr. Also the log of a training."""

import json
import math
import os
import sys
from pathlib import Path
from typing import Any, Self

LINE = "{desc}: {n_fmt}/{total_fmt} in {elapsed}, {remaining} left{postfix}"
FIRST_SECONDS = 1.0  # work that takes less time shows no progress
REDRAW_SECONDS = 0.2  # the time between two updates in a terminal
LINE_SECONDS = 10.0  # the time between two updates if the output is no terminal


class Progress:
    """A progress line: ``with Progress("train-meta", total=300_000) as progress: progress.advance(32, success=0.5)``.

    Attributes:
        total: the number of units of work. It may be set later if it is not known at the beginning.
        done: the number of units done.
    """

    def __init__(self, title: str, total: int, quiet: bool = False):
        from tqdm import tqdm  # imported here, because the import takes as long as that of the whole command line

        self.total = total
        self.done = 0
        self._bar = tqdm(
            desc=title,
            total=total,
            disable=quiet,
            bar_format=LINE,
            delay=FIRST_SECONDS,
            mininterval=REDRAW_SECONDS if sys.stderr.isatty() else LINE_SECONDS,
            miniters=1,
            dynamic_ncols=True,
        )

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self._bar.close()

    def resume(self, done: int) -> None:
        """Count ``done`` units as done before this moment."""
        self.done = self._bar.n = self._bar.initial = done

    def advance(self, n: int = 1, **numbers: float) -> None:
        """Count ``n`` more units as done.

        ``numbers`` are shown beside the count, except NaN, which stands for not known yet.
        """
        shown = {name: value for name, value in numbers.items() if not math.isnan(value)}
        if shown:
            self._bar.set_postfix(shown, refresh=False)
        self.done += n
        self._bar.total = self.total
        self._bar.update(n)

    def update(self, done: int, **numbers: float) -> None:
        """Set the number of units done in total to ``done``."""
        self.advance(done - self.done, **numbers)


def duration(seconds: float) -> str:
    """Return a time as progress lines show it: ``03:20``, or ``1:03:20``."""
    from tqdm import tqdm

    return str(tqdm.format_interval(seconds))


class MetricsLog:
    """The file ``metrics.jsonl``, which has one JSON object per line and is not kept open.

    With a folder ``tensorboard``, which may exist already, TensorBoard gets the numbers, too, if it is installed.
    """

    def __init__(self, path: Path, tensorboard: Path | None = None):
        self._path = path
        self._board = None
        if tensorboard:
            from torch.utils.tensorboard import SummaryWriter

            self._board = SummaryWriter(tensorboard)
        path.touch()

    def write(self, **values: Any) -> None:
        """Append one line. ``step`` must be among its values."""
        with self._path.open("a", encoding="utf-8") as file:
            file.write(json.dumps(values) + "\n")
        if self._board is None:
            return
        for name, value in values.items():
            if name != "step" and isinstance(value, int | float):
                self._board.add_scalar(name, value, values["step"])

    def close(self) -> None:
        """Write the numbers that TensorBoard has not got yet."""
        if self._board is not None:
            self._board.close()

    def snapshot(self) -> int:
        """Flush the file to disk, and return its length in bytes."""
        with self._path.open("a") as file:
            os.fsync(file.fileno())
            return os.fstat(file.fileno()).st_size

    def restore(self, snapshot: int) -> None:
        """Truncate the file to the length of a ``snapshot``."""
        os.truncate(self._path, snapshot)


def say(*lines: object, err: bool = False) -> None:
    """Print lines on standard output, or on standard error if ``err`` is true.

    Letters that the stream cannot show are printed as their numbers.
    """
    stream = sys.stderr if err else sys.stdout
    for line in lines:
        try:
            print(line, file=stream, flush=True)
        except UnicodeEncodeError:
            shown = str(line).encode(stream.encoding, "backslashreplace").decode(stream.encoding)
            print(shown, file=stream, flush=True)
