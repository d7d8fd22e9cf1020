"""What members do on recorded data, as numbers and as sections of a page (Spec I6)."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from hypogoal.core.artefacts import TO_FILL_IN, Artefact, versions
from hypogoal.core.errors import UserError
from hypogoal.core.files import write_table
from hypogoal.data import States, joined, open_dataset
from hypogoal.evaluation import page, recorded
from hypogoal.evaluation.page import Block
from hypogoal.evaluation.pictures import image_png
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
    section: Block
    rows: NDArray[np.int64]  # of the unlabelled states to label next, best first
    disputed: NDArray[np.float64]  # how much members disagree on them


def findings_of(look: Look) -> Findings:
    """A sub-goal's numbers, its section of the page, and the states to label next."""
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
    section = _section(look, numbers, rows, sketches, proposed, disputed)
    return Findings(numbers, section, rows[proposed], disputed[proposed])


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
        picture = recorded.picture_of(state)
        name = "" if picture is None else f"{number + 1:03d}.png"
        if picture is not None:
            (folder / name).write_bytes(image_png(picture))
        lines.append([name, "", int(rows[number]), digest(state).hex(), round(float(disputed[number]), 4)])
    write_table(folder / TO_FILL_IN, columns, lines)


def draw(name: str, sections: list[Block], lines: Sequence[str]) -> str:
    """The page of an audit of the artefact called ``name``; ``lines`` come first."""
    lead = {"task": "", "verdict": lines, "baselines": "", "films": [], "question": ""}
    version = versions().get("hypogoal", "unknown")
    subtitle = f"recorded data; hypogoal {version}"
    return page.draw_page(f"hypogoal: audit of {name}", subtitle, sections, version, lead)


def lines_of(parts: Sequence[dict[str, Any]]) -> list[str]:
    """The findings in a few lines, for the page and the terminal."""
    lines = []
    for part in parts:
        worst = max(part["members"], key=lambda row: row["false_positives"])
        lines.append(
            f"{part['sub_goal']}: {_describe_unlabelled(part)}; of {worst['negatives']} known failures member "
            f"{worst['member']} predicts {worst['false_positives']} positive (highest probability "
            f"{worst['highest_negative']:.2f})"
        )
    return lines


def _describe_unlabelled(part: dict[str, Any]) -> str:
    """How members differ on unlabelled states, and which of them hold all of these for the same."""
    shares = [row["positive_unlabelled"] for row in part["members"]]
    states = f"{part['unlabelled']:,} unlabelled states"
    if len(shares) == 1:
        return f"the classifier predicts {shares[0]:.1%} of {states} positive"
    alike = [str(member) for member, share in enumerate(shares) if share in (0.0, 1.0)]
    which = f" (the same prediction for all of them: member {', '.join(alike)})" if alike else ""
    return f"members disagree in {part['disagreement']:.1%} of {states}{which}"


def _section(
    look: Look,
    numbers: dict[str, Any],
    rows: NDArray[np.int64],
    sketches: NDArray[np.float64],
    proposed: NDArray[np.int64],
    disputed: NDArray[np.float64],
) -> Block:
    columns = [
        page.label("member", lambda row: str(row["member"])),
        page.number("threshold", "threshold", page.fixed, 2),
        page.number("false positives", lambda row: f"{row['false_positives']} of {row['negatives']}"),
        page.number("highest negative", "highest_negative", page.fixed, 2),
        page.number("positive, unlabelled", "positive_unlabelled", page.percent),
        page.number("alone", "positive_alone", page.percent),
    ]
    caption = (
        "False positives among labelled and held-out states. Highest negative: the probability of the failure that a "
        "policy would be drawn to first. Alone: unlabelled states that no other member predicts positive."
    )
    blocks: list[Block] = [page.table(columns, numbers["members"], caption=caption, heading="Members")]
    measure = "disagreement" if len(look.ensemble) > 1 else "prediction"
    titles = [f"state {rows[row]}, {measure} {disputed[row]:.2f}" for row in proposed[:CARDS]]
    shown = [(look.unlabelled[rows[row]], look.scores[rows[row]]) for row in proposed[:CARDS]]
    blocks += _cards(look, "To label next", zip(titles, *zip(*shown, strict=True), strict=True))
    for member in range(len(look.ensemble)):
        blocks += _drawn_to(look, member) + _pairs(look, member, rows, sketches)
    paragraphs = [
        f"{len(look.known.labels):,} labelled and held-out states. Beyond them {_describe_unlabelled(numbers)}."
    ]
    return page.section(page.slug(look.sub_goal), look.sub_goal, paragraphs, blocks)


def _cards(look: Look, heading: str, states: Any) -> list[Block]:
    """Cards of states, each a title, an observation and its scores (K,); none of states without pictures."""
    cards = []
    for title, state, scores, *turned in states:
        picture = recorded.picture_of(state, *turned)
        if picture is None:
            return []
        lines = [
            {"class": "positive" if score > threshold else "negative", "text": f"member {member}: {score:.2f}"}
            for member, (score, threshold) in enumerate(zip(scores.tolist(), look.thresholds.tolist(), strict=True))
        ]
        cards.append({"png": page.encoded(page.image_png(picture)), "alt": title, "title": title, "lines": lines})
    return [{"kind": "cards", "heading": heading, "cards": cards, "small": True}] if cards else []


def _drawn_to(look: Look, member: int) -> list[Block]:
    """The known failures that a member scores highest, with the patch that says most of it."""
    tempting = recorded.tempting(look.known, look.known_scores[:, member], SHOWN)
    threshold = look.thresholds[member]
    rejected = np.flatnonzero(look.scores[:, member] <= threshold)

    def shown() -> Iterator[tuple[Any, ...]]:
        for row in tempting:
            state, scores = look.known.observations[row], look.known_scores[row]
            turned = None
            if scores[member] > threshold and len(rejected):
                some = rejected[spread_rows(len(rejected), REJECTED)]
                sketches = recorded.sketches_of(np.concatenate([state[None], look.unlabelled[some]]))
                nearest = some[np.linalg.norm(sketches[1:] - sketches[0], axis=1).argmin()]
                turned = recorded.turning_patch(state, look.unlabelled[nearest], member, look.ensemble.predict)
            title = (
                "a failure"
                if turned is None
                else f"a false positive; {turned.after:.2f} with the framed patch exchanged"
            )
            yield title, state, scores, turned

    return _cards(look, f"Member {member}: failures that a policy would be drawn to", shown())


def _pairs(look: Look, member: int, rows: NDArray[np.int64], sketches: NDArray[np.float64]) -> list[Block]:
    """The nearest unlabelled states with opposite predictions of a member, side by side."""
    positive = look.scores[rows, member] > look.thresholds[member]
    pairs = recorded.opposite_pairs(sketches, positive, SHOWN)
    states = [
        (f"pair {number}, state {rows[row]}", look.unlabelled[rows[row]], look.scores[rows[row]])
        for number, (first, second, _) in enumerate(pairs, 1)
        for row in (first, second)
    ]
    return _cards(look, f"Member {member}: nearest states with opposite predictions", states)
