"""What recorded states say of a classifier, without a simulator (Spec I6).

Where members disagree, which failures they take for a success, and which states to label next.
"""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from PIL import Image
from scipy.spatial import KDTree
from scipy.spatial.distance import cdist
from scipy.special import expit

from hypogoal.core.arrays import Bools, Doubles, Floats, Ints
from hypogoal.core.artefacts import TO_FILL_IN
from hypogoal.core.errors import UserError
from hypogoal.data import Dataset, joined
from hypogoal.domains.observations import resized_picture
from hypogoal.evaluation.classifiers import Classifier
from hypogoal.evaluation.pictures import picture_of
from hypogoal.hypotheses.thresholds import log_odds_of
from hypogoal.observations import (
    PICTURE,
    Observations,
    digest,
    fields_of,
    numbers_of,
    spread_rows,
    standard_of,
    standardised,
)

GRID = 16  # areas along a side of a picture, whose means are compared
DIRECTIONS = 16  # of the states' largest variance
NEIGHBOURS = 10  # whose distance says how dense states are
SAMPLE = 500  # states whose usual distance is taken
COMPARED = 4_000  # unlabelled states, spread over the file
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


def next_to_label(states: Observations, scores: Floats, thresholds: Doubles, count: int) -> tuple[Ints, Doubles]:
    """Which of unlabelled states (N, *obs) to label next, best first, and how much members differ there.

    Those where ``scores`` (N, K) differ much, that are common and unlike those before; among ``COMPARED`` at most.
    """
    compared = spread_rows(len(states), COMPARED)
    sketches = sketches_of(states[compared])
    disputed = disagreement(scores[compared], thresholds)
    proposed = to_label(disputed * density_of(sketches), sketches, count)
    return compared[proposed], disputed[proposed]


def sketches_of(observations: Observations) -> Doubles:
    """Observations (N, *obs) as few numbers (N, D), alike where states look alike: the directions of largest variance.

    A picture counts as much as all numbers together.
    """
    numbers = numbers_of(observations)
    parts = [standardised(numbers, *standard_of(numbers.shape[1:], numbers))]
    for key, (dtype, shape) in fields_of(observations.shape[1:], observations.dtype).items():
        if dtype == PICTURE:
            height, width = np.minimum(shape[:2], GRID)
            pictures = observations[key] if key else observations
            small = [resized_picture(picture, height, width).ravel() for picture in pictures]
            parts.append(np.stack(small) / 255.0)
    weighed = [part / (np.sqrt(part.var(axis=0).sum()) or 1.0) for part in parts if part.shape[1]]
    values = np.concatenate(weighed, axis=1).astype(float)
    values -= values.mean(axis=0)
    _, directions = np.linalg.eigh(values.T @ values)
    return values @ directions[:, ::-1][:, :DIRECTIONS]


def disagreement(probabilities: Floats, thresholds: Doubles) -> Doubles:
    """How much members' predictions (N, K) differ, 0 to 1: the mean over pairs, each about its own threshold (K,).

    Of one member, which cannot disagree, its own prediction, 0.5 at its threshold: the more, the more a policy is paid.
    """
    centred = expit(log_odds_of(probabilities) - log_odds_of(thresholds))
    if centred.shape[1] == 1:
        return centred[:, 0]
    first, second = np.triu_indices(centred.shape[1], 1)
    return np.abs(centred[:, first] - centred[:, second]).mean(axis=1)


def density_of(sketches: Doubles) -> Doubles:
    """How common each state is (N,): 1 where its ten nearest are as far as usual, up to e where they are nearer."""
    neighbours = min(NEIGHBOURS + 1, len(sketches))
    distances, _ = KDTree(sketches).query(sketches, [*range(1, neighbours + 1)])
    near = distances.mean(axis=1)
    return np.exp(1 - near / (np.median(near) or 1.0))


def to_label(scores: Doubles, sketches: Doubles, count: int) -> Ints:
    """The rows of ``count`` states to label next, best first: with a high score, and unlike those before.

    The score (N,), at least 0, times how far the nearest row before is: 0 there, 1 at the usual distance of two states.
    """
    some = sketches[spread_rows(len(sketches), SAMPLE)]
    usual = np.median(cdist(some, some)) or 1.0
    rows: list[int] = []
    apart = np.ones(len(scores))
    for _ in range(min(count, len(scores))):
        worth = scores * apart
        worth[rows] = -1
        rows.append(int(worth.argmax()))
        distance = np.linalg.norm(sketches - sketches[rows[-1]], axis=1) / usual
        apart = np.minimum(apart, 1 - np.exp(-(distance**2)))
    return np.array(rows)


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
