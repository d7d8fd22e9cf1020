"""What a run holds: which artefacts are evaluated, their tables, and the evaluation as read back (Spec A5, A8).

Each damaged file is told in one line (Spec G2).
"""

from __future__ import annotations

import contextlib
import csv
import inspect
import io
import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Self, TypeVar

import numpy as np
from numpy.typing import NDArray

from hypogoal.core.artefacts import MANIFEST, Artefact, file_fault, find_artefacts, sha256_of
from hypogoal.core.commands import advice
from hypogoal.core.errors import UserError
from hypogoal.core.files import plain_name, read_json, read_text
from hypogoal.core.hdf5 import members, open_hdf5, read_array, walk

AGAIN = "Evaluate the run again."
WINDOW = 100  # episodes at the end of training by which an agent is judged
LAST = 100  # executions of an option that count
MOST = 2**53  # integers that a float holds
MOST_OPTIONS = 2**16
MAX_TABLE_BYTES = 2**30
BLANK = ("best_near", "best_far")  # columns whose cells may be empty, NaN
FORMAT = 2  # of ``metrics.json``: 1 until 0.15
PARTS = (  # of it
    *("agents", "layouts", "rooms", "distance", "exploits", "hypotheses", "ranking", "explorer", "saliency"),
    *("selection", "choosing", "ensembles", "settings", "missing", "provenance", "quantities", "comparisons"),
)
Table = TypeVar("Table")


@dataclass(frozen=True)
class Contents:
    """The artefacts of a run that are evaluated."""

    run: Path  # its folder
    ensembles: list[Artefact]  # every one
    agents: list[Artefact]  # what plays a layout: metas, options that no meta continues, baselines
    ladders: list[Artefact]  # options learned from a named start each, with a table of where they stopped
    silent: list[Artefact]  # options learned from a named start without that table; they are not evaluated
    continued: list[Artefact]  # options that a meta artefact continues, and so is judged by

    def everything(self) -> list[Artefact]:
        """All of them."""
        return [*self.ensembles, *self.agents, *self.ladders]

    def name(self, artefact: Artefact) -> str:
        """Its path within the run."""
        return artefact.path.relative_to(self.run).as_posix()


def find(run: Path) -> Contents:
    """The artefacts to evaluate: options that a meta artefact continues are part of that one.

    None, or a damaged one, is a ``UserError``.
    """
    metas, learned = find_artefacts(run, "meta"), find_artefacts(run, "options")
    inputs = [
        (artefact.path / entry["relative"]).resolve() for artefact in metas for entry in artefact.manifest["inputs"]
    ]
    continued = [artefact for artefact in learned if artefact.path.resolve() in inputs]
    ladders: list[Artefact] = []
    silent: list[Artefact] = []
    others: list[Artefact] = []
    for artefact in learned:
        if artefact not in continued:
            has_table = "executions.csv" in artefact.manifest["files"]
            (ladders if has_table else silent if artefact.config.get("start") else others).append(artefact)
    agents = [*metas, *others, *find_artefacts(run, "baseline")]
    contents = Contents(run, find_artefacts(run, "ensemble"), agents, ladders, silent, continued)
    if not contents.everything():
        raise UserError("nothing to evaluate", run, advice("Train something into it first", "run", "--help"))
    return contents


def most_used(contents: Contents) -> int | None:
    """Which of the ensembles with the most members the most artefacts were learned from; the first of several."""
    learned = [artefact for artefact in (*contents.agents, *contents.ladders) if takes(artefact)]
    users = [artefact.input("ensemble").resolve() for artefact in learned]
    rank = [(artefact.config["members"], users.count(artefact.path.resolve())) for artefact in contents.ensembles]
    return max(range(len(rank)), key=lambda index: rank[index], default=None)


def takes(artefact: Artefact) -> bool:
    """Whether it was learned with the verdicts of an ensemble's members."""
    return artefact.kind != "baseline" and artefact.config["termination"] != "oracle"


