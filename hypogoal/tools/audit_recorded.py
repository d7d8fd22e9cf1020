"""An audit of recorded data, without a simulator."""

from pathlib import Path

from hypogoal.command.call import Call
from hypogoal.core.artefacts import DATA, TO_FILL_IN, open_artefact
from hypogoal.core.errors import UserError


def audited(
    call: Call,
    source: str,
    data: Path | None,
    sub_goal: str | None,
    member: int | None,
) -> tuple[list[str], dict[str, float | None]]:
    """An audit without a simulator, of a function or of all members of an ensemble; else as in play.

    ``out`` gets ``audit.json``, the page ``index.html`` and, for each sub-goal (or the named one), ``next/SUB_GOAL/``.
    """
    from hypogoal.core.files import as_json
    from hypogoal.core.progress import Progress
    from hypogoal.data import open_dataset
    from hypogoal.evaluation import page
    from hypogoal.evaluation.plots import slug
    from hypogoal.tools.audits import recorded
    from hypogoal.tools.audits.classifiers import classifier_of

    is_ensemble = Path(source).is_dir()
    if member is not None or call.typed or call.preset or call.resume or not (data or is_ensemble):
        do = "Give --domain and --sub-goal; or, without settings, an ensemble's folder or --data FILE."
        raise UserError("an audit plays in a domain, or looks at recorded data", source, do)
    inputs = []
    if is_ensemble:
        artefact = open_artefact(Path(source), "ensemble")
        inputs = [artefact.path]
        data = data or artefact.input(DATA)
    assert data is not None
    dataset = open_dataset(data)
    goals = artefact.config["sub_goals"] if is_ensemble else dataset.sub_goals
    if sub_goal not in (None, *goals):
        raise UserError("unknown sub-goal", sub_goal, f"They are {', '.join(goals)}.")
    goals = [sub_goal] if sub_goal else [*goals]
    parts, sections = [], []
    with (
        call.draft("recorded-audit", {"sub_goals": goals, "classifier": source}, [*inputs, data]) as draft,
        Progress("audit", len(goals), quiet=call.quiet) as progress,
    ):
        for goal in goals:
            classifier, _ = classifier_of(source, goal, call.device)
            findings = recorded.findings_of(classifier, dataset, goal)
            recorded.write_next(draft.files / "next" / goal, findings)
            parts.append(findings["numbers"])
            heading = {"name": slug(goal), "title": goal, "template": "audited", "folded": False}
            sections.append(heading | findings)
            progress.advance()
        lines = page.lines_of("audited.txt", parts=parts)
        title = f"hypogoal: audit of {Path(source).name}"
        text = page.render("lines.html", title=title, sections=sections, lines=lines, about="recorded data")
        (draft.files / "index.html").write_text(text, encoding="utf-8")
        (draft.files / "audit.json").write_text(as_json({"sub_goals": parts}) + "\n", encoding="utf-8")
    shares = []
    for part in parts:
        for row in part["members"]:
            if row["negatives"]:
                shares.append(row["false_positives"] / row["negatives"])
    table = call.out / "next" / "SUB_GOAL" / TO_FILL_IN
    lines.append(f"then fill in the column 'label' of {table}: 1 or 0, for the pictures beside it; see docs/audit.md")
    return lines, {"failures": max(shares, default=None)}
