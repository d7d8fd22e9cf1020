"""The cells of a run: a cell is one command of hypogoal with an output of its own.

The plan is ``sweep.json``. A cell is done when its output is there, runs while its draft is locked, and has failed if
its last attempt did (``logs/NAME.code``). Nothing else is recorded: a run may be killed and started again anywhere.
"""

from pathlib import Path

from pydantic import BaseModel, Field, TypeAdapter

from hypogoal.core.artefacts import Draft
from hypogoal.core.checkpoints import ANEW
from hypogoal.core.files import reading

PLAN = "sweep.json"
NAME = r"^\w[\w.,:=+-]*(/\w[\w.,:=+-]*)*$"  # of a cell: its place in the run's folder
HERE = "{run}"  # in a cell's words the run's folder
DONE, RUNNING, FAILED, WAITING = "done", "running", "failed", "waiting"
STOPPED = ("", "130", "143", "-2", "-15")  # exit codes that are no failure: none yet, Ctrl-C, SIGTERM
COLUMNS = ["cell", "sub_goal", "member", "scope", "quantity", "value"]

Value = str | int | float


class Cell(BaseModel):
    """One command of an experiment, in the folder ``run``."""

    name: str = Field(pattern=NAME)
    words: list[str]
    needs: list[str] = []  # places of the outputs that it reads
    after: list[str] = []  # places of outputs that have this machine's cores before it
    columns: dict[str, Value] = {}  # of ``results.csv``
    run: Path = Field(Path(), exclude=True)  # not in the plan: the folder may be moved

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

    @property
    def out(self) -> Path:
        """Its output."""
        return self.run / self.place

    @property
    def draft(self) -> Draft:
        """The draft of its output."""
        return Draft(self.out)

    @property
    def is_done(self) -> bool:
        """Whether its output is there."""
        return self.out.exists()

    @property
    def is_makeable(self) -> bool:
        """Whether it can be made: all that it reads is there."""
        return not self.is_done and all((self.run / need).exists() for need in self.needs)

    @property
    def command(self) -> list[str]:
        """Its words as one types them after ``hypogoal``."""
        words = [*self.words, "--out", str(self.out)]
        return [word.replace(HERE, str(self.run)) for word in words]

    def log(self, suffix: str = "log") -> Path:
        """What its attempts printed; with the suffix ``code`` how the last one ended, a signal as a negative number."""
        return self.run / "logs" / f"{self.name}.{suffix}"

    def last_line(self, suffix: str = "log") -> str:
        """The last line of :meth:`log`, empty where there is none."""
        path = self.log(suffix)
        lines = path.read_text(encoding="utf-8", errors="replace").splitlines() if path.exists() else []
        return lines[-1] if lines else ""

    @property
    def state(self) -> str:
        """Whether it is done, runs, failed or waits."""
        if self.is_done:
            return DONE
        if self.draft.is_locked:
            return RUNNING
        return WAITING if self.last_line("code") in STOPPED else FAILED

    @property
    def last_words(self) -> str:
        """The last line of its log, or the signal that ended it; and where the log is. Its advice is that of a run."""
        code = self.last_line("code")
        text = f"ended by signal {code[1:]}" if code.startswith("-") else self.last_line()
        text = text.replace(ANEW, f"Give --from {self.stage} and no --resume to make that stage anew.")
        return f"{text.removeprefix('hypogoal: ')} ({self.log()})"


CELLS = TypeAdapter(list[Cell])


def read_plan(run: Path) -> list[Cell]:
    """The cells of a run, none if no experiment was begun there; a damaged plan is a ``UserError``."""
    path = run / PLAN
    if not path.exists():
        return []
    with reading(path, "Remove it: what is complete is kept.", "the plan"):
        cells = CELLS.validate_json(path.read_bytes())
    return [cell.model_copy(update={"run": run}) for cell in cells]


def unmade(run: Path) -> list[str]:
    """The names of the cells that a run was to have and has not."""
    return [cell.name for cell in read_plan(run) if not (cell.is_derived or cell.is_done)]


def write_results(run: Path, evaluation: Path) -> None:
    """Write ``results.csv`` beside an evaluation's ``numbers.csv``: each of its numbers with its cell's columns.

    Learning curves are in ``numbers.csv`` alone.
    """
    import pandas

    cells = read_plan(run)
    if not cells:
        return
    rows = [{"cell": cell.name, "stage": cell.stage, **cell.columns} for cell in cells]
    outputs = pandas.DataFrame(rows, dtype=object)
    numbers = pandas.read_csv(evaluation / "numbers.csv", dtype=str, keep_default_na=False)
    of_ends = numbers.query("step == ''").rename(columns={"artefact": "cell"})[COLUMNS]
    results = outputs.merge(of_ends, on="cell", suffixes=("_of_cell", ""))
    results.to_csv(evaluation / "results.csv", index=False, lineterminator="\n")


def status_lines(run: Path) -> list[str]:
    """How far a run is: a line of numbers, then what runs or failed with the last line of its log; done: none."""
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
