"""Many cells with one command (Spec A6, G4). A cell is one command of hypogoal with an output of its own.

The plan is ``sweep.json``. A cell is done when its output is there, runs while its draft is locked, and has failed if
its last attempt did (``logs/NAME.code``). Nothing else is recorded: a run may be killed and started again anywhere.
"""

import contextlib
import multiprocessing
import os
import re
import shlex
import shutil
import signal
import sys
import time
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from importlib import import_module
from itertools import zip_longest
from pathlib import Path
from typing import Any, Literal

from pydantic import BaseModel, ConfigDict, Field, ValidationError

from hypogoal.core.artefacts import Draft
from hypogoal.core.config import STAGES
from hypogoal.core.errors import UserError
from hypogoal.core.files import replace_text
from hypogoal.core.own_code import environment
from hypogoal.core.processes import CORES
from hypogoal.core.terminal import amount
from hypogoal.experiments.experiment import MEND, Command, Value
from hypogoal.look import unfinished

SAFE_PATH = {"PYTHONSAFEPATH": "1"}  # of a Python that multiprocessing starts
PLAN, LOGS = "sweep.json", "logs"
NAME = r"^\w[\w.,:=+-]*(/\w[\w.,:=+-]*)*$"  # of a cell: its place in the run's folder
OPTION = re.compile(r"--[\w-]+=")  # before the place of an output: --data=@data
TAKEN = (LOGS, "slurm")  # folders of every run
DERIVED = ("evaluate", "report")  # stages that only read a run: made again in minutes
RESERVED = ("--out", "--force", "--resume")  # which the run gives
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
POLL_SECONDS, REPORT_SECONDS = 0.05, 15.0
MOST_SHOWN = 20


class Cell(BaseModel):
    """One command of an experiment. ``@PLACE`` in its words is a place in the run's folder."""

    model_config = ConfigDict(frozen=True)

    name: str = Field(pattern=NAME)
    words: list[str] = Field(min_length=1)
    needs: list[str] = []  # names of cells whose outputs it reads
    columns: dict[str, Value] = {}  # of ``results.csv``

    @property
    def stage(self) -> str:
        """Its command: train-meta, ..."""
        return self.words[0]

    @property
    def place(self) -> str:
        """Its output in the run's folder."""
        return f"{self.name}.h5" if self.stage == "collect" else self.name

    def out(self, run: Path) -> Path:
        """Its output."""
        return run / self.place

    def command(self, run: Path) -> list[str]:
        """Its words as one types them after ``hypogoal``."""
        words = []
        for word in self.words:
            option, at, place = word.partition("@")
            is_place = at and (not option or OPTION.fullmatch(option))
            words.append(f"{option}{run / place}" if is_place else word)
        return words if self.stage == "report" else [*words, "--out", str(self.out(run))]

    def log(self, run: Path, suffix: str = "log") -> Path:
        """What its attempts printed; with the suffix ``code``, how the last one ended."""
        return run / LOGS / f"{self.name}.{suffix}"


class Plan(BaseModel):
    """What ``sweep.json`` holds."""

    format: Literal[4] = 4
    cells: list[Cell]  # in an order in which they can run


def cells_of(commands: Iterable[Command], common: Mapping[str, Sequence[str]], *, short: bool = False) -> list[Cell]:
    """The cells of an experiment's commands, in which ``@NAME`` is the output of the command of that name before it.

    ``common`` are further words for all cells of a stage. ``short``: names without what tells the cells of a folder
    apart, if each folder has one cell.
    """
    commands = [*commands]
    folders = Counter(command.name.partition("/")[0] for command in commands)
    short = short and len(folders) == len(commands)
    cells: dict[str, Cell] = {}  # by the names that the commands give
    for command in commands:
        where = f"cell {command.name!r}"
        words = _words(command, where)
        needs = []
        for number, word in enumerate(words):
            option, at, source = word.partition("@")
            if not at or (option and not OPTION.fullmatch(option)):
                continue
            if source not in cells:
                raise UserError(f"{command.name} would read what no cell before it makes", source, MEND)
            needs.append(cells[source].name)
            words[number] = f"{option}@{cells[source].place}"
        # Words for all cells of a stage stand before the cell's own: the last setting of a name counts, so that --set
        # cannot turn a method or a control into another.
        words[2:2] = common.get(words[0], ())
        folder = command.name.partition("/")[0]
        name = folder if short else command.name
        if command.name in cells or folder in TAKEN:
            raise UserError("cells need a name of their own", where, f"Give each value once. {MEND}")
        try:
            cells[command.name] = Cell(name=name, words=words, needs=needs, columns=dict(command.columns))
        except ValidationError as error:
            problem = "the name must be fit for a file, columns texts or numbers"
            raise UserError(f"{problem} ({error.errors()[0]['msg']})", where, MEND) from None
    return [*cells.values()]


