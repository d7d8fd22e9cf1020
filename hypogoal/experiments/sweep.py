"""Many cells with one command (Spec A6, G4). A cell is one command of hypogoal with an output of its own.

The plan is ``sweep.json``. A cell is done when its output is there, runs while its draft is locked, and has failed if
its last attempt did (``logs/NAME.code``). Nothing else is recorded: a run may be killed and started again anywhere.
"""

import multiprocessing
import os
import re
import shlex
import shutil
import signal
import sys
import time
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from importlib import import_module
from itertools import zip_longest
from pathlib import Path
from typing import Any

from pydantic import BaseModel, Field, TypeAdapter, ValidationError

from hypogoal.core.artefacts import Draft
from hypogoal.core.errors import UserError
from hypogoal.core.files import replace_text
from hypogoal.core.own_code import environment
from hypogoal.core.processes import CORES, cores
from hypogoal.experiments.experiment import MEND, Command, Value, reason
from hypogoal.look import unfinished

PLAN = "sweep.json"
NAME = r"^\w[\w.,:=+-]*(/\w[\w.,:=+-]*)*$"  # of a cell: its place in the run's folder
PLACE = re.compile(r"(--[\w-]+=)?@(.+)")  # a word that is an output: @data, --data=@data
TAKEN = ("evaluation", "report", "logs", "slurm")  # folders of every run
DONE, RUNNING, FAILED, WAITING = "done", "running", "failed", "waiting"
STOPPED = (0, 128 + signal.SIGINT, 128 + signal.SIGTERM, -signal.SIGINT, -signal.SIGTERM)  # no failures
# Libraries use one thread per process, unless the user sets these.
THREADS = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "NUMEXPR_NUM_THREADS")
SLOW = ("torch._dynamo", "networkx", "h5py", "minigrid", "hypogoal.cli")  # imports that cells put off
OF_STAGES = {  # imports that stages put off
    "train-ensemble": "hypogoal.hypotheses.sub_goals",
    "train-options": "hypogoal.meta.training",
    "train-meta": "hypogoal.meta.training",
    "train-baseline": "hypogoal.learners.baselines.agents",
    "evaluate": "hypogoal.evaluation.questions",
}
POLL_SECONDS = 0.05


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
        words = []
        for word in self.words:
            match = PLACE.fullmatch(word)
            words.append(f"{match[1] or ''}{run / match[2]}" if match else word)
        return words if self.stage == "report" else [*words, "--out", str(run / self.place)]

    def log(self, run: Path, suffix: str = "log") -> Path:
        """What its attempts printed; with the suffix ``code``, how the last one ended."""
        return run / "logs" / f"{self.name}.{suffix}"


CELLS = TypeAdapter(list[Cell])


def cells_of(
    commands: Sequence[Command], shared: Callable[[Sequence[str]], list[str]], *, short: bool, evaluate: bool
) -> list[Cell]:
    """The cells of an experiment's commands, in which ``@NAME`` is the output of the command of that name before it.

    ``shared`` gives further words for the words of a command. ``short``: names without what tells the cells of a folder
    apart, if each folder has one cell. ``evaluate``: and report at the end.
    """
    folders = {command.name.partition("/")[0] for command in commands}
    short = short and len(folders) == len(commands)
    cells: dict[str, Cell] = {}  # by the names that the commands give
    for command in commands:
        folder = command.name.partition("/")[0]
        if command.name in cells or folder in TAKEN:
            raise UserError("a cell needs a name of its own", command.name, f"Give each value once. {MEND}")
        try:
            stage, *rest = shlex.split(command.command)
            words = [stage, *rest]
            matches = [PLACE.fullmatch(word) for word in words]
            sources = {match[2]: cells[match[2]] for match in matches if match}
        except (ValueError, KeyError) as error:
            problem = f"the command cannot be read, or reads what no cell before it makes ({error})"
            raise UserError(problem, command.name, MEND) from None
        for number, match in enumerate(matches):
            if match:
                words[number] = f"{match[1] or ''}@{sources[match[2]].place}"
        words[2:2] = shared(words)  # before the command's own, which win: of two settings of a name the last counts
        try:
            cells[command.name] = Cell(
                name=folder if short else command.name,
                words=words,
                needs=[source.name for source in sources.values()],
                columns=dict(command.columns),
            )
        except ValidationError as error:
            raise UserError(f"the cell's name becomes a file's ({reason(error)})", command.name, MEND) from None
    everything = [cell.name for cell in cells.values()]
    if evaluate:
        cells["evaluation"] = Cell(name="evaluation", words=["evaluate", "@."], needs=everything)
        cells["report"] = Cell(name="report", words=["report", "@."], needs=["evaluation"])
    return [*cells.values()]


