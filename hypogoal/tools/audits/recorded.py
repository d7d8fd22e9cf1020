"""What recorded states say of a classifier, without a simulator.

Where members disagree, which failures they take for a success, and which states to label next.
"""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from PIL import Image

from hypogoal.core.arrays import Bools, Doubles, Floats
from hypogoal.core.artefacts import TO_FILL_IN
from hypogoal.core.errors import UserError
from hypogoal.data import Dataset, joined
from hypogoal.evaluation.pictures import picture_of
from hypogoal.hypotheses.labelling import COMPARED, next_to_label
from hypogoal.observations import digest, spread_rows
from hypogoal.tools.audits.classifiers import Classifier

NEXT = 100  # states to label next in the table
# Of the table: the picture's file, the label (1, 0 or nothing yet), the row among the unlabelled states and its
# :func:`hypogoal.observations.digest`, how much members disagree.
COLUMNS = ["name", "label", "row", "digest", "disagreement"]
CARDS, FAILURES = 20, 4  # on the page: of these, and of each member's failures


def findings_of(
    classifier: Classifier,
    dataset: Dataset,
    sub_goal: str,
) -> dict[str, Any]:
    """What it says of a data file's states, and which to label next.

    Returns ``numbers`` of ``audit.json``; ``thresholds`` (K,); of unlabelled states to label next, best first, ``rows``
    (which they are), ``disputed`` (how much members disagree), ``states`` and ``scores``, what members say (n, K);
    ``failures``: of each member those that it scores highest, a list of states and one of all members' scores.
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
    """Write the states to label next: a table to fill in, and pictures ``001.png``, ... in its order, if they are."""
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
    labels: Bools,
    known_scores: Floats,
    scores: Floats,
    thresholds: Doubles,
) -> pd.DataFrame:
    """A row for each member: its false positives among known states (N, K), its predictions of others (M, K)."""
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