def thresholds_of(artefact: Artefact) -> NDArray[np.float64]:
    """The probabilities (G*K,) above which an artefact's options end; they may have fallen while it learned.

    NaN where options end at true sub-goals, and of files from before 0.7.
    """
    from hypogoal.core.tensors import load_tensors  # with PyTorch, which a report needs not
    from hypogoal.options.termination import THRESHOLDS, thresholds_in

    options = len(artefact.config["sub_goals"]) * artefact.config["members"]
    saved = load_tensors(artefact.path / "options.safetensors", THRESHOLDS) if takes(artefact) else {}
    if not saved:
        return np.full(options, np.nan)
    return 1 / (1 + np.exp(-thresholds_in(saved, options).astype(np.float64)))


def within(contents: Contents, source: Artefact) -> str | None:
    """An ensemble's path within the run; None where it is not one of the run's."""
    same = (artefact for artefact in contents.ensembles if artefact.path.resolve() == source.path.resolve())
    return next(map(contents.name, same), None)


class Columns:
    """Rows of a table, a field for each column: arrays (n,)."""

    def at(self, rows: Any) -> Self:
        """Some of them, by whatever NumPy takes for an index."""
        return type(self)(*(getattr(self, name)[rows] for name in inspect.signature(type(self)).parameters))


@dataclass(frozen=True)
class Episodes(Columns):
    """A run's training episodes in the order in which they ended; arrays (n,)."""

    step: NDArray[np.int64]  # environment steps when it ended, summed over parallel environments and stages
    length: NDArray[np.int64]  # steps
    reward: NDArray[np.float64]  # undiscounted
    terminated: NDArray[np.bool_]  # it reached a terminal state; else it was cut at the cap
    # Spec F5: as its domain says; else, and in tables of before this column, it terminated, and with a reward: an agent
    # that dies reaches a terminal state too.
    succeeded: NDArray[np.bool_] = None  # type: ignore[assignment]

    def __post_init__(self) -> None:
        if self.succeeded is None:
            object.__setattr__(self, "succeeded", self.terminated & (self.reward > 0))  # type: ignore[unreachable]

    def last(self, count: int = WINDOW) -> Episodes:
        """The last ``count`` episodes, or all where there are fewer."""
        return self.at(slice(max(0, len(self.step) - count), None))


@dataclass(frozen=True)
class Choices(Columns):
    """Rows of ``choices.csv``, arrays (n,): one row per option and window of steps that ends at ``step``."""

    step: NDArray[np.int64]
    option: NDArray[np.int64]
    offered: NDArray[np.int64]
    chosen: NDArray[np.int64]
    expected: NDArray[np.float64]
    reached: NDArray[np.int64]
    duration: NDArray[np.int64]

    def total(self, name: str, options: int) -> NDArray[np.float64]:
        """The sum of column ``name`` over all windows, (O,)."""
        return np.bincount(self.option, weights=getattr(self, name), minlength=options).astype(np.float64)


@dataclass(frozen=True)
class Executions(Columns):
    """Executions of options in the order in which they ended, arrays (n,): the rows of ``executions.csv``."""

    step: NDArray[np.int64]  # environment steps when it ended
    option: NDArray[np.int64]  # g*K + k
    duration: NDArray[np.int64]  # steps
    reached: NDArray[np.bool_]  # its own termination classifier said yes
    inside_at_start: NDArray[np.bool_]  # that classifier said yes where it began
    terminated: NDArray[np.bool_]  # the episode ended in a terminal state: the agent died
    room: NDArray[np.int64]  # where it stopped; x and y too
    x: NDArray[np.int64]
    y: NDArray[np.int64]
    distance: NDArray[np.int64]  # from there to the nearest true sub-goal, in the domain's units

    def of(self, option: int, last: int = LAST) -> Executions:
        """The last executions of one option."""
        return self.at(np.flatnonzero(self.option == option)[-last:])

    def positions(self) -> NDArray[np.int64]:
        """Where they stopped, (n, 3)."""
        return np.stack([self.room, self.x, self.y], axis=1)


