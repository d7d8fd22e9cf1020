"""What stands behind Figure 3: every kind of false positive, every room and every member."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from hypogoal.evaluation.page.blocks import Block, Material, fixed, row, table

SCOPES = {"unseen": "unseen rooms", "all": "all rooms"}
SEEN = {0: "no", 1: "unlabelled", 2: "labelled"}


def group_numbers(rows: Sequence[Mapping[str, Any]]) -> list[int | None]:
    """The Ns of some rows, ascending, None (no such thing) last."""
    return sorted({entry["groups"] for entry in rows}, key=lambda groups: (groups is None, groups or 0))


def group_name(groups: int | None) -> str:
    """N as a table shows it."""
    return "–" if groups is None else str(groups)


def _ensembles(material: Material, entry: Mapping[str, Any]) -> list[Mapping[str, Any]]:
    """The sub-goal rows of all ensembles (seeds) behind a row of the table."""
    found = []
    for ensemble in material.metrics["ensembles"]:
        if ensemble.get("method") == entry["method"] and ensemble["groups"] == entry["groups"]:
            found += [goal for goal in ensemble["sub_goals"] if goal["sub_goal"] == entry["sub_goal"]]
    return found


def kinds_tables(material: Material, rows: Sequence[Mapping[str, Any]]) -> list[Block]:
    """A table for each N: what share of each kind of negatives members call reached."""
    blocks = []
    for place, groups in enumerate(group_numbers(rows)):
        here = [entry for entry in rows if entry["groups"] == groups]
        found = [[goal["rooms"] for goal in _ensembles(material, entry)] for entry in here]
        kinds = {
            (one["scope"], one["kind"]): one["negatives"]
            for own in found
            for rooms in own
            for one in rooms["false_positives"]
        }
        lines: list[dict[str, Any]] = []
        for (scope, kind), negatives in kinds.items():
            cells = []
            for own in found:
                shares = [_shares(rooms, scope, kind) for rooms in own]
                cells.append(_percent([float(np.mean(share)) for share, _ in shares]))
                cells.append(_percent([picked for _, picked in shares if picked is not None]))
            first = not lines or lines[-1]["scope"] != scope
            line = row(SCOPES[scope] if first else "", kind, f"{negatives:,}", *cells, mark="first" if first else "")
            lines.append({**line, "scope": scope})
        if lines:
            name = f"False positives by kind, N={group_name(groups)}"
            columns = [f"{entry['method']}: {which}" for entry in here for which in ("mean", "validated")]
            blocks.append(
                table(
                    ("held-out states of", "negatives", "states", *columns),
                    lines,
                    texts=2,
                    tight=True,
                    heading=name if place == 0 else "",
                    folded="" if place == 0 else name,
                    caption="Share of each kind of negatives that a member calls reached, in %: mean over members and "
                    "seeds, and of the validated member, mean over seeds. Balanced accuracy hides these: a "
                    "member that says yes on the ladder ends an option half-way.",
                )
            )
    return blocks


def _shares(rooms: Mapping[str, Any], scope: str, kind: str) -> tuple[list[float], float | None]:
    """Of one ensemble every member's share, and the validated member's."""
    for one in rooms["false_positives"]:
        if (one["scope"], one["kind"]) == (scope, kind):
            validated = rooms["validated"]["member"]
            return one["share"], None if validated is None else one["share"][validated]
    return [float("nan")], None


def _percent(values: Sequence[float]) -> str:
    known = [value for value in values if not np.isnan(value)]
    return f"{100 * float(np.mean(known)):.1f}" if known else "–"


def room_tables(material: Material, rows: Sequence[Mapping[str, Any]]) -> list[Block]:
    """A folded table for each N: accuracies in every room."""
    blocks = []
    for groups in group_numbers(rows):
        here = [entry for entry in rows if entry["groups"] == groups]
        found = [[goal["rooms"]["by_room"] for goal in _ensembles(material, entry)] for entry in here]
        lines = []
        for index, room in enumerate(found[0][0] if found and found[0] else ()):
            cells = []
            for own in found:
                for score in ("balanced_accuracy", "accuracy"):
                    values = [value for by_room in own for value in by_room[index][score] if value is not None]
                    cells.append(fixed(float(np.mean(values)) if values else None, 2))
            about = (str(room["room"]), SEEN.get(room["seen"], str(room["seen"])))
            lines.append(row(*about, f"{room['states']:,}", f"{room['positives']:,}", *cells))
        if lines:
            columns = [f"{entry['method']}: {name}" for entry in here for name in ("bal. acc.", "accuracy")]
            blocks.append(
                table(
                    ("room", "in training", "states", "positives", *columns),
                    lines,
                    texts=2,
                    tight=True,
                    folded=f"Every room, N={group_name(groups)}",
                    caption="Mean over members and ensemble seeds, on the room's held-out states. Rooms without a "
                    "ladder base have no positives and so no balanced accuracy.",
                )
            )
    return blocks


def members_table(material: Material) -> Block:
    """A folded table of every member of every ensemble."""
    lines = []
    count = 0
    for ensemble in material.metrics["ensembles"]:
        for goal in ensemble["sub_goals"]:
            if "rooms" not in goal:
                continue
            count += 1
            scopes, validated = goal["rooms"]["scopes"], goal["rooms"]["validated"]["member"]
            for index, member in enumerate(goal["members"]):
                scores = [
                    fixed(scopes[scope]["members"][index][score], 3)
                    for scope, names in (
                        ("unseen", ("balanced_accuracy", "accuracy", "precision", "recall")),
                        ("all", ("balanced_accuracy", "accuracy", "precision", "recall")),
                        ("labelled", ("balanced_accuracy",)),
                    )
                    for score in names
                ]
                lines.append(
                    row(
                        ensemble["path"] if index == 0 else "",
                        f"{index}{' (validated)' if index == validated else ''}",
                        *scores,
                        fixed(member["says_yes_unlabelled"], 3),
                        mark="first" if index == 0 else "",
                    )
                )
    columns = [f"{scope}: {score}" for scope in ("unseen", "all") for score in ("bal. acc.", "acc.", "prec.", "recall")]
    return table(
        ("ensemble", "member", *columns, "validation: bal. acc.", "yes, unlabelled"),
        lines,
        texts=2,
        tight=True,
        folded=f"Every member of {count} ensembles",
        caption="Validation: held-out states in rooms of labelled groups. The last column is the share of unlabelled "
        "states that the member calls positive.",
    )
