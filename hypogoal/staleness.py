"""Which artefacts of a run are out of date, why, and the commands that renew them, for ``hypogoal status``.

An artefact is stale if an input is gone, was changed or is stale itself, or if its files were changed. An evaluation is
stale, too, if the run got an artefact that it lacks.
"""

from __future__ import annotations

import os
import shlex
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from hypogoal.core.artefacts import Artefact
from hypogoal.inspection import EVALUATION, parts_of

READS_ALL = (EVALUATION, "comparison", "report")  # kinds that other artefacts are not made from
EVALUATED = ("ensemble", "options", "meta", "baseline")


@dataclass(frozen=True)
class State:
    """An artefact or a data file of a run."""

    path: Path
    reasons: tuple[str, ...] = ()  # why it is stale; none: it is up to date
    command: str = ""  # renews it; empty for a data file or an artefact that a program made


def states_of(run: Path) -> list[State]:
    """The data files and artefacts of a run in the order in which they are made; a ``UserError`` if there are none."""
    parts = parts_of(run)
    artefacts = {path.resolve(): Artefact(path) for path in parts if path.is_dir()}
    states = {path.resolve(): State(path) for path in parts if not path.is_dir()}
    for artefact in _in_order(artefacts):
        reasons = (
            *_faults(artefact),
            *_of_inputs(artefact, states),
            *_since(artefact, artefacts),
        )
        command = _command(artefact) if reasons else ""
        states[artefact.path.resolve()] = State(artefact.path, reasons, command)
    return list(states.values())


def lines(states: Sequence[State]) -> list[str]:
    """The states as text: a line each, with the command below that renews a stale one."""
    text = []
    for state in states:
        text.append(f"{state.path}: {'; '.join(state.reasons) or 'up to date'}")
        text += [f"  {state.command}"] if state.command else []
    stale = sum(bool(state.reasons) for state in states)
    ending = "renew them in this order" if stale > 1 else "renew it"
    return [*text, f"{stale} of {len(states)} stale: {ending}" if stale else "everything is up to date"]


def _in_order(artefacts: Mapping[Path, Artefact]) -> Iterator[Artefact]:
    """Artefacts after their inputs; evaluations and reports last."""
    left = dict(artefacts)
    while left:
        ready = [path for path, artefact in left.items() if not any(place in left for place in _places(artefact))]
        first = [path for path in ready or left if left[path].kind not in READS_ALL] or ready or list(left)
        for path in first:
            yield left.pop(path)


def _places(artefact: Artefact) -> list[Path]:
    """Where an artefact's inputs lie."""
    return [artefact.place_of(entry) for entry in artefact.manifest.inputs]


def _faults(artefact: Artefact) -> Iterator[str]:
    faults = [f"{name}: {fault}" for name, fault in artefact.file_faults().items()]
    if faults:
        more = f" and {len(faults) - 1} more" if len(faults) > 1 else ""
        yield f"{faults[0]}{more}"


def _of_inputs(artefact: Artefact, states: Mapping[Path, State]) -> Iterator[str]:
    for entry, place in zip(artefact.manifest.inputs, _places(artefact), strict=True):
        if fault := artefact.input_fault(entry):
            yield f"its input {_shown(place)} is {fault}"
        elif place in states and states[place].reasons:
            yield f"its input {_shown(place)} is stale"


def _since(artefact: Artefact, artefacts: Mapping[Path, Artefact]) -> Iterator[str]:
    """Of an evaluation the artefacts of its run that it lacks; options that an agent continues are part of that one."""
    if artefact.kind != EVALUATION:
        return
    recorded, run = {*_places(artefact)}, artefact.path.parent.resolve()
    continued = {place for other in artefacts.values() if other.kind == "meta" for place in _places(other)}
    for path, other in artefacts.items():
        if path.is_relative_to(run) and other.kind in EVALUATED and path not in recorded | continued:
            yield f"{_shown(path)} was made since"


def _command(artefact: Artefact) -> str:
    """The recorded command with today's places of inputs and output, as one would type it; empty from Python."""
    words = list(artefact.manifest.command)
    if words[:1] != ["hypogoal"]:
        return ""
    moved = {entry.path: place for entry, place in zip(artefact.manifest.inputs, _places(artefact), strict=True)}
    typed = [_shown(moved[word]) if word in moved else word for word in words]
    if "--out" in typed:
        typed[typed.index("--out") + 1] = _shown(artefact.path.resolve())
    kept = [word for word in typed if word not in ("--resume", "--force")]
    return shlex.join([*kept, "--force"])


def _shown(path: Path) -> str:
    """A path as one would type it here."""
    relative = os.path.relpath(path)
    return str(path) if relative.startswith("..") else relative
