"""Spec I6: an audit on recorded data, where there is no simulator to play in."""

from collections.abc import Sequence
from pathlib import Path

from hypogoal.core.artefacts import DATA, open_artefact
from hypogoal.core.errors import UserError
from hypogoal.core.processes import prepare
from hypogoal.core.progress import Progress
from hypogoal.data import open_dataset
from hypogoal.evaluation.house import as_json
from hypogoal.evaluation.recorded_page import Judges, draw, findings_of, lines_of, write_next
from hypogoal.importing.labels import COLUMNS
from hypogoal.stages import Call


def audit_recorded(
    call: Call,
    source: str,
    data: Path | None,
    sub_goal: str | None,
) -> tuple[list[str], dict[str, float | None]]:
    """Audit a function, or the members of an ensemble artefact, on a data file; by default on the ensemble's own.

    Writes ``audit.json``, the page ``index.html`` and, for each sub-goal (or the named one), ``next/SUB_GOAL/``: the
    unlabelled states to label next, best first, as pictures and a table to fill in. Returns the findings in lines,
    and the largest share of a sub-goal's known failures that one of them takes for a success. An unknown sub-goal, and
    data that are gone, are a ``UserError``.
    """
    device = prepare(call.device)
    artefact = open_artefact(Path(source), "ensemble") if Path(source).is_dir() else None
    inputs = [artefact.path] if artefact else []
    if data is None:
        assert artefact is not None
        data = artefact.input(DATA)
    dataset = open_dataset(data)
    goals = _chosen(artefact.config["sub_goals"] if artefact else dataset.sub_goals, sub_goal)
    every = []
    with (
        call.draft("recorded-audit", {"sub_goals": goals, "classifier": source}, [*inputs, data]) as draft,
        Progress("audit", len(goals), quiet=call.quiet) as progress,
    ):
        for goal in goals:
            if artefact:
                judges = Judges.of_members(artefact, goal, device)
            else:
                judges = Judges.of_function(source)
            findings = findings_of(judges, dataset, goal)
            write_next(draft.files / "next" / goal, COLUMNS, findings)
            every.append(findings)
            progress.advance()
        parts = [findings.numbers for findings in every]
        (draft.files / "audit.json").write_text(as_json({"sub_goals": parts}) + "\n", encoding="utf-8")
        page = draw(Path(source).name, every)
        (draft.files / "index.html").write_text(page, encoding="utf-8")
    shares = []
    for findings in every:
        with_failures = findings.members.query("negatives > 0")
        shares += (with_failures["false_positives"] / with_failures["negatives"]).tolist()
    return lines_of(parts), {"failures": max(shares, default=None)}


def _chosen(names: Sequence[str], sub_goal: str | None) -> list[str]:
    if sub_goal is None:
        return [*names]
    if sub_goal not in names:
        raise UserError("unknown sub-goal", sub_goal, f"They are {', '.join(names)}.")
    return [sub_goal]
