"""The audit of an ensemble on recorded data: its findings, its page, and the states to label next (Spec I6)."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Self

import numpy as np
import pandas as pd
from numpy.typing import NDArray
from PIL import Image
from scipy.special import expit

from hypogoal.core.artefacts import TO_FILL_IN, Artefact
from hypogoal.core.errors import UserError
from hypogoal.data import Dataset, States, joined
from hypogoal.evaluation import page
from hypogoal.evaluation.audit import own_classifier
from hypogoal.evaluation.pictures import coloured
from hypogoal.evaluation.plots import slug
from hypogoal.evaluation.recorded import density_of, disagreement, member_table, sketches_of, to_label
from hypogoal.hypotheses.ensemble import THRESHOLD, read_ensemble
from hypogoal.observations import PICTURE, Observations, digest, fields_of, spread_rows

COMPARED = 4_000  # unlabelled states, spread over the file
NEXT = 100  # states to label next in the table
CARDS, FAILURES = 20, 4  # on the page: of these, and of each member's failures


def picture_of(state: Observations) -> NDArray[np.uint8] | None:
    """A state's pictures side by side, uint8 (H, W, 3); None without any."""
    parts = []
    for key, (dtype, _) in fields_of(state.shape, state.dtype).items():
        if dtype == PICTURE:
            parts.append(coloured(state[key] if key else state))
    if not parts:
        return None
    height = max(len(part) for part in parts)
    padded = [np.pad(part, ((0, height - len(part)), (0, 0), (0, 0)), constant_values=255) for part in parts]
    return np.concatenate(padded, axis=1)


@dataclass(frozen=True)
class Findings:
    """What is found of one sub-goal's ensemble."""

    numbers: dict[str, Any]  # of ``audit.json``
    members: pd.DataFrame  # a row each
    cards: dict[str, list[dict[str, Any]]]  # headings of the page, each with its states
    states: Observations  # to label next, best first, (n, *obs)
    rows: NDArray[np.int64]  # theirs, among the unlabelled ones
    disputed: NDArray[np.float64]  # how much members disagree on them


@dataclass(frozen=True)
class Judges:
    """Who judges states: the members of an ensemble, or one function."""

    predict: Callable[[Observations], NDArray[np.floating]]  # observations (n, *obs) -> probabilities (n, K)
    thresholds: NDArray[np.floating]  # (K,), above which a prediction is positive

    @classmethod
    def of_members(cls, artefact: Artefact, sub_goal: str, device: str) -> Self:
        ensemble = read_ensemble(artefact.path, artefact.config, sub_goal).to(device)
        return cls(ensemble.predict, ensemble.thresholds.cpu().numpy())

    @classmethod
    def of_function(cls, name: str) -> Self:
        """Code of the user's own, ``module:function``."""
        classify = own_classifier(name)
        return cls(lambda observations: expit(classify(observations))[:, None], np.array([THRESHOLD]))


def findings_of(judges: Judges, dataset: Dataset, sub_goal: str) -> Findings:
    """What they say of a data file's states, and which to label next."""
    thresholds = judges.thresholds
    splits = dataset.labelled(sub_goal), dataset.heldout(sub_goal)
    labelled = joined([States(split.observations, split.labels) for split in splits])
    unlabelled = dataset.unlabelled()
    if not len(unlabelled):
        raise UserError("there are no unlabelled states to audit on", dataset.path, "Import or collect some.")
    known_scores, scores = judges.predict(labelled.observations), judges.predict(unlabelled)

    compared = spread_rows(len(unlabelled), COMPARED)
    sketches = sketches_of(unlabelled[compared])
    disputed = disagreement(scores[compared], thresholds)
    proposed = to_label(disputed * density_of(sketches), sketches, NEXT)
    rows = compared[proposed]
    measure = "disagreement" if len(thresholds) > 1 else "prediction"
    titles = [f"state {row}, {measure} {disputed[place]:.2f}" for row, place in zip(rows, proposed, strict=True)]
    next_ones = rows[:CARDS]
    cards = {"To label next": _cards(titles, unlabelled[next_ones], scores[next_ones], thresholds)}
    failures = np.flatnonzero(~labelled.labels)
    for member, of_member in enumerate(known_scores[failures].T):
        drawn_to = failures[np.argsort(-of_member, kind="stable")][:FAILURES]
        heading = f"Member {member}: failures that a policy would be drawn to"
        titles = ["a failure"] * len(drawn_to)
        cards[heading] = _cards(titles, labelled.observations[drawn_to], known_scores[drawn_to], thresholds)

    members = member_table(labelled.labels, known_scores, scores, thresholds)
    positive = scores[compared] > thresholds
    disagree = positive.any(axis=1) & ~positive.all(axis=1)
    numbers = {
        "sub_goal": sub_goal,
        "known": len(labelled.labels),
        "unlabelled": len(unlabelled),
        "disagreement": float(disagree.mean()),
        "members": members.to_dict("records"),
        "next": next_ones.tolist(),
    }
    return Findings(numbers, members, cards, unlabelled[rows], rows, disputed[proposed])


def _cards(
    titles: Sequence[str], states: Observations, scores: NDArray[np.floating], thresholds: NDArray[np.floating]
) -> list[dict[str, Any]]:
    """States (n, *obs) with their scores (n, K) for the page; none of states without pictures."""
    cards = []
    for title, state, of_state in zip(titles, states, scores, strict=False):
        shown = picture_of(state)
        if shown is not None:
            lines = []
            for member, score in enumerate(of_state):
                lines.append({"positive": score > thresholds[member], "text": f"member {member}: {score:.2f}"})
            cards.append({"source": page.picture(shown), "title": title, "lines": lines})
    return cards


def write_next(folder: Path, columns: Sequence[str], findings: Findings) -> None:
    """Write the states to label next: a table to fill in, and pictures ``001.png``, ... in its order, if they are."""
    folder.mkdir(parents=True)
    lines = []
    for number, state in enumerate(findings.states):
        shown = picture_of(state)
        name = "" if shown is None else f"{number + 1:03d}.png"
        if shown is not None:
            Image.fromarray(shown).save(folder / name)
        lines.append([name, "", findings.rows[number], digest(state).hex(), findings.disputed[number]])
    table = pd.DataFrame(lines, columns=[*columns])
    table.round(4).to_csv(folder / TO_FILL_IN, index=False)


def draw(name: str, findings: Sequence[Findings]) -> str:
    """The page of an audit of the artefact called ``name``."""
    sections = []
    for of_goal in findings:
        members = of_goal.members
        shown = pd.DataFrame(
            {
                "member": members["member"],
                "threshold": members["threshold"].map(page.fixed),
                "false positives": members["false_positives"].astype(str) + f" of {members['negatives'][0]}",
                "highest negative": members["highest_negative"].map(page.fixed),
                "positive, unlabelled": members["positive_unlabelled"].map(page.percent),
                "alone": members["positive_alone"].map(page.percent),
            }
        )
        context = {"numbers": of_goal.numbers, "table": shown.set_index("member"), "cards": of_goal.cards}
        sub_goal = of_goal.numbers["sub_goal"]
        sections.append((slug(sub_goal), sub_goal, page.section("audited", context), False))
    lines = lines_of([of_goal.numbers for of_goal in findings])
    return page.draw_page(f"hypogoal: audit of {name}", sections, "audit.html", lines=lines)


def lines_of(parts: Sequence[dict[str, Any]]) -> list[str]:
    """The findings in a few lines, for the page and the terminal."""
    template = page.templates().get_template("audited.txt")
    return [" ".join(template.render(part=part).split()) for part in parts]
