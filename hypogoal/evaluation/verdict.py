"""The first thing on a page: what the task is, and whether hypotheses mattered there, by one rule (Spec F7, I1).

Two comparisons say so: the agent with uniform-random choice among its own options (did choosing matter?), and an agent
with several members with one that has a single classifier (did hypotheses matter?). On ladders the second is of the
options that validation picks.
"""

import math
from collections.abc import Iterator
from typing import Any

import pandas as pd

from hypogoal.domains.base import installed_domain
from hypogoal.evaluation.choosing import FROZEN
from hypogoal.evaluation.curves import chosen_by
from hypogoal.evaluation.house import compare, paired, per_run
from hypogoal.evaluation.judging import Work
from hypogoal.evaluation.names import ONE, ORACLE, UNIFORM
from hypogoal.evaluation.page import Results
from hypogoal.evaluation.rooms import VALIDATED
from hypogoal.evaluation.zero_shot import SCOPE as OTHER_LAYOUTS

MARGIN = 0.1  # a smaller difference between two shares of solved episodes is none
BETTER, WORSE, ALIKE, UNDECIDED = "better", "worse", "alike", "undecided"
CHOOSING, HYPOTHESES, OPTIONS = "choosing", "hypotheses", "options"  # what a finding is about


def facts(work: Work) -> dict[str, Any]:
    """The tasks of a run, in their domains' words, each agent's, and the cap of episodes, times the shortest path."""
    tasks, task_of = {}, {}
    for artefact in (*work.contents.agents, *work.contents.ladders):
        config = artefact.config
        domain = installed_domain(config["domain"])
        if domain is not None:
            task = domain.task(domain.world(config.get("domain_config") or {}))
            tasks[task] = config.get("cap")
            task_of[work.place(artefact)["method"]] = task
    cap = max(filter(None, tasks.values()), default=None)
    return {"tasks": [*filter(None, tasks)], "task_of": task_of, "cap": cap}


def outcome_of(difference: float, low: float, high: float) -> str:
    """What a difference of shares says; of one unit, whose bounds are NaN, the difference alone.

    An interval within ``MARGIN`` of 0 is no difference, one above or below 0 is a difference, any other undecided.
    """
    if math.isnan(low):
        low = high = difference
    if max(abs(low), abs(high)) < MARGIN:
        return ALIKE
    if low > 0:
        return BETTER
    return WORSE if high < 0 else UNDECIDED


def finding(
    subject: str,
    first: pd.DataFrame,
    second: pd.DataFrame,
    on: list[str],
) -> list[dict[str, Any]]:
    """Two shares, of runs that agree in ``on``; each layout or ladder counts once, or each run of one.

    Nothing without pairs.
    """
    both = paired(first, second.drop_duplicates(on), on)
    if both.empty:
        return []
    unit = "ladder" if subject == OPTIONS else "layout"
    result = compare(both.assign(of="success", copy=0), unit)
    several = both[unit].nunique() > 1 or result["units"] == 1
    outcome = outcome_of(result["difference"], result["difference_low"], result["difference_high"])
    last = {"unit": unit if several else "seed", "outcome": outcome}
    return [{"subject": subject} | result | last]


def findings(results: Results) -> list[dict[str, Any]]:
    """Of every agent that chooses among several members, and of options on ladders, what the comparisons say."""
    success = results.of(quantity="success", sub_goal="")
    played = success[success["scope"] == FROZEN]
    if played.empty:
        played = success[success["scope"] == OTHER_LAYOUTS]
    trained = success[(success["scope"] == "") & success["step"].isna()]
    uniform = played[played["method"] == UNIFORM]
    random = trained[trained["method"].isin([*chosen_by(results, "random")])]
    learned = chosen_by(results, "learned")
    single = [name for name in learned if learned[name]["members"] == 1]
    task_of = results.facts.get("task_of", {})
    result: list[dict[str, Any]] = []
    for name in learned:
        if name in single:
            continue
        frozen, trained_runs = played[played["method"] == name], trained[trained["method"] == name]
        of_choosing = finding(CHOOSING, frozen, uniform, ["artefact", "layout"])
        # random choice while learning has other options
        result += of_choosing or finding(CHOOSING, trained_runs, random, ["layout", "seed"])
        for other in single:
            if task_of.get(name) != task_of.get(other):
                continue
            theirs = played[played["method"] == other]
            if frozen.empty or theirs.empty:
                frozen, theirs = trained_runs, trained[trained["method"] == other]
            result += finding(HYPOTHESES, frozen, theirs, ["layout", "seed"])
    return [*result, *_of_ladders(results)]


def _of_ladders(results: Results) -> Iterator[dict[str, Any]]:
    """How often options stop at the base: the one of the member that validation picks, else the first."""
    numbers = results.numbers[results.numbers["ladder"] != ""]
    picked = per_run(numbers, "reached_base", member=VALIDATED)
    first = per_run(numbers[numbers["member"] == 0], "reached_base")
    rows = pd.concat([picked, first]).drop_duplicates(["artefact", "sub_goal"])
    single = rows[rows["method"] == ONE]
    for method in rows["method"].unique():
        if method != ONE and not method.startswith(ORACLE):
            yield from finding(OPTIONS, rows[rows["method"] == method], single, ["ladder", "seed", "N"])


def context(results: Results) -> dict[str, Any]:
    """For the template: findings, and what agents solved."""
    final = per_run(results.of(method=[*results.facts["agents"]]), "success")
    return {
        "results": results,
        "findings": findings(results),
        "agents": results.facts["agents"],
        "solved": final.groupby("method", sort=False)["value"].mean().to_dict(),
    }
