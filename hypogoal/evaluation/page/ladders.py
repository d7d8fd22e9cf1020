"""The section that says what a run with ladders asked and what came out."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from hypogoal.evaluation.distance import ORACLE
from hypogoal.evaluation.page.blocks import Block, Material, cell, deviation, fixed, row, section, table
from hypogoal.evaluation.summary import percent


def ladders_section(material: Material) -> Block:
    """The question, the answer in two sentences, and the headline table."""
    metrics = material.metrics
    asked = (
        "A sub-goal, to be at the base of a ladder, is known from a few rooms only. An ensemble of classifiers holds "
        "several hypotheses about what the sub-goal is. Does one of them hold in rooms that training never saw, can it "
        "be found, and does an option that ends where it says so end at the base of a ladder?"
    )
    alone = not metrics["agents"]
    identity, title = ("summary", "Summary") if alone else ("ladders", "Summary of the ladders")
    answers = [_hypotheses(metrics["rooms"]), _options(metrics["distance"]["over_ladders"])]
    missing = metrics["missing"] if alone else []
    return section(identity, title, [asked, " ".join(filter(None, answers))], _headline(metrics), missing)


def _hypotheses(rows: Sequence[Mapping[str, Any]]) -> str:
    few = [entry for entry in rows if entry["groups"] == min((one["groups"] or 0 for one in rows), default=0)]
    parts = []
    for entry in few:
        found = entry["scores"]["unseen"]["balanced_accuracy"]
        if found["best"]["mean"] is not None:
            parts.append(
                f"{entry['method']}: {fixed(found['best']['mean'], 2)} (validated "
                f"{fixed(found['validated']['mean'], 2)})"
            )
    if not parts:
        return ""
    return (
        f"With the fewest labels (N={few[0]['groups']}), balanced accuracy of the best member on rooms that training "
        f"never saw: {'; '.join(parts)}; 0.5 is chance."
    )


def _options(rows: Sequence[Mapping[str, Any]]) -> str:
    known = [entry for entry in rows if entry["best"]["mean"] is not None]
    learned = [entry for entry in known if not entry["method"].startswith(ORACLE)]
    if not learned:
        return ""
    near = min(learned, key=lambda entry: entry["best"]["mean"])
    oracle = next((entry for entry in known if entry["method"].startswith(ORACLE)), None)
    beside = f"; options that end at the true sub-goal: {fixed(oracle['best']['mean'], 0)}" if oracle else ""
    return (
        f"The best member's options stop {fixed(near['best']['mean'], 0)} units of position from a true base at best, "
        f"the mean member's {fixed(near['mean']['mean'], 0)} ({near['method']}, N={near['groups']}), mean over "
        f"{len(near['ladders'])} ladders{beside}."
    )


def _headline(metrics: Mapping[str, Any]) -> list[Block]:
    over = {
        (entry["method"], entry["groups"], entry["sub_goal"]): entry for entry in metrics["distance"]["over_ladders"]
    }
    scored = {(entry["method"], entry["groups"], entry["sub_goal"]): entry for entry in metrics["rooms"]}
    lines, last = [], ""
    for key in dict.fromkeys([*scored, *over]):
        method, groups, _ = key
        scores = scored.get(key)
        distance = over.get(key)
        unseen = [
            deviation(scores["scores"]["unseen"]["balanced_accuracy"][which], 2) if scores else cell("–")
            for which in ("best", "validated", "mean")
        ]
        lines.append(
            row(
                method if method != last else "",
                "–" if groups is None else str(groups),
                *unseen,
                deviation(scores["scores"]["all"]["accuracy"]["best"], 2) if scores else cell("–"),
                *(deviation(distance[which], 1) if distance else cell("–") for which in ("best", "mean")),
                percent(distance["reached_base"]["mean"]) if distance else "–",
                mark="first" if method != last else "",
            )
        )
        last = method
    return [
        table(
            (
                "method",
                "N",
                "unseen: best",
                "unseen: validated",
                "unseen: mean",
                "all: best acc.",
                "distance: best",
                "mean",
                "at base: best",
            ),
            lines,
            texts=2,
            tight=True,
            caption="Unseen: balanced accuracy on rooms that no training state came from, of the best, the "
            "validated and the mean member. All: accuracy of the best member on all held-out rooms, training "
            "rooms included: the paper's Figure 3. Distance, in units of position: where options stop, from the "
            "nearest true base, mean over ladders, of the best member (the paper's Figure 4, lower is better) and of "
            "the mean one; and the share of the best one's executions that got to a base. Mean over seeds ± standard "
            "deviation; N: labelled ladder groups.",
        )
    ]