def _words(command: Command, where: str) -> list[str]:
    try:
        words = shlex.split(command.command)
    except ValueError as error:
        raise UserError(f"the command cannot be read ({error})", where, MEND) from None
    if not words or words[0] not in STAGES:
        raise UserError("the command must be a stage", where, f"Choose one of {', '.join(STAGES)}.")
    if any(word.split("=")[0] in RESERVED for word in words):
        raise UserError(f"{', '.join(RESERVED)} are given by the run", where, MEND)
    return words


def closing_cells(cells: Sequence[Cell]) -> list[Cell]:
    """Evaluate and report, when everything else is complete."""
    everything = [cell.name for cell in cells]
    return [
        Cell(name="evaluation", words=["evaluate", "@."], needs=everything),
        Cell(name="report", words=["report", "@."], needs=["evaluation"]),
    ]


def read_plan(run: Path) -> list[Cell]:
    """The cells of a run; none, or a damaged plan, is a ``UserError``."""
    path = run / PLAN
    try:
        return Plan.model_validate_json(path.read_bytes()).cells
    except FileNotFoundError:
        raise UserError("no experiment was begun here", run, "Give the --out of 'hypogoal run'.") from None
    except ValidationError as error:
        fault = error.errors()[0]
        problem = f"the plan is damaged, or of another version ({fault['msg']})"
        raise UserError(problem, path, "Remove it: what is complete is kept.") from None


def unmade(run: Path) -> list[str]:
    """The names of the cells that a run was to have and has not; without a plan none."""
    if not (run / PLAN).exists():
        return []
    return [cell.name for cell in read_plan(run) if cell.stage not in DERIVED and not cell.out(run).exists()]


def begin(cells: Sequence[Cell], run: Path, anew: Sequence[Cell] = ()) -> None:
    """Write the plan, and remove what cells to be made ``anew`` made. A run that has made others is a ``UserError``."""
    if (run / PLAN).exists():
        names = {cell.name for cell in anew}
        _check_same([cell for cell in read_plan(run) if cell.name not in names], cells, run)
    discard(anew, run)
    todo = [cell for cell in cells if not cell.out(run).exists()]
    if any(cell.stage not in DERIVED for cell in todo):
        discard([cell for cell in cells if cell.stage in DERIVED], run)  # of less than there will be
    for cell in todo:
        cell.log(run).parent.mkdir(parents=True, exist_ok=True)
        cell.log(run, "code").unlink(missing_ok=True)
    replace_text(run / PLAN, Plan(cells=[*cells]).model_dump_json(indent=1) + "\n")


def _check_same(before: Sequence[Cell], cells: Sequence[Cell], run: Path) -> None:
    """Refuse (``UserError``) cells that lack one of those that were begun before, or have other words for it."""
    do = "Give the settings it was begun with, --from STAGE to make a stage anew with these, or another --out."
    now = {cell.name: cell for cell in cells}
    for old in before:
        if old.stage in DERIVED or not (old.out(run).exists() or Draft(old.out(run)).folder.exists()):
            continue
        if old.name not in now:
            raise UserError(f"the run here has a cell that this one lacks: {old.name}", run, do)
        for first, second in zip_longest(old.words, now[old.name].words, fillvalue=""):
            if first != second:
                raise UserError(f"{old.name} was begun with {first!r}, not {second!r}", run, do)


