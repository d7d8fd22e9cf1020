"""What a run holds: which artefacts are evaluated, their tables, and the evaluation as read back (Spec A5, A8).

A damaged file is refused in one line (Spec G2).
"""

import contextlib
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, Field

from hypogoal.core.artefacts import AGAIN, MANIFEST, Artefact, open_artefact, sha256_of
from hypogoal.core.errors import UserError, reason
from hypogoal.core.files import read_json, visible
from hypogoal.core.own_code import command
from hypogoal.data import opened
from hypogoal.evaluation.house import EVALUATE_AGAIN, read_numbers
from hypogoal.evaluation.page import Results
from hypogoal.options.tables import MAX_INTEGER

FORMAT = 5  # of ``run.json``
DEPTH = 3  # levels of folders below a run that are searched for artefacts


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


def find_artefacts(run: Path, kind: str) -> list[Artefact]:
    """All artefacts of a kind below ``run`` and ``run`` itself, sorted by path."""
    if not run.is_dir():
        raise UserError("no such run", run, "Give the folder of a run.")
    folders = [path.parent for path in visible(run, MANIFEST)]
    near = [folder for folder in folders if len(folder.relative_to(run).parts) <= DEPTH]
    return [artefact for artefact in map(Artefact, near) if artefact.kind == kind]


def find(run: Path) -> Contents:
    """The artefacts to evaluate: options that a meta artefact continues are part of that one.

    None, or a damaged one, is a ``UserError``.
    """
    metas, learned = find_artefacts(run, "meta"), find_artefacts(run, "options")
    inputs: list[Path] = []
    for artefact in metas:
        inputs += map(artefact.place_of, artefact.manifest.inputs)
    continued = [artefact for artefact in learned if artefact.path.resolve() in inputs]
    ladders: list[Artefact] = []
    silent: list[Artefact] = []
    others: list[Artefact] = []
    for artefact in learned:
        if artefact not in continued:
            has_table = "executions.csv" in artefact.manifest.files
            (ladders if has_table else silent if artefact.config.get("start") else others).append(artefact)
    agents = [*metas, *others, *find_artefacts(run, "baseline")]
    contents = Contents(run, find_artefacts(run, "ensemble"), agents, ladders, silent, continued)
    if not contents.everything():
        raise UserError("nothing to evaluate", run, "Train something into it first: hypogoal run --help")
    return contents


def most_used(contents: Contents) -> int | None:
    """Which of the ensembles with the most members the most artefacts were learned from; the first of several."""
    learned = [artefact for artefact in (*contents.agents, *contents.ladders) if takes(artefact)]
    users = [artefact.input("ensemble").resolve() for artefact in learned]
    rank = [(artefact.config["members"], users.count(artefact.path.resolve())) for artefact in contents.ensembles]
    return max(range(len(rank)), key=lambda index: rank[index], default=None)


def takes(artefact: Artefact) -> bool:
    """Whether it was learned with the predictions of an ensemble's members."""
    return artefact.kind != "baseline" and artefact.config["termination"] != "oracle"


def thresholds_of(artefact: Artefact) -> NDArray[np.float64]:
    """The probabilities (G*K,) above which an artefact's options end; they may have fallen while it learned.

    NaN where options end at true sub-goals.
    """
    from hypogoal.core.tensors import load_tensors  # with PyTorch, which a report needs not
    from hypogoal.options.termination import thresholds_in

    options = len(artefact.config["sub_goals"]) * artefact.config["members"]
    if not takes(artefact):
        return np.full(options, np.nan)
    saved = load_tensors(artefact.path / "options.safetensors")
    return 1 / (1 + np.exp(-thresholds_in(saved, options).astype(np.float64)))


class Layout(BaseModel, strict=True):
    """``layout.json``: what is known of the layout that an agent was trained on."""

    layout_seed: Annotated[int, Field(ge=0, lt=MAX_INTEGER)]
    shortest_path: int | None  # steps
    random_success: float | None  # share of random play's episodes
    layouts: str | None = None  # where there were many


def read_layout(path: Path) -> Layout:
    """``layout.json``; a ``UserError`` where it is missing or damaged."""
    try:
        return Layout.model_validate_json(path.read_bytes())
    except (OSError, ValueError) as error:
        raise UserError(f"the layout's file cannot be read ({reason(error)})", path, AGAIN) from None


@contextlib.contextmanager
def fitting(where: object) -> Iterator[None]:
    """Drawing an evaluation, whose numbers are a file's: what does not fit is told in one line."""
    try:
        yield
    except (LookupError, TypeError, ValueError, AttributeError, ArithmeticError) as error:
        raise UserError("the evaluation does not fit this hypogoal, or is damaged", where, EVALUATE_AGAIN) from error


def evaluation_of(run: Path) -> Artefact:
    """The evaluation of a run: that in ``run/evaluation`` where there are several; a ``UserError`` if there is none."""
    evaluations = find_artefacts(run, "evaluation")
    if not evaluations:
        raise UserError("this run was not evaluated", run, f"First run: {command('evaluate', run)}")
    return next((artefact for artefact in evaluations if artefact.path == run / "evaluation"), evaluations[0])


def read_evaluation(run: Path) -> Results:
    """What was found in a run, see :func:`evaluation_of`; its artefacts made since are among what is ``missing``.

    A run that was not evaluated, or a damaged evaluation, is a ``UserError``.
    """
    source = evaluation_of(run)
    results = with_missing(read_results(source), _since(run, source))
    with opened(source.path / "arrays.h5", EVALUATE_AGAIN, "the evaluation's arrays") as file:
        names: list[str] = []
        file.visit(names.append)
        arrays = {name: file[name][()] for name in names if hasattr(file[name], "shape")}
    return replace(results, arrays=arrays)


def with_missing(results: Results, lines: Sequence[str]) -> Results:
    """The same, with more lines about what is missing."""
    return replace(results, facts={**results.facts, "missing": [*results.facts["missing"], *lines]})


def read_results(source: Artefact) -> Results:
    """The numbers and facts of an evaluation artefact; a ``UserError`` where it is damaged or of another format."""
    path = open_artefact(source.path).path / "run.json"
    if not path.exists():
        raise UserError("a version of hypogoal before 1.0 evaluated this", source.path, EVALUATE_AGAIN)
    facts = read_json(path, "the evaluation is", EVALUATE_AGAIN)
    if not isinstance(facts, dict) or not isinstance(facts.get("missing"), list):
        raise UserError("the evaluation is damaged", path, EVALUATE_AGAIN)
    if facts.get("format") != FORMAT:
        problem = f"another version of hypogoal evaluated this (format {facts.get('format')}, needed: {FORMAT})"
        raise UserError(problem, path, EVALUATE_AGAIN)
    return Results(read_numbers(source.path / "numbers.csv"), facts)


def _since(run: Path, source: Artefact) -> list[str]:
    """A line for each artefact of the run that the evaluation does not know: it was made, or made again, since."""
    evaluated = {entry.sha256 for entry in source.manifest.inputs}
    try:
        contents = find(run)
    except UserError:  # evaluations may lie where nothing else does
        return []
    again = f"evaluate it again: {command('evaluate', run, '--force')}"
    return [
        f"{contents.name(artefact)}: made since this evaluation ({again})"
        for artefact in contents.everything()
        if sha256_of(artefact.path) not in evaluated
    ]
