"""What is in a file, an artefact or a run, whether it is whole, and whether it is up to date."""

import shlex
import textwrap
from html import escape
from os import PathLike
from pathlib import Path
from statistics import fmean
from typing import Any

from hypogoal.cells import read_plan, status_lines
from hypogoal.core.artefacts import LOG, MANIFEST, SUMMARY, Artefact, open_artefact
from hypogoal.core.drafts import Draft
from hypogoal.core.errors import UserError
from hypogoal.core.files import read_log, reading, visible
from hypogoal.core.progress import say
from hypogoal.data import SPLITS, open_dataset
from hypogoal.observations import type_text

WIDTH = 80  # columns of a line
EVALUATION = "evaluation"
SUMMARISED = {EVALUATION: "Evaluate the run again, with --force.", "comparison": "Compare the runs again."}
# Numbers of a training's log, in the order in which they are shown.
LOGGED = ("labelled", "success", "length", "reached", "terminated", "duration", "episodes")
Details = dict[str, Any]  # a description


def parts_of(path: Path) -> list[Path]:
    """Return the data files and artefacts at or below a path.

    Raises ``UserError`` if nothing is there, or being made.
    """
    if path.is_file() or (path / MANIFEST).is_file():
        return [path]
    artefacts = [manifest.parent for manifest in visible(path, MANIFEST)]
    data = [file for file in visible(path, "*.h5") if file.parent not in artefacts]
    if artefacts or data or in_the_making(path):
        return [*data, *artefacts]
    fault = "no artefact and no data file here" if path.exists() else "no such file or folder"
    raise UserError(fault, path, "Give what a stage wrote.")


def unfinished(path: Path) -> list[str]:
    """Return a line for each output at or below a path that is being made, or was interrupted."""
    lines = []
    drafts = sorted(path.rglob(".*.partial"))
    below = [folder.with_name(folder.name[1:].removesuffix(".partial")) for folder in drafts]
    for out in (path, *below):
        draft = Draft(out)
        if draft.begun.is_file():
            state = "in progress" if draft.is_locked else "interrupted; its command with --resume continues it"
            lines.append(f"{out}: {state}")
    return lines


def in_the_making(path: Path) -> list[str]:
    """Return a line for each output at or below a path that is not complete. Of a run, return how far it is."""
    return status_lines(path) if read_plan(path) else unfinished(path)


def describe(path: Path) -> Details:
    """Return kind, numbers, settings and inputs of a data file or an artefact. Of a run, return those of its parts."""
    parts = parts_of(path)
    if parts != [path]:
        return {"path": str(path), "kind": "run", "parts": [describe(part) for part in parts]}
    if path.is_dir():
        return {"path": str(path), "numbers": numbers_of(path), **Artefact(path).manifest.model_dump()}
    dataset = open_dataset(path)
    return {
        "path": str(path),
        "kind": "data",
        "numbers": dataset.counts(),
        "domain": dataset.domain,
        "observations": f"{type_text(dataset.observation_dtype)} {dataset.observation_shape}",
        "seed": dataset.seed,
        "config": dataset.config,
    }


def numbers_of(path: Path) -> Details:
    """Return the last numbers in a training's log, as means over sub-goals."""
    last = {row.get("sub_goal"): row for row in read_log(path / LOG)}
    numbers = {}
    for name in LOGGED:
        values = [row[name] for row in last.values() if isinstance(row.get(name), int | float)]
        if values:
            numbers["labelled loss" if name == "labelled" else name] = fmean(values)
    return numbers


def outcome(details: Details) -> list[str]:
    """Return the numbers of what is described, as lines. Those of a run are those of its evaluation."""
    kind, numbers = details["kind"], details.get("numbers", {})
    if kind == "run":
        evaluations = [outcome(part) for part in details["parts"] if part["kind"] == EVALUATION]
        return evaluations[0] if evaluations else []
    if kind == "data":
        return count_lines(numbers)
    if kind not in SUMMARISED:
        return []
    path = open_artefact(Path(details["path"])).path / SUMMARY
    with reading(path, SUMMARISED[kind], "the summary"):
        return path.read_text(encoding="utf-8").splitlines()


def count_lines(counts: Details) -> list[str]:
    """Return the numbers of states of a data file, as lines."""
    text = []
    for split in SPLITS:
        for goal, row in counts[split].items():
            text.append(f"{split:9} {goal:20} {row['states']:7} states {row['positives']:7} positives")
    return [*text, f"{'unlabelled':30} {counts['unlabelled']:7} states"]