def read_episodes(path: Path) -> Episodes:
    """``episodes.csv``: step, length, reward, terminated, succeeded."""
    kinds = {"reward": np.float64, "terminated": np.bool_, "succeeded": np.bool_}
    return _read(Episodes, path, kinds, ("succeeded",))


def read_choices(path: Path) -> Choices:
    """``choices.csv``: one row per option and window."""
    return _read(Choices, path, {"expected": np.float64})


def read_executions(path: Path) -> Executions:
    """``executions.csv``: one row per execution of an option, in the order in which they ended."""
    return _read(Executions, path, dict.fromkeys(("reached", "inside_at_start", "terminated"), np.bool_))


def _read(kind: type[Table], path: Path, kinds: Mapping[str, Any], optional: Sequence[str] = ()) -> Table:
    """A table with a column for each field, int64 where ``kinds`` says nothing else; ``optional`` ones may lack."""
    table = read_table(path, [name for name in inspect.signature(kind).parameters if name not in optional], optional)
    return kind(**{name: column.astype(kinds.get(name, np.int64)) for name, column in table.items()})


def read_layout(path: Path) -> dict[str, Any]:
    """``layout.json``: layout_seed, shortest_path, random_success, random_episodes; of many layouts also layouts."""
    facts = read_json(path, "the layout's file is", AGAIN)
    wanted = {"layout_seed": int, "shortest_path": int | None, "random_success": float | int | None}
    fits = isinstance(facts, dict) and all(isinstance(facts.get(key, ...), kind) for key, kind in wanted.items())
    if not fits or not 0 <= facts["layout_seed"] < MOST or type(facts.get("random_episodes")) is not int:
        raise UserError("the layout's file is damaged", path, AGAIN)
    more = {"layouts": facts["layouts"]} if isinstance(facts.get("layouts"), str) else {}
    return {key: facts[key] for key in (*wanted, "random_episodes")} | more


def read_terminations(path: Path) -> dict[int, NDArray[Any]]:
    """``terminations.h5``: option -> the last states in which its classifier ended it, (n, *obs)."""
    with open_hdf5(path, "the file of terminations", AGAIN) as file:
        try:
            return {int(name): read_array(file, name, "uf") for name in members(file)}
        except ValueError as error:  # a name that is no number
            raise UserError(f"the file of terminations is damaged ({error})", path, AGAIN) from None


def read_table(
    path: Path, columns: Sequence[str] | None = None, optional: Sequence[str] = ()
) -> dict[str, NDArray[np.float64]]:
    """Columns of a table of numbers, a CSV file with a header; float (n,) each.

    ``columns`` are those that must be there; all that are where None; ``optional`` those that may be. A file that is
    missing, too large, no table, or holds anything but finite numbers of at most 2^53 (or, in a ``BLANK`` column,
    nothing) is a ``UserError``.
    """
    text = read_text(path, "the table is", AGAIN, MAX_TABLE_BYTES)
    try:
        reader = csv.DictReader(io.StringIO(text, newline=""))
        header = list(reader.fieldnames or ())
        columns = header if columns is None else [*columns, *(name for name in optional if name in header)]
        if not set(columns) <= set(header):
            raise KeyError(path)
        rows = [
            [math.nan if row[column] == "" and column in BLANK else float(row[column]) for column in columns]
            for row in reader
        ]
    except (ValueError, KeyError, TypeError, csv.Error):
        raise UserError("the table is damaged", path, AGAIN) from None
    values = np.array(rows, dtype=np.float64).reshape(len(rows), len(columns))
    # NaN is no number, and of an integer column nothing may be lost.
    if not ((np.abs(values) < MOST) | (np.isnan(values) & np.isin(columns, BLANK))).all():
        raise UserError("a number in the table is missing or too large", path, AGAIN)
    table = {name: values[:, index] for index, name in enumerate(columns)}
    options = table.get("option", np.zeros(0))
    if not ((options >= 0) & (options < MOST_OPTIONS)).all():
        raise UserError("an option in the table has an impossible number", path, AGAIN)
    return table