def discard(cells: Sequence[Cell], run: Path) -> None:
    """Remove what cells made or began; one that is being made is a ``UserError``."""
    for cell in cells:
        if Draft(cell.out(run)).is_locked:
            do = "Wait until it is done, or end it."
            raise UserError(f"{cell.name} is being made by another process", run, do)
    for cell in cells:
        for place in (cell.out(run), Draft(cell.out(run)).folder):
            if place.is_dir():
                shutil.rmtree(place)
            else:
                place.unlink(missing_ok=True)


def of_stage(cells: Sequence[Cell], stage: str, *, and_after: bool = False) -> list[Cell]:
    """The cells of a stage and, with ``and_after``, all that read what these make; none is a ``UserError``."""
    names = {cell.name for cell in cells if cell.stage == stage}
    if not names:
        stages = dict.fromkeys(cell.stage for cell in cells)
        raise UserError("this run has no such stage", stage, f"Choose one of {', '.join(stages)}.")
    for cell in cells if and_after else ():  # those that a cell needs are before it
        if not names.isdisjoint(cell.needs):
            names.add(cell.name)
    return [cell for cell in cells if cell.name in names]


@dataclass
class _Running:
    cell: Cell
    process: Any
    cores: int
    since: float


def run_local(
    cells: Sequence[Cell], run: Path, *, workers: int, say: Callable[[str], None], forked: bool | None = None
) -> dict[str, str]:
    """Run those cells that are not done on this machine, in their order; by name, why those failed that did.

    They share ``workers`` cores. A cell that fails holds only those that need it. One that another process is making,
    left over by a run that was killed, is waited for. ``forked``: cells start from one process that has imported what
    they need; by default on Linux without CUDA.
    """
    todo = [cell for cell in cells if not cell.out(run).exists()]
    needed = {cell.name: cell for cell in read_plan(run)}
    running: list[_Running] = []
    failed: dict[str, str] = {}
    reported = time.monotonic()
    start = _starter(todo, run, forked)
    try:
        while True:
            makeable = [cell for cell in todo if all(needed[need].out(run).exists() for need in cell.needs)]
            ready = [cell for cell in makeable if not Draft(cell.out(run)).is_locked]
            while ready and (free := workers - sum(each.cores for each in running)) > 0:
                cores = max(1, free // len(ready))
                cell = ready.pop(0)
                todo.remove(cell)
                makeable.remove(cell)
                if not cell.out(run).exists():  # another process has just made it
                    running.append(_Running(cell, start(cell, cores), cores, time.monotonic()))
                    say(f"[{len(cells) - len(todo)}/{len(cells)}] {cell.name} ...")
            if not running and not makeable:
                return failed
            time.sleep(POLL_SECONDS)
            for each in [each for each in running if each.process.exitcode is not None]:
                running.remove(each)
                if reason := _ended(each.cell, run, each.process.exitcode):
                    failed[each.cell.name] = reason
                    say(f"{each.cell.name} FAILED: {reason}")
                else:
                    say(f"{each.cell.name} done in {time.monotonic() - each.since:.0f} s")
            if time.monotonic() - reported > REPORT_SECONDS:
                reported = time.monotonic()
                for each in running:
                    say(f"    {each.cell.name}: {last_line(each.cell.log(run))}")
    finally:
        for each in running:
            each.process.terminate()
        for each in running:
            each.process.join()
            _ended(each.cell, run, each.process.exitcode)


def _ended(cell: Cell, run: Path, code: int) -> str:
    """Write down how an attempt ended; why it failed, empty if it did not."""
    made = cell.out(run).exists()
    replace_text(cell.log(run, "code"), f"{code if code or made else 1}\n")
    log = cell.log(run)
    if code < 0:
        return f"ended by signal {-code}{' (out of memory?)' if code == -9 else ''}; see {log}"
    if code:
        return f"{last_line(log)} ({log})"
    return "" if made else f"it ended as if all were well, but made nothing; see {log}"


def _starter(cells: Sequence[Cell], run: Path, forked: bool | None) -> Callable[[Cell, int], Any]:
    """What starts a cell with so many cores: in a fork of a process that has imported its stage, or in a fresh one."""
    if forked is None:
        forked = sys.platform == "linux" and not any("cuda" in word for cell in cells for word in cell.words)
    context: Any = multiprocessing.get_context("forkserver" if forked else "spawn")
    if forked:
        modules = {OF_STAGES[cell.stage] for cell in cells if cell.stage in OF_STAGES}
        context.set_forkserver_preload([*SLOW, *sorted(modules)])

    def start(cell: Cell, cores: int) -> Any:
        own = {**dict.fromkeys(THREADS, "1"), **os.environ, CORES: str(cores), **environment()}
        words = [*cell.command(run), "--resume"]
        process = context.Process(target=_run_cell, args=(words, str(cell.log(run)), own))
        with with_environment(**SAFE_PATH, **{name: own[name] for name in THREADS}):
            process.start()
        return process

    return start


def _run_cell(words: list[str], log: str, own: dict[str, str]) -> None:
    """In a cell's process: the command, as one types it, with this environment; its output goes into its log."""
    os.environ.clear()
    os.environ.update(own)
    printed = os.open(log, os.O_WRONLY | os.O_APPEND | os.O_CREAT, 0o666)
    os.dup2(os.open(os.devnull, os.O_RDONLY), 0)
    os.dup2(printed, 1)
    os.dup2(printed, 2)
    sys.stdout, sys.stderr = (os.fdopen(number, "w", encoding="utf-8", buffering=1, closefd=False) for number in (1, 2))
    sys.argv = ["hypogoal", *words]
    sys.exit(import_module("hypogoal.cli").main())


def last_line(log: Path) -> str:
    """The last line of a log, of an error without the program's name."""
    if not log.exists():
        return ""
    lines = log.read_text(encoding="utf-8", errors="replace").splitlines()
    return lines[-1].removeprefix("hypogoal: ") if lines else ""


def state_of(cell: Cell, run: Path) -> str:
    """Whether a cell is done, runs, failed or waits."""
    if cell.out(run).exists():
        return DONE
    if Draft(cell.out(run)).is_locked:
        return RUNNING
    code = cell.log(run, "code")
    return FAILED if code.exists() and int(code.read_text() or 0) not in STOPPED else WAITING


def status_lines(run: Path) -> list[str]:
    """How far a run is: a line of numbers, then what runs or failed with the last line of its log; done: none."""
    if not (run / PLAN).exists():
        return []
    cells = read_plan(run)
    states = [state_of(cell, run) for cell in cells]
    counts = Counter(states)
    if counts[DONE] == len(cells):
        return []
    numbers = ", ".join(f"{counts[state]} {state}" for state in (RUNNING, FAILED, WAITING) if counts[state])
    lines = [f"{run}: {counts[DONE]} of {amount(len(cells), 'cell')} done, {numbers}"]
    for shown in (RUNNING, FAILED):
        some = [cell for cell, state in zip(cells, states, strict=True) if state == shown]
        lines += [f"  {shown} {cell.name}: {last_line(cell.log(run))} ({cell.log(run)})" for cell in some[:MOST_SHOWN]]
        if len(some) > MOST_SHOWN:
            lines.append(f"  and {len(some) - MOST_SHOWN} more {shown}")
    return lines


def in_the_making(path: Path) -> list[str]:
    """A line for each output at or below a path that is not complete; of a run how far it is."""
    return status_lines(path) if (path / PLAN).exists() else unfinished(path)


@contextlib.contextmanager
def with_environment(**values: str) -> Iterator[None]:
    """Set environment variables within the block."""
    before = {name: os.environ.get(name) for name in values}
    os.environ.update(values)
    try:
        yield
    finally:
        for name, value in before.items():
            os.environ.pop(name, None)
            os.environ.update({} if value is None else {name: value})