def lines(details: Details) -> list[str]:
    """Return what is described, with a training's numbers, and then how it was made, a fact a line.

    Of a run, return a line for each part.
    """
    if details["kind"] == "run":
        return [lines(part)[0] for part in details["parts"]]
    facts = dict(details)
    heading = f"{facts.pop('path')}: {facts.pop('kind')}"
    for name, value in facts.pop("numbers").items():
        if isinstance(value, float):
            heading += f"; {name} {value:.4g}"
    if "inputs" in facts:
        facts["inputs"] = [f"{entry['kind']} {entry['path']}" for entry in facts["inputs"]]
        facts["command"] = shlex.join(facts["command"])
        facts["files"] = [*facts["files"]]
    settings = facts.pop("config")
    rows = [f"{name}: {_in_words(value)}" for name, value in facts.items()]
    rows += [f"  {name}={_in_words(value)}" for name, value in settings.items()]
    text = [heading]
    for row in rows:
        text += textwrap.wrap(row, WIDTH, subsequent_indent="    ", break_on_hyphens=False, break_long_words=False)
    return text


def _in_words(value: Any) -> str:
    """Return a value as one would type it."""
    if isinstance(value, dict):
        value = [f"{name} {_in_words(part)}" for name, part in value.items()]
    return ", ".join(map(str, value)) if isinstance(value, list) else str(value)


def faults(path: Path) -> list[str]:
    """Return a line for each unreadable data file, and each file or input in ``path`` that is missing or changed."""
    lines = []
    for part in parts_of(path):
        try:
            if part.is_dir():
                lines += [f"{part}: {fault}" for fault in Artefact(part).faults(within=path.resolve())]
                continue
            dataset = open_dataset(part)
            dataset.unlabelled()
            for goal in dataset.sub_goals:
                dataset.labelled(goal)
                dataset.heldout(goal)
        except UserError as error:
            lines.append(str(error))
    return lines


def stale(run: Path) -> list[Details]:
    """Return the data files and artefacts of a run, inputs first.

    Each has its path, the reasons why it is stale, and the command that made it. It is up to date if there are no
    reasons.
    """
    reasons: dict[Path, list[str]] = {}
    parts = {part.resolve(): part for part in parts_of(run)}
    for place in parts:
        _find_reasons(place, reasons)
    rows = []
    for place, why in reasons.items():
        if place in parts:
            command = shlex.join(Artefact(place).manifest.command) if why else ""
            rows.append({"path": str(parts[place]), "reasons": why, "command": command})
    return rows


def _find_reasons(place: Path, reasons_of: dict[Path, list[str]]) -> list[str]:
    """Return why a data file or an artefact is stale. Enter the reasons in ``reasons_of``, after its inputs'."""
    if place not in reasons_of:
        reasons = []
        if place.is_dir():
            artefact = Artefact(place)
            reasons = artefact.faults()
            for entry in artefact.manifest.inputs:
                source = artefact.place_of(entry)
                if source.exists() and _find_reasons(source, reasons_of):
                    reasons.append(f"its input {entry.path} is stale")
        reasons_of[place] = reasons
    return reasons_of[place]


def stale_lines(rows: list[Details]) -> list[str]:
    """Return what :func:`stale` found, as lines."""
    text = []
    for row in rows:
        text.append(f"{row['path']}: {'; '.join(row['reasons']) or 'up to date'}")
        if row["command"].startswith("hypogoal "):  # the command of a user's program cannot be given again
            text.append(f"  {row['command']} --force")
    count = sum(bool(row["reasons"]) for row in rows)
    if rows:
        text.append(f"{count} of {len(rows)} stale: renew them in this order" if count else "everything is up to date")
    return text


class Made:
    """A data file, an artefact or a run at ``path``. It works wherever a path is expected, and shows what it holds."""

    def __init__(self, path: str | PathLike[str]):
        self.path = Path(path)

    def __fspath__(self) -> str:
        return str(self.path)

    @property
    def metrics(self) -> Any:
        """The numbers: a dict of counts of states or of a training's last log entry, or an evaluation's DataFrame."""
        table = self.path / "numbers.csv"
        if table.is_file():
            from hypogoal.evaluation.table import read_numbers

            return read_numbers(table)
        return dict(describe(self.path).get("numbers", {}))

    def __repr__(self) -> str:
        details = describe(self.path)
        return "\n".join([lines(details)[0], *outcome(details)])

    def _repr_html_(self) -> str:
        return f'<pre style="line-height: 1.2">{escape(repr(self))}</pre>'

    def show(self) -> None:
        """Print what ``hypogoal show`` prints: result, configuration, inputs."""
        say(repr(self), *lines(describe(self.path))[1:])
