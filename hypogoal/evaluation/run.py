"""What a run holds: which artefacts are evaluated, their tables, and the evaluation as read back.

A damaged file is refused in one line.
"""

import json
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import Any

from pandas import DataFrame

from hypogoal.core.artefacts import MANIFEST, Artefact, open_artefact, sha256_of
from hypogoal.core.errors import UserError
from hypogoal.core.files import reading, visible
from hypogoal.core.hdf5 import opened
from hypogoal.core.own_code import command
from hypogoal.evaluation.table import EVALUATE_AGAIN, read_numbers
from hypogoal.options.tables import Executions

FORMAT = 7  # the format of an evaluation, which its ``run.json`` names


@dataclass(frozen=True)
class Results:
    """An evaluated run: what ``numbers.csv``, ``run.json`` and ``arrays.h5`` hold."""

    numbers: DataFrame
    facts: Mapping[str, Any]
    arrays: Mapping[str, Any] = field(default_factory=dict)

    def of(self, **fields: Any) -> DataFrame:
        """Return the rows of ``numbers`` whose columns have the given values. A list stands for any of its values."""
        rows = self.numbers
        for name, value in fields.items():
            rows = rows[rows[name].isin(value if isinstance(value, list) else [value])]
        return rows

    def within(self, folder: str) -> dict[str, Any]:
        """Return the arrays of a folder, by their names in the folder."""
        start = f"{folder}/"
        return {name.removeprefix(start): values for name, values in self.arrays.items() if name.startswith(start)}


@dataclass(frozen=True)
class Contents:
    """The artefacts of a run that are evaluated."""

    run: Path  # its folder
    ensembles: list[Artefact]  # all ensembles
    agents: list[Artefact]  # what plays a layout: metas, options that no meta continues, baselines
    ladders: list[Artefact]  # options that were learned from a named start, with a table of where they stopped
    continued: list[Artefact]  # options that a meta artefact continues; judging that artefact judges them

    def everything(self) -> list[Artefact]:
        """Return all artefacts that are evaluated."""
        return [*self.ensembles, *self.agents, *self.ladders]

    @cached_property
    def data_of(self) -> dict[Path, Path]:
        """The data file of each ensemble, by the ensemble's path. Each file is read to the end once, for its hash."""
        return {artefact.path: artefact.input("data") for artefact in self.ensembles}

    def data(self) -> list[Path]:
        """Return the data files on which ensembles were trained, sorted."""
        return sorted({*self.data_of.values()})

    def name(self, artefact: Artefact) -> str:
        """Return the path of an artefact within the run."""
        return artefact.path.relative_to(self.run).as_posix()


def find_artefacts(run: Path, kind: str) -> list[Artefact]:
    """Return all artefacts of a kind in ``run`` or anywhere below, sorted by path."""
    if not run.is_dir():
        raise UserError("no such run", run, "Give the folder of a run.")
    artefacts = [Artefact(path.parent) for path in visible(run, MANIFEST)]
    return [artefact for artefact in artefacts if artefact.kind == kind]


def find(run: Path) -> Contents:
    """Return the artefacts to evaluate. Options that a meta artefact continues are part of that artefact.

    Raises ``UserError`` if there are none, or if an artefact is damaged.
    """
    metas = find_artefacts(run, "meta")
    inputs: set[Path] = set()
    for artefact in metas:
        inputs.update(map(artefact.place_of, artefact.manifest.inputs))
    contents = Contents(run, find_artefacts(run, "ensemble"), metas, [], [])
    for artefact in find_artefacts(run, "options"):
        if artefact.path.resolve() in inputs:
            contents.continued.append(artefact)
        elif Executions.FILE in artefact.manifest.files:
            contents.ladders.append(artefact)
        else:
            contents.agents.append(artefact)
    contents.agents.extend(find_artefacts(run, "baseline"))
    if not contents.everything():
        raise UserError("nothing to evaluate", run, "Train something into it first: hypogoal run --help")
    return contents


def takes(artefact: Artefact) -> bool:
    """Return whether an artefact was learned with the predictions of an ensemble's members."""
    return artefact.kind != "baseline" and artefact.config["termination"] != "oracle"


def choice_of(artefact: Artefact) -> str:
    """Return whether a meta artefact's choice among members' options is ``learned`` or ``random``; empty for others."""
    if artefact.kind != "meta" or not takes(artefact):
        return ""
    return "random" if artefact.config["chooser"] == "random" else "learned"


def evaluation_of(run: Path) -> Artefact:
    """Return the evaluation of a run. If there are several, it is that in ``run/evaluation``, or else the first.

    Raises ``UserError`` if there is none.
    """
    evaluations = find_artefacts(run, "evaluation")
    if not evaluations:
        raise UserError("this run was not evaluated", run, f"First run: {command('evaluate', run)}")
    return next((artefact for artefact in evaluations if artefact.path == run / "evaluation"), evaluations[0])


def read_evaluation(run: Path) -> Results:
    """Return what was found in a run, see :func:`evaluation_of`.

    Artefacts that were made since are among what is ``missing``. Raises ``UserError`` if the run was not evaluated, or
    if the evaluation is damaged.
    """
    source = evaluation_of(run)
    results = read_results(source)
    results.facts["missing"].extend(_since(run, source))
    with opened(source.path / "arrays.h5", EVALUATE_AGAIN, "the evaluation's arrays") as file:
        names: list[str] = []
        file.visit(names.append)
        arrays = {name: file[name][()] for name in names if hasattr(file[name], "shape")}
    return replace(results, arrays=arrays)


def read_results(source: Artefact) -> Results:
    """Return the numbers and facts of an evaluation artefact.

    Raises ``UserError`` if the artefact is damaged or has another format.
    """
    path = open_artefact(source.path).path / "run.json"
    with reading(path, EVALUATE_AGAIN, "the evaluation"):
        facts = json.loads(path.read_bytes())
        if facts["format"] != FORMAT:
            problem = f"another version of hypogoal evaluated this (format {facts['format']}, needed: {FORMAT})"
            raise UserError(problem, path, EVALUATE_AGAIN)
    return Results(read_numbers(source.path / "numbers.csv"), facts)


def _since(run: Path, source: Artefact) -> list[str]:
    """Return a line for each artefact of the run that was made, or made again, since the evaluation."""
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
