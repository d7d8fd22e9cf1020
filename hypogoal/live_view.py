"""A live view of a run from its ``metrics.jsonl`` files, also those still being written (Spec A6)."""

from __future__ import annotations

import os
import re
import sys
import time
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Any

from rich.live import Live
from rich.table import Table

from hypogoal.core.artefacts import MANIFEST
from hypogoal.core.checkpoints import FOLDER
from hypogoal.core.drafts import PARTIAL
from hypogoal.core.errors import UserError, printable
from hypogoal.core.files import MOST_INTEGER, inside, json_lines, plain_name, read_end
from hypogoal.core.manifests import LOG
from hypogoal.core.progress import duration
from hypogoal.core.terminal import draw, screen

RATES = ("success", "reached")  # shares of episodes or executions, drawn from 0 to 1
WATCHED = (*RATES, "loss")  # the number followed is the first of these in a log
BARS = "▁▂▃▄▅▆▇█"
NAME, CURVE = 28, 13  # widths of columns in characters
SECONDS = 2.0  # between updates
WIDTH = 80
MOST_DRAWN = 1e300  # sums and differences of larger numbers overflow


@dataclass(frozen=True)
class Progressing:
    """One artefact in the making, or complete."""

    name: str  # its path within the run
    sub_goal: str  # the sub-goal that an ensemble is training; empty for others
    seconds: float | None  # since its log was written; None if it is complete
    step: int  # the last logged
    watched: str  # the number followed (one of ``WATCHED``), or empty
    series: tuple[float, ...]  # its values so far
    lines: list[dict[str, Any]]  # its log so far; for an ensemble of all sub-goals

    @property
    def title(self) -> str:
        """The name for people."""
        return f"{self.name}: {self.sub_goal}" if self.sub_goal else self.name


def watch(run: Path, *, once: bool = False, boards: Boards | None = None) -> None:
    """Show the progress of a run's artefacts until the run is finished or interrupted.

    ``once``, without a terminal, or for a finished run, the view is printed once. ``boards`` get the logs too. A
    missing folder or one without logs is a ``UserError``.
    """
    console = screen()

    def look() -> list[Progressing]:
        rows = read_progress(run)
        if boards is not None:
            mirror(rows, boards)
        return rows

    rows = look()
    if once or not console.is_terminal or finished(run):
        draw(view(rows), WIDTH)
        return
    try:
        with Live(view(rows, console.height - 3), console=console, screen=False, auto_refresh=False) as live:
            while not finished(run):
                time.sleep(SECONDS)
                live.update(view(look(), console.height - 3), refresh=True)
    except KeyboardInterrupt:
        return


def mirror(rows: Iterable[Progressing], boards: Boards) -> None:
    """Write what is new in the logs for TensorBoard: a folder per artefact, for an ensemble one per sub-goal."""
    for row in rows:
        for goal in dict.fromkeys(line.get("sub_goal") for line in row.lines):
            lines = [line for line in row.lines if line.get("sub_goal") == goal]
            boards.add(row.name if goal is None else f"{row.name}/{goal}", lines, time.time())


def finished(run: Path) -> bool:
    """Whether ``hypogoal run`` has completed the run and nothing is being made anew."""
    return (run / "run.json").is_file() and not any(row.seconds is not None for row in read_progress(run))


def read_progress(run: Path) -> list[Progressing]:
    """Artefacts in the making, then complete ones, each by path; a ``UserError`` if there are no logs."""
    if not run.is_dir():
        raise UserError("no such run", run, "Give the folder that 'run' or a stage writes into.")
    logs = [*run.rglob(LOG), *run.rglob(f".*{PARTIAL}/{FOLDER}/*.jsonl")]  # an ensemble has one per sub-goal
    rows = [_read(log, run) for log in sorted(logs)]
    if not rows:
        raise UserError(f"nothing to watch: no {LOG}", run, "Training stages write it as they go; is one running?")
    return sorted(rows, key=lambda row: (row.seconds is None, row.title))


def _read(log: Path, run: Path) -> Progressing:
    lines = _lines(log)
    last = lines[-1] if lines else {}
    named = re.compile(rf"\.+[^.].*{re.escape(PARTIAL)}")  # not for an output called '.' or '..'
    draft = next((folder for folder in log.parents if named.fullmatch(folder.name)), None)
    place = draft.with_name(draft.name[1 : -len(PARTIAL)]) if draft else log.parent
    name = place.relative_to(run).as_posix() if place != run else place.name
    goal = str(last.get("sub_goal", ""))
    same_goal = [line for line in lines if line.get("sub_goal", "") == goal]
    watched = next((key for key in WATCHED if key in last), "")
    series = tuple(float(line[watched]) for line in same_goal if _is_number(line.get(watched)))
    whole = draft is None and (place / MANIFEST).is_file()
    try:
        seconds = None if whole else max(0.0, time.time() - log.stat().st_mtime)
    except OSError:  # renamed meanwhile: it has just become complete
        seconds = None
    return Progressing(name, goal, seconds, int(last.get("step", 0)), watched, series, lines)


