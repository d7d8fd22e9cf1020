"""What members know of held-out states, wherever their thresholds lie and without the luck of picking the best."""

import math
from collections.abc import Iterator
from typing import Any

import numpy as np
from numpy.typing import NDArray

from hypogoal.evaluation import page
from hypogoal.evaluation.judging import Judgement, Work
from hypogoal.evaluation.numbers import method_rank
from hypogoal.evaluation.page import Block, Material, Question
from hypogoal.evaluation.table import Number, Row, Table, rows_by_member, rows_of, select, tabulate
from hypogoal.hypotheses.scores import best_threshold, cross_fitted, halves, member_scores, ranking

OF_MEMBERS = ("ranking", "at_best_threshold", "calibration_gap")
CROSSED = {"ranking": "cross_fitted_ranking", "balanced_accuracy": "cross_fitted_accuracy"}
HELDOUT = "heldout"
TITLE = "Ranking, whatever the threshold"
TABLE = Table(
    {"name": "method", "groups": "N", "sub_goal": "sub_goal"},
    {name: Number(name, HELDOUT) for name in (*OF_MEMBERS, *CROSSED.values())},
    "ensembles",
    order=lambda key: (method_rank(key[0]), key[0], key[1] or 0),  # sub-goals stay in the order of the data
)


def knowledge(
    probabilities: NDArray[np.float32],
    predictions: NDArray[np.bool_],
    labels: NDArray[np.bool_],
    contexts: NDArray[np.int64] | None,
) -> tuple[dict[str, NDArray[np.float64]], dict[str, float]]:
    """What K members know of N states, by their probabilities and predictions (N, K); ``contexts``: layouts or rooms.

    Returns of each member (K,) ``ranking``, ``at_best_threshold`` (balanced accuracy) and ``calibration_gap`` (how much
    of that its own threshold loses); and of the best member, picked on half of the contexts and scored on the other,
    ``cross_fitted_ranking`` and ``cross_fitted_accuracy``, NaN for fewer than two contexts.
    """

    def scores(inside: NDArray[np.bool_]) -> dict[str, NDArray[np.float64]]:
        accuracy = member_scores(predictions[inside], labels[inside])["balanced_accuracy"]
        return {"ranking": ranking(probabilities[inside], labels[inside]), "balanced_accuracy": accuracy}

    best, every = best_threshold(probabilities, labels)[1], scores(np.ones(len(labels), dtype=np.bool_))
    gap = best - every["balanced_accuracy"]
    columns = {"ranking": every["ranking"], "at_best_threshold": best, "calibration_gap": gap}
    first = None if contexts is None else halves(contexts)
    if first is None:
        return columns, dict.fromkeys(CROSSED.values(), math.nan)
    parts = scores(first), scores(~first)
    return columns, {name: cross_fitted(parts[0][score], parts[1][score]) for score, name in CROSSED.items()}


def look(work: Work, judgement: Judgement) -> Iterator[Row]:
    """Members on held-out states of contexts that training did not see."""
    origins, judged, place = judgement.split.origins, judgement.judged, work.place(judgement)
    by_room = "seen" in origins
    unseen = origins["seen"] == 0 if by_room else np.ones(len(judgement.split.labels), dtype=np.bool_)
    contexts = next((origins[name][unseen] for name in ("layout_seed", "room") if name in origins), None)
    labels = judgement.split.labels[unseen]
    columns, crossed = knowledge(judged.probabilities[unseen], judged.predictions[unseen], labels, contexts)
    if by_room:  # ``rooms`` has their ranking
        del columns["ranking"]
    scope = "unseen" if by_room else HELDOUT
    yield from rows_by_member(columns, **place, scope=scope)
    yield from rows_of(crossed, **place, scope=scope)


def view(work: Work) -> dict[str, Any]:
    """Per kind of ensemble, N and sub-goal, over seeds: the mean member, and the cross-fitted best."""
    judged = select(work.rows, quantity=tuple(TABLE.numbers), scope=(HELDOUT, "unseen"))
    return {"ranking": tabulate((row._replace(scope=HELDOUT) for row in judged), TABLE)}


SCORES = {
    "ranking: best, cross-fitted": "cross_fitted_ranking",
    "mean": "ranking",
    "bal. acc.: best, cross-fitted": "cross_fitted_accuracy",
    "at best threshold": "at_best_threshold",
    "lost by the threshold": "calibration_gap",
}
COLUMNS = (
    page.label(
        "ensemble", lambda entry: entry["name"] + (f", N={entry['groups']}" if entry["groups"] else ""), once=True
    ),
    page.label("sub-goal", "sub_goal"),
    *(page.number(title, score, page.spread, 3) for title, score in SCORES.items()),
    page.number("seeds", "ensembles"),
)


def sections(material: Material) -> list[Block]:
    """One table."""
    if not material.metrics["ranking"]:
        return []
    text = (
        "Ranking is the area under the ROC curve: the share of pairs of a positive and a negative in which a member "
        "gives the positive the higher probability. It says what a member knows; balanced accuracy also says whether "
        "its threshold lies where it should. The best member is picked on every other held-out layout or room and "
        "scored on the rest, and the other way round, so that it is not best by luck."
    )
    caption = (
        "On held-out states of layouts or rooms without training states; mean over ensemble seeds ± standard error."
    )
    table = page.table(COLUMNS, material.metrics["ranking"], caption=caption)
    return [page.section("ranking", TITLE, [text], [table], folded=True)]


QUESTION = Question(look=look, view=view, sections=sections)