def read_plan(run: Path) -> list[Cell]:
    """The cells of a run, none if no experiment was begun there; a damaged plan is a ``UserError``."""
    path = run / PLAN
    if not path.exists():
        return []
    try:
        return CELLS.validate_json(path.read_bytes())
    except ValidationError as error:
        problem = f"the plan is damaged, or of another version ({reason(error)})"
        raise UserError(problem, path, "Remove it: what is complete is kept.") from None


def unmade(run: Path) -> list[str]:
    """The names of the cells that a run was to have and has not."""
    return [cell.name for cell in read_plan(run) if not cell.is_derived and not cell.is_done(run)]


def begin(cells: Sequence[Cell], run: Path, anew: Sequence[Cell] = ()) -> None:
    """Write the plan, and remove what cells to be made ``anew`` made. A run that has made others is a ``UserError``."""
    ours = {cell.name: cell for cell in cells}
    renewed = {cell.name for cell in anew}
    for old in read_plan(run):
        if not (old.is_derived or old.name in renewed):
            _check_same(old, ours.get(old.name), run)
    discard(anew, run)
    todo = [cell for cell in cells if not cell.is_done(run)]
    if not all(cell.is_derived for cell in todo):
        discard([cell for cell in cells if cell.is_derived], run)  # they are of less than there will be
    for cell in todo:
        cell.log(run).parent.mkdir(parents=True, exist_ok=True)
        cell.log(run, "code").unlink(missing_ok=True)
    replace_text(run / PLAN, CELLS.dump_json([*cells], indent=1).decode() + "\n")


def _check_same(old: Cell, new: Cell | None, run: Path) -> None:
    """Refuse (``UserError``) a plan that lacks a cell of which there is something, or has other words for it."""
    if not (old.is_done(run) or old.draft(run).folder.exists()):
        return
    do = "Give the settings it was begun with, --from STAGE to make a stage anew with these, or another --out."
    if new is None:
        raise UserError(f"the run here has a cell that this one lacks: {old.name}", run, do)
    for first, second in zip_longest(old.words, new.words, fillvalue=""):
        if first != second:
            raise UserError(f"{old.name} was begun with {first!r}, not {second!r}", run, do)


def discard(cells: Sequence[Cell], run: Path) -> None:
    """Remove what cells made or began; one that is being made is a ``UserError``."""
    for cell in cells:
        if cell.draft(run).is_locked:
            raise UserError(f"another process makes {cell.name}", run, "Wait until it is done, or end it.")
    for cell in cells:
        shutil.rmtree(cell.draft(run).folder, ignore_errors=True)
        if cell.stage == "collect":
            (run / cell.place).unlink(missing_ok=True)
        elif cell.is_done(run):
            shutil.rmtree(run / cell.place)


@dataclass
class _Running:
    cell: Cell
    process: Any
    cores: int
    since: float