def _lines(log: Path) -> list[dict[str, Any]]:
    """The lines of a log that have a step."""
    lines = [line for line in json_lines(read_end(log)) if plain_name(line.get("sub_goal", "none"))]
    return [line for line in lines if type(line.get("step")) is int and 0 <= line["step"] <= MOST_INTEGER]


def _is_number(value: Any) -> bool:
    """Whether a value is a number that can be drawn."""
    return type(value) in (int, float) and -MOST_DRAWN < value < MOST_DRAWN


def view(rows: Sequence[Progressing], most: int | None = None) -> Table:
    """The rows as a table, at most 80 columns wide and ``most`` rows long."""
    table = Table(box=None, padding=(0, 1, 0, 0), width=WIDTH - 1, title_justify="left", caption_justify="left")
    making = sum(row.seconds is not None for row in rows)
    table.title = f"{making} in the making, {len(rows) - making} complete"
    for name, width in (("artefact", NAME), ("written", 10), ("step", 9), ("now", 14), ("so far", CURVE)):
        table.add_column(name, width=width, justify="right" if name in ("written", "step") else "left", no_wrap=True)
    shown = rows if most is None or len(rows) <= most else rows[: max(1, most - 1)]
    for row in shown:
        table.add_row(
            row.title if len(row.title) <= NAME else f"…{row.title[1 - NAME :]}",
            "done" if row.seconds is None else f"{duration(row.seconds)} ago",
            f"{row.step:,}",
            f"{row.watched} {row.series[-1]:.3g}" if row.series else "–",
            curve(row.series, (0.0, 1.0) if row.watched in RATES else None),
        )
    if len(shown) < len(rows):
        table.caption = f"and {len(rows) - len(shown)} more"
    return table


def curve(values: Sequence[float], bounds: tuple[float, float] | None = None, width: int = CURVE) -> str:
    """Values as block characters, each the mean of an equal part; ``bounds`` default to the lowest and highest."""
    numbers = [value for value in values if _is_number(value)]
    count = min(width, len(numbers))
    if count == 0:
        return ""
    edges = [round(index * len(numbers) / count) for index in range(count + 1)]
    means = [sum(numbers[start:end]) / (end - start) for start, end in pairwise(edges)]
    low, high = bounds or (min(means), max(means))
    span = (high - low) or 1.0
    places = (min(max((value - low) / span, 0.0), 1.0) for value in means)
    return "".join(BARS[int(place * (len(BARS) - 1) + 0.5)] for place in places)


EVENTS = "events.out.tfevents.1.hypogoal"  # the name that TensorBoard looks for; the number is a time


class Boards:
    """TensorBoard's event files in a new folder ``out``: a folder per log, a tag per number.

    Logs may be a stranger's: no name leads out of ``out``. No file is kept open, as torch's ``SummaryWriter`` would.
    An existing ``out``, or a missing extra, is a ``UserError``.
    """

    def __init__(self, out: Path):
        try:
            from tensorboard.compat.proto.event_pb2 import Event
            from tensorboard.compat.proto.summary_pb2 import Summary
            from tensorboard.summary.writer.record_writer import RecordWriter
        except ImportError:
            do = "Install it: pip install 'hypogoal[tensorboard]'."
            raise UserError("TensorBoard is not installed", out, do) from None
        if os.path.lexists(out):
            raise UserError("the folder exists already", out, "Name another one, or remove it.")
        self._event, self._summary, self._writer = Event, Summary, RecordWriter
        self._out = out
        self._steps: dict[Path, int] = {}

    def add(self, place: str, lines: Iterable[Mapping[str, Any]], now: float) -> None:
        """Write what is new in a log, the steps after the last one; a resumed stage logs the same numbers again.

        The folder is ``place`` within ``out``, or ``out`` if ``place`` would lead out of it. TensorBoard shows the time
        ``now``, in seconds since 1970.
        """
        folder = inside(self._out, printable(place)) or self._out
        events = [] if folder in self._steps else [self._event(wall_time=now, file_version="brain.Event:2")]
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
