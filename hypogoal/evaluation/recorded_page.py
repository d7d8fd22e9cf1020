"""What members do on recorded data, as numbers and as sections of a page (Spec I6)."""

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from numpy.typing import NDArray
from PIL import Image

from hypogoal.core.artefacts import TO_FILL_IN, Artefact
from hypogoal.core.errors import UserError
from hypogoal.core.files import write_table
from hypogoal.data import States, joined, open_dataset
from hypogoal.evaluation import recorded
from hypogoal.evaluation.page import draw_page, fixed, percent, picture, section, templates
from hypogoal.evaluation.plots import slug
from hypogoal.hypotheses.ensemble import Ensemble, read_ensemble
from hypogoal.observations import Observations, digest, spread_rows

COMPARED = 4_000  # unlabelled states, spread over the file
SHOWN = 4  # negatives and pairs of a member on the page
NEXT, CARDS = 100, 20  # states to label next in the table, and on the page
REJECTED = 500  # states among which the nearest is sought that a member rejects


@dataclass(frozen=True)
class Look:
    """One sub-goal's ensemble on its data."""

    sub_goal: str
    ensemble: Ensemble
    known: States  # labelled and held out
    known_scores: NDArray[np.float32]  # (N, K)
    unlabelled: Observations  # (M, *obs)
    scores: NDArray[np.float32]  # (M, K)

    @property
    def thresholds(self) -> NDArray[np.float32]:
        """Of the members, (K,)."""
        return self.ensemble.thresholds.cpu().numpy()


def look_at(artefact: Artefact, data: Path, sub_goal: str, device: str) -> Look:
    """The members' predictions of all states of the data file."""
    dataset = open_dataset(data)
    ensemble = read_ensemble(artefact.path, artefact.config, sub_goal).to(device)
    splits = dataset.labelled(sub_goal), dataset.heldout(sub_goal)
    labelled = joined([States(split.observations, split.labels) for split in splits])
    unlabelled = dataset.unlabelled()
    if not len(unlabelled):
        raise UserError("there are no unlabelled states to audit on", data, "Import or collect some.")
    known_scores, scores = ensemble.predict(labelled.observations), ensemble.predict(unlabelled)
    return Look(sub_goal, ensemble, labelled, known_scores, unlabelled, scores)


@dataclass(frozen=True)
class Findings:
    """What is found of one sub-goal's ensemble."""

    numbers: dict[str, Any]
    cards: list[dict[str, Any]]  # headings, each with its states
    rows: NDArray[np.int64]  # of the unlabelled states to label next, best first
    disputed: NDArray[np.float64]  # how much members disagree on them


def findings_of(look: Look) -> Findings:
    """A sub-goal's numbers, its states for the page, and the states to label next."""
    rows = spread_rows(len(look.unlabelled), COMPARED)  # the states that are compared
    scores = look.scores[rows]
    sketches = recorded.sketches_of(look.unlabelled[rows])
    disputed = recorded.disagreement(scores, look.thresholds)
    proposed = recorded.to_label(disputed * recorded.density_of(sketches), sketches, NEXT)
    positive = scores > look.thresholds
    disagree = (positive.any(1) & ~positive.all(1)).mean()
    numbers = {
        "sub_goal": look.sub_goal,
        "known": len(look.known.labels),
        "unlabelled": len(look.unlabelled),
        "disagreement": float(disagree),
        "members": recorded.member_findings(look.known, look.known_scores, look.scores, look.thresholds.tolist()),
        "next": [int(rows[row]) for row in proposed[:CARDS]],
    }
    measure = "disagreement" if len(look.ensemble) > 1 else "prediction"
    shown = []
    for row in proposed[:CARDS]:
        title = f"state {rows[row]}, {measure} {disputed[row]:.2f}"
        shown.append(_card(look, title, look.unlabelled[rows[row]], look.scores[rows[row]]))
    cards = [{"heading": "To label next", "states": shown}]
    for member in range(len(look.ensemble)):
        drawn = [*_drawn_to(look, member)]
        cards.append({"heading": f"Member {member}: failures that a policy would be drawn to", "states": drawn})
        pairs = [*_pairs(look, member, rows, sketches)]
        cards.append({"heading": f"Member {member}: nearest states with opposite predictions", "states": pairs})
    return Findings(numbers, cards, rows[proposed], disputed[proposed])


