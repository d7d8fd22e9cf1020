"""The cells of a run. A cell is one command of hypogoal, with its own output.

The plan is ``sweep.json``. A cell is done when its output is there, runs while its draft is locked, and has failed if
its last attempt did (``logs/NAME.code``). Nothing else is recorded, so a run may be killed and started again anywhere.
"""

from pathlib import Path

from pydantic import BaseModel, Field, TypeAdapter

from hypogoal.core.checkpoints import ANEW
from hypogoal.core.drafts import Draft
from hypogoal.core.files import reading

PLAN = "sweep.json"
NAME = r"^\w[\w.,:=+-]*(/\w[\w.,:=+-]*)*$"  # names of cells, which are places in the run's folder
HERE = "{run}"  # stands for the run's folder in a cell's words
DONE, RUNNING, FAILED, WAITING = "done", "running", "failed", "waiting"
STOPPED = ("", "130", "143", "-2", "-15")  # exit codes that are no failure: none yet, Ctrl-C, SIGTERM, or their signals
# Columns of ``numbers.csv`` that ``results.csv`` has, by the names they have there: cells have a method of their own.
COLUMNS = {
    "artefact": "cell",
    "method": "measured_method",
    "layout": "measured_layout",
    "sub_goal": "sub_goal",
    "member": "member",
    "scope": "scope",
    "quantity": "quantity",
    "value": "value",
}

Value = str | int | float


class Cell(BaseModel):
    """One command of an experiment, in the folder ``run``."""

    name: str = Field(pattern=NAME)
    words: list[str]
    needs: list[str] = []  # places of the outputs that the cell reads
    after: list[str] = []  # places of outputs whose cells get this machine's cores first
    columns: dict[str, Value] = {}  # columns of ``results.csv``
    run: Path = Field(Path(), exclude=True)  # not in the plan, because the folder may be moved

    @property
    def stage(self) -> str:
        """The name of the cell's command, such as train-meta."""
        return self.words[0]

    @property
    def is_derived(self) -> bool:
        """Whether the cell only reads the run, and is made again in minutes."""
        return self.stage in ("evaluate", "report")

    @property
    def place(self) -> str:
        """The place of the cell's output in the run's folder."""
        return f"{self.name}.h5" if self.stage == "collect" else self.name

    @property
    def out(self) -> Path:
        """The path of the cell's output."""
        return self.run / self.place

    @property
    def draft(self) -> Draft:
        """The draft of the cell's output."""
        return Draft(self.out)

    @property
    def is_done(self) -> bool:
        """Whether the cell's output is there."""
        return self.out.exists()

    @property
    def is_makeable(self) -> bool:
        """Whether the cell is not done, and all that it reads is there."""
        return not self.is_done and all((self.run / need).exists() for need in self.needs)

    @property
    def command(self) -> list[str]:
        """The cell's words, as one types them after ``hypogoal``."""
        words = [*self.words, "--out", str(self.out)]
        return [word.replace(HERE, str(self.run)) for word in words]

    def log(self, suffix: str = "log") -> Path:
        """Return the path of what the cell's attempts printed.

        With the suffix ``code``, the file says how the last attempt ended, a signal as a negative number.
        """
        return self.run / "logs" / f"{self.name}.{suffix}"

    def last_line(self, suffix: str = "log") -> str:
        """Return the last line of the file :meth:`log`, or an empty text if there is none."""
        path = self.log(suffix)
        lines = path.read_text(encoding="utf-8", errors="replace").splitlines() if path.exists() else []
        return lines[-1] if lines else ""

    @property
    def state(self) -> str:
        """Whether the cell is done, runs, failed or waits."""
        if self.is_done:
            return DONE
        if self.draft.is_locked:
            return RUNNING
        return WAITING if self.last_line("code") in STOPPED else FAILED

    @property
    def last_words(self) -> str:
        """The last line of the cell's log, or the signal that ended the cell, and where the log is.

        If the line gives advice for a single command, the advice is replaced by that for a run.
        """
        code = self.last_line("code")
        text = f"ended by signal {code[1:]}" if code.startswith("-") else self.last_line()
        text = text.replace(ANEW, f"Give --from {self.stage} and no --resume to make that stage anew.")
        return f"{text.removeprefix('hypogoal: ')} ({self.log()})"


CELLS = TypeAdapter(list[Cell])


def read_plan(run: Path) -> list[Cell]:
    """Return the cells of a run. If no experiment was begun there, the list is empty.

    Raises ``UserError`` if the plan is damaged.
    """
    path = run / PLAN
    if not path.exists():
        return []
    with reading(path, "Remove it: what is complete is kept.", "the plan"):
        cells = CELLS.validate_json(path.read_bytes())
    return [cell.model_copy(update={"run": run}) for cell in cells]


def unmade(run: Path) -> list[str]:
    """Return the names of the cells that a run was to have and does not have."""
    return [cell.name for cell in read_plan(run) if not (cell.is_derived or cell.is_done)]


def write_results(run: Path, evaluation: Path) -> None:
    """Write ``results.csv`` beside an evaluation's ``numbers.csv``: numbers with the columns of their cell.

    Learning curves are in ``numbers.csv`` alone.
    """
    import pandas

    cells = read_plan(run)
    if not cells:
        return
    rows = [{"cell": cell.name, "stage": cell.stage, **cell.columns} for cell in cells]
    outputs = pandas.DataFrame(rows, dtype=object)
    numbers = pandas.read_csv(evaluation / "numbers.csv", dtype=str, keep_default_na=False)
    of_ends = numbers.query("step == ''")[[*COLUMNS]].rename(columns=COLUMNS)
    results = outputs.merge(of_ends, on="cell", suffixes=("_of_cell", ""))
    results.to_csv(evaluation / "results.csv", index=False, lineterminator="\n")


def status_lines(run: Path) -> list[str]:
    """Return a line on how far a run is, and a line for each cell that runs or failed, with its log's last line.

    The list is empty if the run is done.
    """
    cells = read_plan(run)
    states = [cell.state for cell in cells]
    left = [state for state in (RUNNING, FAILED, WAITING) if state in states]
    if not left:
        return []
    numbers = ", ".join(f"{states.count(state)} {state}" for state in left)
    lines = [f"{run}: {states.count(DONE)} of {len(states)} cells done, {numbers}"]
    for cell, state in zip(cells, states, strict=True):
        if state in (RUNNING, FAILED):
            lines.append(f"  {state} {cell.name}: {cell.last_words}")
    return lines
