"""Logs as TensorBoard reads them: the extra ``tensorboard``."""

from __future__ import annotations

import os
import sys
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

from hypogoal.core.errors import UserError, printable
from hypogoal.core.files import inside

EVENTS = "events.out.tfevents.1.hypogoal"  # TensorBoard looks for such names; the number is a time to order them by


class Boards:
    """Event files of logs: a folder per log, a tag per number.

    Names of logs and of their numbers are a stranger's: none leads out of ``out``, and for none a file is kept open.

    Args:
        out: the folder that TensorBoard will be shown; it must not be there yet.

    Raises:
        UserError: it is there, or the extra is not installed.
    """

    def __init__(self, out: Path):
        try:
            from tensorboard.compat.proto.event_pb2 import Event
            from tensorboard.compat.proto.summary_pb2 import Summary
            from tensorboard.summary.writer.record_writer import RecordWriter
        except ImportError:
            raise UserError(
                "TensorBoard is not installed", out, "Install it: pip install 'hypogoal[tensorboard]'."
            ) from None
        if os.path.lexists(out):
            raise UserError("the folder exists already", out, "Name another one, or remove it.")
        self._event, self._summary, self._writer = Event, Summary, RecordWriter
        self._out = out
        self._steps: dict[Path, int] = {}

    def add(self, place: str, lines: Iterable[Mapping[str, Any]], now: float) -> None:
        """What is new in a log; one that was cut off and is written again has the same numbers at the same steps.

        Args:
            place: its folder within ``out``; of a name that would lead out of it, ``out`` itself.
            lines: the log so far.
            now: the time of day, in seconds since 1970, which TensorBoard shows.
        """
        folder = inside(self._out, printable(place)) or self._out
        events = []
        if folder not in self._steps:
            events.append(self._event(wall_time=now, file_version="brain.Event:2"))
        for line in lines:
            step = line.get("step")
            if not isinstance(step, int) or step <= self._steps.get(folder, -1):
                continue
            values = [
                self._summary.Value(tag=printable(key), simple_value=float(value))
                for key, value in line.items()
                if key != "step" and isinstance(value, int | float) and not abs(value) > sys.float_info.max
            ]
            events.append(self._event(wall_time=now, step=step, summary=self._summary(value=values)))
            self._steps[folder] = step
        if folder not in self._steps or not events:
            return
        folder.mkdir(parents=True, exist_ok=True)
        with (folder / EVENTS).open("ab") as file:
            writer = self._writer(file)
            for event in events:
                writer.write(event.SerializeToString())
