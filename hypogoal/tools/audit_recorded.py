"""Spec I6: an audit of an ensemble on its recorded data, where there is no simulator to play in."""

import json
from pathlib import Path

from hypogoal.core.artefacts import Artefact, open_artefact
from hypogoal.core.errors import UserError
from hypogoal.core.processes import prepare
from hypogoal.core.progress import Progress
from hypogoal.evaluation.recorded_page import draw, findings_of, lines_of, write_next
from hypogoal.importing.labels import COLUMNS
from hypogoal.stages import Call


def audit_recorded(call: Call, source: Path, sub_goal: str | None) -> list[str]:
    """Audit the members of the ensemble artefact ``source`` on the data file that it was trained on.

    ``audit.json``, the page ``index.html`` and, for each sub-goal (or the one that is named), ``next/SUB_GOAL/``: the
    unlabelled states to label next, best first, as pictures and a table to fill in. Returns the findings in lines. An
    unknown sub-goal, and data that are gone or have no unlabelled states, are a ``UserError``.
    """
    device = prepare(call.device)
    artefact = open_artefact(source, "ensemble")
    goals = _chosen(artefact, sub_goal)
    data = artefact.input("data")
    every = []
    with (
        call.draft("recorded-audit", {"sub_goals": goals}, [source, data]) as draft,
        Progress("audit", len(goals), quiet=call.quiet) as progress,
    ):
        for goal in goals:
            findings = findings_of(artefact, data, goal, device)
            write_next(draft.files / "next" / goal, COLUMNS, findings)
            every.append(findings)
            progress.advance()
        parts = [findings.numbers for findings in every]
        text = json.dumps({"sub_goals": parts}, indent=1)
        (draft.files / "audit.json").write_text(text + "\n", encoding="utf-8")
        page = draw(source.name, every)
        (draft.files / "index.html").write_text(page, encoding="utf-8")
    return lines_of(parts)


def _chosen(artefact: Artefact, sub_goal: str | None) -> list[str]:
    goals: list[str] = artefact.config["sub_goals"]
    if sub_goal is None:
        return goals
    if sub_goal not in goals:
        raise UserError("unknown sub-goal", sub_goal, f"{artefact.path} has {', '.join(goals)}.")
    return [sub_goal]
