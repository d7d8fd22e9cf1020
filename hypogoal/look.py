"""What is there, is it whole, is it up to date: for ``show``, ``verify`` and ``status`` (Spec A8, G2)."""

import shlex
import textwrap
from pathlib import Path
from typing import Any, TypeAlias

from hypogoal.cells import read_plan, status_lines
from hypogoal.core.artefacts import LOG, MANIFEST, Artefact, Draft
from hypogoal.core.errors import UserError
from hypogoal.core.files import read_log, visible
from hypogoal.core.terminal import drawn
from hypogoal.data import SPLITS, open_dataset
from hypogoal.observations import type_text

WIDTH = 80  # columns
EVALUATION = "evaluation"
# Of a training's log, in the order in which they are shown, with their titles.
LOGGED = {"labelled": "labelled loss"}
LOGGED |= {name: name for name in ("success", "length", "reached", "terminated", "duration", "episodes")}
Details: TypeAlias = dict[str, Any]  # a description


def parts_of(path: Path) -> list[Path]:
    """The data files and artefacts at or below a path; a ``UserError`` if nothing is there or being made."""
    if path.is_file() or (path / MANIFEST).is_file():
        return [path]
    artefacts = [manifest.parent for manifest in visible(path, MANIFEST)]
    data = [file for file in visible(path, "*.h5") if file.parent not in artefacts]
    if not (artefacts or data or unfinished(path)):
        if not path.exists():
            raise UserError("no such file or folder", path, "Check the path.")
        raise UserError("no artefact and no data file here", path, "Give what a stage wrote.")
    return [*data, *artefacts]


def unfinished(path: Path) -> list[str]:
    """A line for each output at or below a path that is being made, or was interrupted."""
    lines = []
    below = [folder.with_name(folder.name[1:].removesuffix(".partial")) for folder in path.rglob(".*.partial")]
    for out in (path, *sorted(below)):
        draft = Draft(out)
        if draft.begun.is_file():
            state = "in progress" if draft.is_locked else "interrupted; its command with --resume continues it"
            lines.append(f"{out}: {state}")
    return lines


def in_the_making(path: Path) -> list[str]:
    """A line for each output at or below a path that is not complete; of a run how far it is."""
    return status_lines(path) if read_plan(path) else unfinished(path)


def describe(path: Path) -> Details:
    """Kind, numbers, settings and inputs of a data file or an artefact; of a run those of all its parts."""
    parts = parts_of(path)
    if parts != [path]:
        return {"path": str(path), "kind": "run", "parts": [describe(part) for part in parts]}
    if path.is_dir():
        return {"path": str(path), "numbers": numbers_of(path), **Artefact(path).manifest.model_dump()}
    dataset = open_dataset(path)
    observations = f"{type_text(dataset.observation_dtype)} {dataset.observation_shape}"
    return {
        "path": str(path),
        "kind": "data",
        "numbers": dataset.counts(),
        "domain": dataset.domain,
        "observations": observations,
        "seed": dataset.seed,
        "config": dataset.config,
    }


def numbers_of(path: Path) -> Details:
    """The last numbers in a training's log, means over sub-goals."""
    last = {row.get("sub_goal"): row for row in read_log(path / LOG)}
    numbers = {}
    for name, title in LOGGED.items():
        values = [row[name] for row in last.values() if isinstance(row.get(name), int | float)]
        if values:
            numbers[title] = sum(values) / len(values)
    return numbers


def outcome(details: Details) -> list[str]:
    """The numbers of what is described, as lines; of a run those of its evaluation."""
    kind, numbers = details["kind"], details.get("numbers", {})
    if kind == "run":
        evaluations = [outcome(part) for part in details["parts"] if part["kind"] == EVALUATION]
        return evaluations[0] if evaluations else []
    if kind == "data":
        return count_lines(numbers)
    if kind == EVALUATION:
        from hypogoal.evaluation.questions import summary
        from hypogoal.evaluation.run import fitting, read_results

        path = Path(details["path"])
        results = read_results(Artefact(path))
        with fitting(path):
            table = drawn(summary(results), WIDTH)
        return [line.rstrip() for line in table.splitlines()]
    if kind == "comparison":
        from hypogoal.evaluation.compare import read_pairs, winners

        return winners(read_pairs(Path(details["path"])))
    return []


