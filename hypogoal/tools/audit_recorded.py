"""An audit of recorded data, without a simulator.

It says where members disagree, which failures they take for a success, and which states to label next.
"""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from PIL import Image

from hypogoal.command.call import Call
from hypogoal.core.arrays import Array
from hypogoal.core.artefacts import DATA, TO_FILL_IN, open_artefact
from hypogoal.core.errors import UserError
from hypogoal.core.files import as_json
from hypogoal.core.progress import Progress
from hypogoal.data import Dataset, joined, open_dataset
from hypogoal.evaluation import page
from hypogoal.evaluation.pictures import picture_of
from hypogoal.evaluation.plots import slug
from hypogoal.hypotheses.labelling import COMPARED, next_to_label
from hypogoal.observations import digest, spread_rows
from hypogoal.tools.classifiers import Classifier, classifier_of

NEXT = 100  # states to label next in the table
# Columns of the table: the picture's file, the label (1, 0 or nothing yet), the row among the unlabelled states, the
# state's :func:`hypogoal.observations.digest`, and how much members disagree.
COLUMNS = ["name", "label", "row", "digest", "disagreement"]
CARDS, FAILURES = 20, 4  # on the page: states to label next, and each member's failures


def audit_data(
    call: Call,
    source: str,
    data: Path | None,
    sub_goal: str | None,
    member: int | None,
) -> tuple[list[str], dict[str, float | None]]:
    """Audit a function, or all members of an ensemble, on recorded data.

    ``call.out`` gets ``audit.json``, the page ``index.html`` and, for each sub-goal (or the named one),
    ``next/SUB_GOAL/``. Returns lines to print, and the largest share of failures that are false positives.
    """
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
            findings = findings_of(classifier, dataset, goal)
            write_next(draft.files / "next" / goal, findings)
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


def findings_of(
    classifier: Classifier,
    dataset: Dataset,
    sub_goal: str,
) -> dict[str, Any]:
    """Return what a classifier says of a data file's states, and which states to label next.

    The result has ``numbers`` for ``audit.json``, and ``thresholds`` (K,). Of the unlabelled states to label next, best
    first, it has the rows ``rows``, how much members disagree ``disputed``, the ``states``, and what members say,
    ``scores`` (n, K). ``failures`` has, for each member, the negatives that it scores highest, and all members' scores
    of them.
    """
    thresholds = np.array(classifier.thresholds.tolist())
    known = joined([dataset.labelled(sub_goal), dataset.heldout(sub_goal)])
    unlabelled = dataset.unlabelled()
    if not len(unlabelled):
        raise UserError("there are no unlabelled states to audit on", dataset.path, "Import or collect some.")
    known_scores = classifier.predict(known.observations)
    scores = classifier.predict(unlabelled)

    rows, disputed = next_to_label(unlabelled, scores, thresholds, NEXT)
    failures = []
    negatives = np.flatnonzero(~known.labels)
    for of_member in known_scores[negatives].T:
        worst = negatives[np.argsort(-of_member, kind="stable")][:FAILURES]
        failures.append((known.observations[worst], known_scores[worst]))

    positive = scores[spread_rows(len(unlabelled), COMPARED)] > thresholds
    disagree = positive.any(axis=1) != positive.all(axis=1)
    numbers = {
        "sub_goal": sub_goal,
        "known": len(known.labels),
        "unlabelled": len(unlabelled),
        "disagreement": disagree.mean(),
        "members": member_table(known.labels, known_scores, scores, thresholds).to_dict("records"),
        "next": rows[:CARDS].tolist(),
    }
    return {
        "numbers": numbers,
        "thresholds": thresholds,
        "rows": rows,
        "disputed": disputed,
        "states": unlabelled[rows],
        "scores": scores[rows],
        "failures": failures,
    }


def write_next(folder: Path, findings: Mapping[str, Any]) -> None:
    """Write the states to label next: a table to fill in and, if states are pictures, a file of each.

    The files ``001.png``, ... are in the order of the table.
    """
    folder.mkdir(parents=True)
    lines = []
    each = zip(findings["rows"], findings["states"], findings["disputed"], strict=True)
    for number, (row, state, disputed) in enumerate(each, 1):
        name = ""
        picture = picture_of(state)
        if picture is not None:
            name = f"{number:03d}.png"
            Image.fromarray(picture).save(folder / name)
        lines.append([name, "", row, digest(state).hex(), disputed])
    table = pd.DataFrame(lines, columns=COLUMNS)
    table.round(4).to_csv(folder / TO_FILL_IN, index=False)


def member_table(
    labels: Array,
    known_scores: Array,
    scores: Array,
    thresholds: Array,
) -> pd.DataFrame:
    """Return a row for each member.

    The row has the member's false positives among known states (N, K), and its predictions of other states (M, K).
    """
    positive = scores > thresholds
    alone = positive & (positive.sum(axis=1, keepdims=True) == 1)
    of_failures = known_scores[~labels]
    columns = {
        "member": np.arange(len(thresholds)),
        "threshold": thresholds,
        "negatives": len(of_failures),
        "false_positives": (of_failures > thresholds).sum(axis=0),
        "highest_negative": of_failures.max(axis=0, initial=0.0),
        "positive_unlabelled": positive.mean(axis=0),
        "positive_alone": alone.mean(axis=0),
    }
    return pd.DataFrame(columns)
