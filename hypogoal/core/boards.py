"""Logs as TensorBoard reads them: the extra ``tensorboard``."""

from __future__ import annotations

import sys
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

from hypogoal.core.errors import UserError


class Boards:
    """Event files of logs: a folder per log, a tag per number.

    Args:
        out: the folder that TensorBoard will be shown; it must not be there yet.

    Raises:
        UserError: it is there, or the extra is not installed.
    """

    def __init__(self, out: Path):
        try:
            from tensorboard.compat.proto.event_pb2 import Event
            from tensorboard.compat.proto.summary_pb2 import Summary
            from tensorboard.summary.writer.event_file_writer import EventFileWriter
        except ImportError:
            raise UserError(
                "TensorBoard is not installed", out, "Install it: pip install 'hypogoal[tensorboard]'."
            ) from None
        if out.exists():
            raise UserError("the folder exists already", out, "Name another one, or remove it.")
        self._event, self._summary, self._writer = Event, Summary, EventFileWriter
        self._out = out
        self._writers: dict[str, Any] = {}
        self._steps: dict[str, int] = {}

    def add(self, place: str, lines: Iterable[Mapping[str, Any]], now: float) -> None:
        """What is new in a log; one that was cut off and is written again has the same numbers at the same steps.

        Args:
            place: its folder within ``out``.
            lines: the log so far.
            now: the time of day, in seconds since 1970, which TensorBoard shows.
        """
        for line in lines:
            step = line.get("step")
            if not isinstance(step, int) or step <= self._steps.get(place, -1):
                continue
            if place not in self._writers:
                self._writers[place] = self._writer(str(self._out / place))
            values = [
                self._summary.Value(tag=key, simple_value=float(value))
                for key, value in line.items()
                if key != "step" and isinstance(value, int | float) and not abs(value) > sys.float_info.max
            ]
            summary = self._summary(value=values)
            self._writers[place].add_event(self._event(wall_time=now, step=step, summary=summary))
            self._steps[place] = step
        if place in self._writers:
            self._writers[place].flush()

    def close(self) -> None:
        """Finish the event files."""
        for writer in self._writers.values():
            writer.close()