@dataclass(frozen=True)
class Evaluated:
    """A run that was evaluated: ``metrics`` of ``metrics.json``, ``arrays`` of ``arrays.h5`` by name."""

    source: Artefact
    metrics: Mapping[str, Any]
    arrays: Mapping[str, NDArray[Any]]


@contextlib.contextmanager
def fitting(where: object) -> Iterator[None]:
    """Drawing an evaluation, whose numbers are a file's: what does not fit is told in one line."""
    try:
        yield
    except (LookupError, TypeError, ValueError, AttributeError, ArithmeticError) as error:
        raise UserError("the evaluation does not fit this hypogoal, or is damaged", where, AGAIN) from error


def read_evaluation(run: Path, start: str = "") -> Evaluated:
    """The evaluation of a run: that in ``run/evaluation`` where there are several.

    Of the arrays only those whose names begin with ``start``. What was made since is among ``missing``. A run that was
    not evaluated, or a damaged evaluation, is a ``UserError``.
    """
    evaluations = find_artefacts(run, "evaluation")
    if not evaluations:
        raise UserError("this run was not evaluated", run, advice("First run", "evaluate", run))
    source = next((artefact for artefact in evaluations if artefact.path == run / "evaluation"), evaluations[0])
    source.whole()
    metrics = _metrics(source.path / "metrics.json")
    metrics["missing"] = [*metrics["missing"], *_since(run, source)]
    with open_hdf5(source.path / "arrays.h5", "the evaluation's arrays", AGAIN) as file:
        arrays = {name: read_array(file, name, "uibfS") for name in walk(file) if name.startswith(start)}
    return Evaluated(source, metrics, arrays)


def read_numbers(source: Artefact) -> Mapping[str, Any]:
    """``metrics.json`` of an evaluation artefact; a ``UserError`` where it is damaged."""
    path = source.path / "metrics.json"
    fault = file_fault(source.path, path.name, source.manifest["files"].get(path.name, ""))
    if fault:
        raise UserError(f"the evaluation's file is {fault}", path, AGAIN)
    return _metrics(path)


def _since(run: Path, source: Artefact) -> list[str]:
    """A line for each artefact of the run that the evaluation does not know: it was made, or made again, since."""
    evaluated = {entry["sha256"] for entry in source.manifest["inputs"]}
    try:
        contents = find(run)
    except UserError:  # evaluations may lie where nothing else does
        return []
    names = [
        contents.name(artefact)
        for artefact in contents.everything()
        if sha256_of(artefact.path / MANIFEST) not in evaluated
    ]
    elsewhere = [] if source.path == run / "evaluation" else ["--out", source.path]
    do = advice("evaluate it again", "evaluate", run, *elsewhere, "--force") if names else ""
    return [f"{name}: made since this evaluation ({do})" for name in names]


def _metrics(path: Path) -> dict[str, Any]:
    metrics = read_json(path, "the evaluation is", AGAIN)
    if not isinstance(metrics, dict):
        raise UserError("the evaluation is damaged", path, AGAIN)
    if (made_with := metrics.get("format", 1)) != FORMAT:
        difference = f"another version of hypogoal evaluated this (format {made_with}, needed: {FORMAT})"
        raise UserError(difference, path, "Evaluate the run again, with --force.")
    lacking = [part for part in PARTS if part not in metrics]
    if lacking:
        raise UserError(f"the evaluation is damaged (no {', '.join(lacking)})", path, AGAIN)
    for name in _sub_goals(metrics):
        if not plain_name(name):
            raise UserError(f"a sub-goal in the evaluation has an invalid name, {name!r}", path, AGAIN)
    return metrics


def _sub_goals(part: Any) -> Iterator[Any]:
    if isinstance(part, dict):
        yield from [part["sub_goal"]] if "sub_goal" in part else []
    for inner in part.values() if isinstance(part, dict) else part if isinstance(part, list) else ():
        yield from _sub_goals(inner)
