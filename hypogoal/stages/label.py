"""Spec B6: states marked by hand, in a folder of images for ``import``."""

import json
from collections.abc import Mapping
from functools import partial
from pathlib import Path
from typing import Any

import gymnasium

from hypogoal.core import own_code
from hypogoal.core.artefacts import DATA, open_artefact
from hypogoal.core.drafts import sole_writer
from hypogoal.core.errors import UserError
from hypogoal.core.files import replace_text
from hypogoal.dataset import digest, open_dataset, require_names
from hypogoal.domains.base import BUILT_IN, ENTRY_POINTS, Domain
from hypogoal.evaluation.recorded import picture_of
from hypogoal.own_data.marking import KINDS, Marks, Played, Recorded, Source, mark_states, recorded_states
from hypogoal.own_data.marks import MarkedTable, read_marks

HELD_OUT = "heldout"


def label(
    source: str,
    out: Path,
    *,
    layout_seed: int = 0,
    arguments: Mapping[str, Any] | None = None,
    heldout: bool = False,
    resume: bool = False,
    record: Path | None = None,
) -> dict[str, int]:
    """Show states in a window and save a person's marks; returns the number of marked states of each kind.

    ``source`` is a data file, a ``.npz`` file or a folder of images, whose states are shown in turn; or an environment
    to play: a domain, a Gymnasium environment's id, or ``module:object``, a domain or a function that makes an
    environment from ``arguments``. ``out`` is the folder, named after the sub-goal; ``heldout``: the marks are for
    evaluation, in ``out/heldout``. ``record``: a file for the episodes played, for ``collect --play``. A missing
    source, an existing ``out`` without ``resume``, an existing ``record``, and a missing screen are a ``UserError``.
    """
    require_names([out.resolve().name])
    if out.exists() and not resume and not (heldout and not (out / HELD_OUT).exists()):
        raise UserError("the folder exists already", out, "Give --resume to continue it, or another --out.")
    if record and (record.exists() or Path(source).exists()):
        raise UserError("--record needs a new file", record, "Give another --record, or none.")
    states: Source
    if Path(source).exists():
        states = Recorded(recorded_states(Path(source)))
    else:
        states = Played(partial(environment_of, source, arguments or {}), layout_seed)
    out.parent.mkdir(parents=True, exist_ok=True)
    with sole_writer(out):
        marks = Marks(out / HELD_OUT, KINDS[:2]) if heldout else Marks(out)
        try:
            mark_states(states, marks, out.resolve().name)
        finally:
            if record and isinstance(states, Played):
                played = [{"layout_seed": seed, "actions": actions} for seed, actions in states.recorded if actions]
                replace_text(record, json.dumps(played) + "\n")
        return marks.counts()


def label_next(audit: Path, out: Path, *, count: int, resume: bool = False) -> tuple[dict[str, int], Path, str]:
    """Show the first ``count`` states that an audit of recorded data proposes and save a person's marks in a table.

    Returns the number of marked states of each kind, the data file and its sub-goal. ``out`` is the table, a .csv file
    for ``import``; with ``resume`` its marks are kept. Something else than such an audit, data of several sub-goals,
    data that are gone or no pictures, and a missing screen are a ``UserError``.
    """
    artefact = open_artefact(audit, "recorded-audit").whole()
    data = artefact.input(DATA)
    dataset = open_dataset(data)
    if len(dataset.sub_goals) > 1:
        raise UserError("a table labels data of one sub-goal, its own", data, "Import the states for each by itself.")
    [goal] = dataset.sub_goals
    if out.suffix != ".csv":
        raise UserError("--next writes a table", out, "Give --out NAME.csv.")
    if out.exists() and not resume:
        raise UserError("the table exists already", out, "Give --resume to continue it, or another --out.")
    rows = read_marks(audit / "next" / f"{goal}.csv")
    labels = {row["digest"]: row["label"] for row in read_marks(out)} if out.exists() else {}
    for row in rows:
        row["label"] = labels.get(row["digest"], "")
    states = dataset.unlabelled()
    places = [int(row["row"]) for row in rows[:count]]
    if any(
        place >= len(states) or digest(states[place]).hex() != row["digest"]
        for place, row in zip(places, rows, strict=False)
    ):
        raise UserError("the table is of other data", out, "Give another --out.")
    pictures = [picture for place in places if (picture := picture_of(states[place])) is not None]
    if len(pictures) < len(places) or not places:
        raise UserError("only states with pictures can be shown", data, "Fill in the labels of its table by a script.")
    out.parent.mkdir(parents=True, exist_ok=True)
    with sole_writer(out):
        marks = MarkedTable(out, rows, pictures)
        mark_states(Recorded(pictures), marks, goal)
        return marks.counts(), data, goal


def environment_of(source: str, arguments: Mapping[str, Any]) -> Any:
    """An environment by its id, of a domain, or from the function that makes it; an unknown one is a ``UserError``."""
    import ale_py
    import minigrid  # noqa: F401 - loading it registers its environments

    gymnasium.register_envs(ale_py)
    if source in gymnasium.registry:
        return gymnasium.make(source, **arguments)
    try:
        loaded = own_code.load_own(source, "environment", ENTRY_POINTS, BUILT_IN)
    except UserError as error:
        if source.partition(":")[2] in gymnasium.registry:  # Gymnasium's module:id; the module is loaded now
            return gymnasium.make(source, **arguments)
        if ":" in source:
            raise
        do = "Give a data file, a .npz file, a folder of images, a domain, an environment's id or module:object."
        raise UserError("neither a file nor an environment", source, do) from error
    return loaded.make_env(**arguments) if isinstance(loaded, Domain) else loaded(**arguments)