def write_next(
    folder: Path,
    columns: Sequence[str],
    states: Observations,
    rows: NDArray[np.int64],
    disputed: NDArray[np.float64],
) -> None:
    """Write proposed states (N, *obs), rows of the unlabelled ones, as pictures and a table to fill in.

    ``001.png``, ... are in the table's order; states without pictures have the table alone.
    """
    folder.mkdir(parents=True)
    lines = []
    for number, state in enumerate(states):
        shown = recorded.picture_of(state)
        name = "" if shown is None else f"{number + 1:03d}.png"
        if shown is not None:
            Image.fromarray(shown).save(folder / name)
        lines.append([name, "", int(rows[number]), digest(state).hex(), round(float(disputed[number]), 4)])
    write_table(folder / TO_FILL_IN, columns, lines)


def _card(
    look: Look, title: str, state: Any, scores: NDArray[np.float32], turned: recorded.Turned | None = None
) -> dict[str, Any] | None:
    """A state and its scores (K,); None of states without pictures."""
    shown = recorded.picture_of(state, turned)
    if shown is None:
        return None
    lines = []
    for member, (score, threshold) in enumerate(zip(scores, look.thresholds, strict=True)):
        lines.append({"positive": bool(score > threshold), "text": f"member {member}: {score:.2f}"})
    return {"source": picture(shown), "title": title, "lines": lines}


def _drawn_to(look: Look, member: int) -> Iterator[dict[str, Any] | None]:
    """The known failures that a member scores highest, with the patch that says most of it."""
    threshold = look.thresholds[member]
    rejected = np.flatnonzero(look.scores[:, member] <= threshold)
    for row in recorded.tempting(look.known, look.known_scores[:, member], SHOWN):
        state, scores = look.known.observations[row], look.known_scores[row]
        turned, title = None, "a failure"
        if scores[member] > threshold and len(rejected):
            some = rejected[spread_rows(len(rejected), REJECTED)]
            sketches = recorded.sketches_of(np.concatenate([state[None], look.unlabelled[some]]))
            nearest = some[np.linalg.norm(sketches[1:] - sketches[0], axis=1).argmin()]
            turned = recorded.turning_patch(state, look.unlabelled[nearest], member, look.ensemble.predict)
        if turned is not None:
            title = f"a false positive; {turned.after:.2f} with the framed patch exchanged"
        yield _card(look, title, state, scores, turned)


def _pairs(
    look: Look, member: int, rows: NDArray[np.int64], sketches: NDArray[np.float64]
) -> Iterator[dict[str, Any] | None]:
    """The nearest unlabelled states with opposite predictions of a member, side by side."""
    positive = look.scores[rows, member] > look.thresholds[member]
    pairs = recorded.opposite_pairs(sketches, positive, SHOWN)
    for number, (first, second, _) in enumerate(pairs, 1):
        for row in rows[[first, second]]:
            yield _card(look, f"pair {number}, state {row}", look.unlabelled[row], look.scores[row])


def draw(name: str, findings: Iterable[Findings]) -> str:
    """The page of an audit of the artefact called ``name``."""
    sections = []
    for of_goal in findings:
        cards = [{**group, "states": [card for card in group["states"] if card]} for group in of_goal.cards]
        context = {"numbers": of_goal.numbers, "table": _table(of_goal.numbers), "cards": cards}
        sub_goal = of_goal.numbers["sub_goal"]
        sections.append((slug(sub_goal), sub_goal, section("audited", context), False))
    lines = lines_of([of_goal.numbers for of_goal in findings])
    return draw_page(f"hypogoal: audit of {name}", sections, "audit.html", lines=lines)


def _table(numbers: dict[str, Any]) -> pd.DataFrame:
    rows = []
    for row in numbers["members"]:
        rows.append(
            {
                "member": row["member"],
                "threshold": fixed(row["threshold"]),
                "false positives": f"{row['false_positives']} of {row['negatives']}",
                "highest negative": fixed(row["highest_negative"]),
                "positive, unlabelled": percent(row["positive_unlabelled"]),
                "alone": percent(row["positive_alone"]),
            }
        )
    return pd.DataFrame(rows).set_index("member")


def lines_of(parts: Sequence[dict[str, Any]]) -> list[str]:
    """The findings in a few lines, for the page and the terminal."""
    template = templates().get_template("audited.txt")
    lines = []
    for part in parts:
        worst = max(part["members"], key=lambda row: row["false_positives"])
        alike = [row["member"] for row in part["members"] if row["positive_unlabelled"] in (0.0, 1.0)]
        lines.append(" ".join(template.render(part=part, worst=worst, alike=alike).split()))
    return lines
