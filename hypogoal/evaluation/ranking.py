"""What members know of held-out states, wherever their thresholds lie and without the luck of picking the best."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from hypogoal.evaluation import page
from hypogoal.evaluation.numbers import Metrics, Row, grouped, mean_of, method_rank, over, rows_of
from hypogoal.evaluation.page import Block, Entry, Material, Question
from hypogoal.hypotheses.scores import best_threshold, by_member, cross_fitted, halves, member_scores, ranking

if TYPE_CHECKING:
    from hypogoal.evaluation.judging import Judgement, Work

OF_MEMBERS = ("ranking", "at_best_threshold", "calibration_gap")
CROSSED = {"ranking": "cross_fitted_ranking", "balanced_accuracy": "cross_fitted_accuracy"}
TITLE = "Ranking, whatever the threshold"


def known(
    probabilities: NDArray[np.float32],
    verdicts: NDArray[np.bool_],
    labels: NDArray[np.bool_],
    contexts: NDArray[np.int64] | None,
) -> dict[str, Any]:
    """What K members know of N states, by their probabilities and by their verdicts at their own thresholds, (N, K).

    ``contexts`` are the layouts or rooms that states are of, None where not known. ``members``: a row each, with
    ``ranking``, ``at_best_threshold`` (balanced accuracy) and ``calibration_gap`` (how much of that the member's own
    threshold loses); of the best member as half of the contexts picks it for the other, ``cross_fitted_ranking`` and
    ``cross_fitted_accuracy``, NaN for fewer than two contexts.
    """

    def scores(inside: NDArray[np.bool_]) -> dict[str, NDArray[np.float64]]:
        accuracy = member_scores(verdicts[inside], labels[inside])["balanced_accuracy"]
        return {"ranking": ranking(probabilities[inside], labels[inside]), "balanced_accuracy": accuracy}

    best, every = best_threshold(probabilities, labels)[1], scores(np.ones(len(labels), dtype=np.bool_))
    columns = {"ranking": every["ranking"], "at_best_threshold": best}
    columns["calibration_gap"] = best - every["balanced_accuracy"]
    first = None if contexts is None else halves(contexts)
    parts = None if first is None else (scores(first), scores(~first))
    return {
        "members": [{"member": member, **row} for member, row in enumerate(by_member(columns))],
        **{
            name: math.nan if parts is None else cross_fitted(parts[0][score], parts[1][score])
            for score, name in CROSSED.items()
        },
    }


def look(work: Work, judgement: Judgement) -> None:
    """Members on held-out states of contexts that training did not see."""
    origins, judged = judgement.split.origins, judgement.judged
    unseen = origins["seen"] == 0 if "seen" in origins else np.ones(len(judgement.split.labels), dtype=np.bool_)
    contexts = next((origins[name][unseen] for name in ("layout_seed", "room") if name in origins), None)
    labels = judgement.split.labels[unseen]
    judgement.row["ranking"] = known(judged.probabilities[unseen], judged.verdicts[unseen], labels, contexts)


def numbers(work: Work) -> dict[str, Any]:
    """Per kind of ensemble, N and sub-goal, over seeds: the mean member, and the cross-fitted best."""
    judged = [(ensemble, goal) for ensemble in work.ensembles for goal in ensemble["sub_goals"]]
    table = []
    cells = grouped(judged, _cell).items()  # sub-goals stay in the order of the data
    for key, alike in sorted(cells, key=lambda item: (method_rank(item[0][0]), item[0][0], item[0][1] or 0)):
        entry: dict[str, Any] = dict(zip(("name", "groups", "sub_goal"), key, strict=True))
        entry["ensembles"], cell = len(alike), [str(part) for part in key]
        for name in OF_MEMBERS:
            means = [
                mean_of([v for row in goal["ranking"]["members"] if not math.isnan(v := row[name])])
                for _, goal in alike
            ]
            entry[name] = over(means, "fraction", *cell, name)
        for name in CROSSED.values():
            entry[name] = over([goal["ranking"][name] for _, goal in alike], "fraction", *cell, name)
        table.append(entry)
    return {"ranking": table}


def _cell(judged: tuple[Entry, Entry]) -> tuple[str, int | None, str]:
    ensemble, goal = judged
    return ensemble.get("method", ensemble["name"]), ensemble.get("groups"), goal["sub_goal"]


def rows(metrics: Metrics, arrays: Mapping[str, Any]) -> Iterator[Row]:
    """Every member, and the cross-fitted best."""
    for ensemble in metrics["ensembles"]:
        about = {"method": ensemble.get("method", ensemble["name"]), "N": ensemble.get("groups")}
        about |= {"seed": ensemble["seed"], "artefact": ensemble["path"]}
        for goal in ensemble["sub_goals"]:
            about["sub_goal"] = goal["sub_goal"]
            apart = "rooms" in goal  # of which every score of the unseen ones is told, ranking among them
            told, scope = (OF_MEMBERS[1:], "unseen") if apart else (OF_MEMBERS, "heldout")
            for scores in goal["ranking"]["members"]:
                values = {name: scores[name] for name in told}
                yield from rows_of(values, **about, member=scores["member"], scope=scope)
            yield from rows_of({name: goal["ranking"][name] for name in CROSSED.values()}, **about, scope=scope)


COLUMNS = (
    page.label(
        "ensemble", lambda entry: entry["name"] + (f", N={entry['groups']}" if entry["groups"] else ""), once=True
    ),
    page.label("sub-goal", "sub_goal"),
    page.number("ranking: best, cross-fitted", "cross_fitted_ranking", page.spread, 3),
    page.number("mean", "ranking", page.spread, 3),
    page.number("bal. acc.: best, cross-fitted", "cross_fitted_accuracy", page.spread, 3),
    page.number("at best threshold", "at_best_threshold", page.spread, 3),
    page.number("lost by the threshold", "calibration_gap", page.spread, 3),
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
        "On held-out states of layouts or rooms that no training set holds; mean over ensemble seeds ± standard error."
    )
    blocks = [page.table(COLUMNS, material.metrics["ranking"], caption=caption)]
    return [page.section("ranking", TITLE, [text], blocks, folded=True)]


QUESTION = Question(look=look, numbers=numbers, rows=rows, sections=sections)
