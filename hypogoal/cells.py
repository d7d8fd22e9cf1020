"""The cells of a run (Spec A6, G4): a cell is one command of hypogoal with an output of its own.

The plan is ``sweep.json``. A cell is done when its output is there, runs while its draft is locked, and has failed if
its last attempt did (``logs/NAME.code``). Nothing else is recorded: a run may be killed and started again anywhere.
"""

import re
import signal
from collections import Counter
from pathlib import Path

from pydantic import BaseModel, Field, TypeAdapter, ValidationError

from hypogoal.core.artefacts import Draft
from hypogoal.core.errors import UserError, reason

PLAN = "sweep.json"
NAME = r"^\w[\w.,:=+-]*(/\w[\w.,:=+-]*)*$"  # of a cell: its place in the run's folder
OUTPUT = re.compile("(^|=)@(.+)")  # in a word an output: @data, --data=@data
DONE, RUNNING, FAILED, WAITING = "done", "running", "failed", "waiting"
SCOPES = ("", "labelled", "unlabelled", "heldout", "unseen", "all")  # of numbers that ``results.csv`` has
COLUMNS = ["sub_goal", "member", "scope", "quantity", "value"]
STOPPED = (None, 128 + signal.SIGINT, 128 + signal.SIGTERM, -signal.SIGINT, -signal.SIGTERM)  # no failures

Value = str | int | float


class Cell(BaseModel):
    """One command of an experiment. ``@PLACE`` in its words is a place in the run's folder."""

    name: str = Field(pattern=NAME)
    words: list[str]
    needs: list[str] = []  # names of cells whose outputs it reads
    columns: dict[str, Value] = {}  # of ``results.csv``

    @property
    def stage(self) -> str:
        """Its command: train-meta, ..."""
        return self.words[0]

    @property
    def is_derived(self) -> bool:
        """Whether it only reads the run and is made again in minutes."""
        return self.stage in ("evaluate", "report")

    @property
    def place(self) -> str:
        """Its output in the run's folder."""
        return f"{self.name}.h5" if self.stage == "collect" else self.name

    def draft(self, run: Path) -> Draft:
        """The draft of its output."""
        return Draft(run / self.place)

    def is_done(self, run: Path) -> bool:
        """Whether its output is there."""
        return (run / self.place).exists()

    def command(self, run: Path) -> list[str]:
        """Its words as one types them after ``hypogoal``."""
        words = [OUTPUT.sub(lambda match: f"{match[1]}{run / match[2]}", word) for word in self.words]
        return [*words, "--out", str(run / self.place)]

    def log(self, run: Path, suffix: str = "log") -> Path:
        """What its attempts printed; with the suffix ``code``, how the last one ended."""
        return run / "logs" / f"{self.name}.{suffix}"

    def log_lines(self, run: Path, suffix: str = "log") -> list[str]:
        """The lines of :meth:`log`, none where there is none."""
        path = self.log(run, suffix)
        return path.read_text(encoding="utf-8", errors="replace").splitlines() if path.exists() else []

    def exit_code(self, run: Path) -> int | None:
        """How its last attempt ended, a signal as a negative number; None if it was not tried or has not ended."""
        lines = self.log_lines(run, "code")
        return int(lines[0]) if lines else None

    def state(self, run: Path) -> str:
        """Whether it is done, runs, failed or waits."""
        if self.is_done(run):
            return DONE
        if self.draft(run).is_locked:
            return RUNNING
        return WAITING if self.exit_code(run) in STOPPED else FAILED

    def last_words(self, run: Path) -> str:
        """The last line of its log, or how it ended without one; and where the log is."""
        lines = self.log_lines(run)
        text = lines[-1].removeprefix("hypogoal: ") if lines else ""
        code = self.exit_code(run)
        if code == 0:
            text = "it ended as if all were well, but made nothing"
        elif code and code < 0:
            text = f"ended by signal {-code}"
        return f"{text} ({self.log(run)})"


CELLS = TypeAdapter(list[Cell])


def read_plan(run: Path) -> list[Cell]:
    """The cells of a run, none if no experiment was begun there; a damaged plan is a ``UserError``."""
    path = run / PLAN
    if not path.exists():
        return []
    try:
        return CELLS.validate_json(path.read_bytes())
    except ValidationError as error:
        problem = f"the plan is damaged, or of another version ({reason(error)})"
        raise UserError(
            problem,
            path,
            "Remove it: what is complete is kept.",
        ) from None


def unmade(run: Path) -> list[str]:
    """The names of the cells that a run was to have and has not."""
    return [cell.name for cell in read_plan(run) if not (cell.is_derived or cell.is_done(run))]


def write_results(run: Path, evaluation: Path) -> None:
    """Write ``results.csv`` beside an evaluation's ``numbers.csv``: each of its numbers with its cell's columns.

    Learning curves are in ``numbers.csv`` alone.
    """
    import pandas

    rows = []
    for cell in read_plan(run):
        rows.append({"cell": cell.name, "stage": cell.stage, **cell.columns, "artefact": cell.place})
    if not rows:
        return
    cells = pandas.DataFrame(rows, dtype=object)
    numbers = pandas.read_csv(evaluation / "numbers.csv", dtype=str, keep_default_na=False)
    listed = numbers[(numbers["step"] == "") & numbers["scope"].isin(SCOPES)]
    results = cells.merge(listed[["artefact", *COLUMNS]], on="artefact", suffixes=("_of_cell", ""))
    results.drop(columns="artefact").to_csv(evaluation / "results.csv", index=False, lineterminator="\n")


def status_lines(run: Path) -> list[str]:
    """How far a run is: a line of numbers, then what runs or failed with the last line of its log; done: none."""
    states = [(cell, cell.state(run)) for cell in read_plan(run)]
    counts = Counter(state for _, state in states)
    if counts[DONE] == len(states):
        return []
    numbers = ", ".join(f"{counts[state]} {state}" for state in (RUNNING, FAILED, WAITING) if counts[state])
    lines = [f"{run}: {counts[DONE]} of {len(states)} cells done, {numbers}"]
    for cell, state in states:
        if state in (RUNNING, FAILED):
            lines.append(f"  {state} {cell.name}: {cell.last_words(run)}")
    return lines