def count_lines(counts: Details) -> list[str]:
    """The numbers of states of a data file."""
    text = []
    for split in SPLITS:
        for goal, row in counts[split].items():
            text.append(f"{split:9} {goal:20} {row['states']:7} states {row['positives']:7} positives")
    return [*text, f"{'unlabelled':30} {counts['unlabelled']:7} states"]


def lines(details: Details) -> list[str]:
    """What it is, a training's numbers, then how it was made, a fact a line; of a run a line for each part."""
    if details["kind"] == "run":
        return [lines(part)[0] for part in details["parts"]]
    facts = dict(details)
    heading = f"{facts.pop('path')}: {facts.pop('kind')}"
    numbers = facts.pop("numbers").items()
    logged = [f"{name} {round(value, 4):g}" for name, value in numbers if isinstance(value, float)]
    text = ["; ".join([heading, ", ".join(logged)]) if logged else heading]
    config = facts.pop("config")
    if "inputs" in facts:
        facts["inputs"] = [f"{entry['kind']} {entry['path']}" for entry in facts["inputs"]]
        facts["command"] = shlex.join(facts["command"])
        facts["files"] = [*facts["files"]]
    for name, value in facts.items():
        text += _wrapped(f"{name}: {_typed(value)}")
    text.append("config:")
    for name, value in config.items():
        text += _wrapped(f"  {name}={_typed(value)}")
    return text


def _typed(value: Any) -> str:
    """A value as one would type it."""
    if isinstance(value, dict):
        value = [f"{name} {_typed(part)}" for name, part in value.items()]
    if isinstance(value, list):
        return ", ".join(map(str, value))
    return str(value)


def _wrapped(line: str) -> list[str]:
    return textwrap.wrap(line, WIDTH, subsequent_indent="    ", break_on_hyphens=False, break_long_words=False)


def faults(path: Path) -> list[str]:
    """A line for each data file that cannot be read, and each file or input within that is missing or changed."""
    lines = []
    for part in parts_of(path):
        try:
            if part.is_file():
                _read_all(part)
            else:
                lines += [f"{part}: {fault}" for fault in Artefact(part).faults(within=path.resolve())]
        except UserError as error:
            lines.append(str(error))
    return lines


def _read_all(data: Path) -> None:
    dataset = open_dataset(data)
    dataset.unlabelled()
    for goal in dataset.sub_goals:
        dataset.labelled(goal)
        dataset.heldout(goal)


def stale(run: Path) -> list[Details]:
    """The data files and artefacts of a run, inputs first.

    Of each its path, why it is stale (no reasons: it is up to date), and the command that made it.
    """
    reasons: dict[Path, list[str]] = {}
    parts = {part.resolve(): part for part in parts_of(run)}
    for place in parts:
        _find_reasons(place, reasons)
    rows = []
    for place in [place for place in reasons if place in parts]:
        command = Artefact(place).manifest.command if reasons[place] else []
        typed = shlex.join(command) if command[:1] == ["hypogoal"] else ""  # a program's cannot be given again
        rows.append({"path": str(parts[place]), "reasons": reasons[place], "command": typed})
    return rows


def _find_reasons(place: Path, reasons_of: dict[Path, list[str]]) -> list[str]:
    """Why a data file or an artefact is stale; enters it in ``reasons_of``, after its inputs."""
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
    """What :func:`stale` found, as text."""
    text = []
    for row in rows:
        text.append(f"{row['path']}: {'; '.join(row['reasons']) or 'up to date'}")
        if row["command"]:
            text.append(f"  {row['command']} --force")
    count = sum(bool(row["reasons"]) for row in rows)
    if rows:
        text.append(f"{count} of {len(rows)} stale: renew them in this order" if count else "everything is up to date")
    return text