def run_local(
    cells: Sequence[Cell], run: Path, *, workers: int, say: Callable[[str], None], forked: bool | None = None
) -> dict[str, str]:
    """Run cells that are not done on this machine, in their order; by name, why those failed that did.

    They share ``workers`` cores (0: all). A cell that fails holds only those that need it. One that another process is
    making, left over by a run that was killed, is waited for. ``forked``: cells start from one process that has
    imported what they need; by default on Linux without CUDA.
    """
    todo = [*cells]
    needed = {cell.name: cell for cell in read_plan(run)}
    running: list[_Running] = []
    failed: dict[str, str] = {}
    start = _starter(cells, run, forked)
    try:
        while True:
            todo = [cell for cell in todo if not cell.is_done(run)]
            done = {name for name, cell in needed.items() if cell.is_done(run)}
            makeable = [cell for cell in todo if done.issuperset(cell.needs)]
            ready = [cell for cell in makeable if not cell.draft(run).is_locked]
            free = (workers or cores()) - sum(each.cores for each in running)
            while ready and free > 0:
                share = max(1, free // len(ready))
                cell = ready.pop(0)
                todo.remove(cell)
                say(f"{cell.name} ...; {len(todo)} to come")
                running.append(_Running(cell, start(cell, share), share, time.monotonic()))
                free -= share
            if not running and not makeable:
                return failed
            time.sleep(POLL_SECONDS)
            for each in [each for each in running if each.process.exitcode is not None]:
                running.remove(each)
                fault = _ended(each.cell, run, each.process.exitcode)
                if not fault:
                    say(f"{each.cell.name} done in {time.monotonic() - each.since:.0f} s")
                elif each.cell.draft(run).is_locked:  # by a process that is left over
                    todo.append(each.cell)
                else:
                    failed[each.cell.name] = fault
                    say(f"{each.cell.name} FAILED: {fault}")
    finally:
        for each in running:
            each.process.terminate()
        for each in running:
            each.process.join()
            _ended(each.cell, run, each.process.exitcode)


def _ended(cell: Cell, run: Path, code: int) -> str:
    """Write down how an attempt ended; why it failed, empty if it did not."""
    done = cell.is_done(run)
    replace_text(cell.log(run, "code"), f"{code if code or done else 1}\n")
    if code == 0:
        return "" if done else f"it ended as if all were well, but made nothing ({cell.log(run)})"
    last = f"ended by signal {-code}" if code < 0 else last_line(cell.log(run))
    return f"{last} ({cell.log(run)})"


def _starter(cells: Sequence[Cell], run: Path, forked: bool | None) -> Callable[[Cell, int], Any]:
    """What starts a cell with so many cores: in a fork of a process that has imported its stage, or in a fresh one."""
    if forked is None:
        forked = sys.platform == "linux" and not any("cuda" in cell.words for cell in cells)
    context: Any = multiprocessing.get_context("forkserver" if forked else "spawn")
    if forked:
        modules = {OF_STAGES[cell.stage] for cell in cells if cell.stage in OF_STAGES}
        context.set_forkserver_preload([*SLOW, *sorted(modules)])

    def start(cell: Cell, cores: int) -> Any:
        before = dict(os.environ)
        variables = {**dict.fromkeys(THREADS, "1"), **before, **environment(), CORES: str(cores)}
        words = [*cell.command(run), "--resume"]
        process = context.Process(target=_run_cell, args=(words, str(cell.log(run)), variables))
        os.environ.update(variables, PYTHONSAFEPATH="1")  # a process that starts others imports no random.py from here
        try:
            process.start()
        finally:
            os.environ.clear()
            os.environ.update(before)
        return process

    return start


def _run_cell(words: list[str], log: str, variables: dict[str, str]) -> None:
    """In a cell's process: the command, as one types it, with this environment; its output goes into its log."""
    os.environ.clear()
    os.environ.update(variables)
    printed = os.open(log, os.O_WRONLY | os.O_APPEND | os.O_CREAT, 0o666)
    os.dup2(os.open(os.devnull, os.O_RDONLY), 0)
    for number in (1, 2):
        os.dup2(printed, number)
    sys.stdout, sys.stderr = (os.fdopen(number, "w", 1, encoding="utf-8", closefd=False) for number in (1, 2))
    sys.argv = ["hypogoal", *words]
    sys.exit(import_module("hypogoal.cli").main())


def last_line(log: Path) -> str:
    """The last line of a log, of an error without the program's name."""
    lines = log.read_text(encoding="utf-8", errors="replace").splitlines() if log.exists() else []
    return lines[-1].removeprefix("hypogoal: ") if lines else ""


def state_of(cell: Cell, run: Path) -> str:
    """Whether a cell is done, runs, failed or waits."""
    if cell.is_done(run):
        return DONE
    if cell.draft(run).is_locked:
        return RUNNING
    code = cell.log(run, "code")
    return FAILED if code.exists() and int(code.read_text()) not in STOPPED else WAITING


def status_lines(run: Path) -> list[str]:
    """How far a run is: a line of numbers, then what runs or failed with the last line of its log; done: none."""
    cells = read_plan(run)
    states = [state_of(cell, run) for cell in cells]
    counts = Counter(states)
    if counts[DONE] == len(cells):
        return []
    numbers = ", ".join(f"{counts[state]} {state}" for state in (RUNNING, FAILED, WAITING) if counts[state])
    lines = [f"{run}: {counts[DONE]} of {len(cells)} cells done, {numbers}"]
    for cell, state in zip(cells, states, strict=True):
        if state in (RUNNING, FAILED):
            lines.append(f"  {state} {cell.name}: {last_line(cell.log(run))} ({cell.log(run)})")
    return lines


def in_the_making(path: Path) -> list[str]:
    """A line for each output at or below a path that is not complete; of a run how far it is."""
    return status_lines(path) if (path / PLAN).exists() else unfinished(path)
