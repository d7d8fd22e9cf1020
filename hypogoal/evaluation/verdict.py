"""The first thing on a page: what the task is, and whether hypotheses mattered there, by one rule.

Two comparisons say so: the agent with uniform-random choice among its own options (did choosing matter?), and an agent
with several members with one that has a single classifier (did hypotheses matter?). On ladders the second is of the
options that validation picks.
"""

import math
from typing import Any

import pandas as pd

from hypogoal.domains.base import installed_domain
from hypogoal.evaluation.choosing import FROZEN
from hypogoal.evaluation.curves import chosen_by
from hypogoal.evaluation.hypotheses import VALIDATED
from hypogoal.evaluation.names import ONE, ORACLE, UNIFORM
from hypogoal.evaluation.run import Results
from hypogoal.evaluation.statistics import MEDIANS_FROM, compare, paired
from hypogoal.evaluation.table import per_run
from hypogoal.evaluation.zero_shot import SCOPE as OTHER_LAYOUTS

MARGIN = 0.1  # a smaller difference between two shares of solved episodes is none
BETTER, WORSE, ALIKE, UNDECIDED = "better", "worse", "alike", "undecided"
CHOOSING, HYPOTHESES, OPTIONS = "choosing", "hypotheses", "options"  # what a finding is about


def facts(work):
    """The tasks of a run, in their domains' words, each agent's, and the cap of episodes, times the shortest path."""
    task_of, tasks, caps = {}, [], []
    for artefact in (*work.contents.agents, *work.contents.ladders):
        config = artefact.config
        task = ""
        domain = installed_domain(config["domain"])
        if domain is not None:
            task = domain.task(domain.world(config.get("domain_config") or {}))
            tasks.append(task)
            caps.append(config.get("cap") or 0)
        task_of[work.place(artefact)["method"]] = ", ".join([task, *config.get("world", ())])
    tasks = [*dict.fromkeys(filter(None, tasks))]
    return {"tasks": tasks, "task_of": task_of, "cap": max(caps, default=0)}


def outcome_of(low: float, high: float) -> str:
    """What the interval of a difference of shares says; of too few units for one, the range of their differences.

    Within ``MARGIN`` of 0 it is no difference, above or below 0 it is a difference, any other is undecided.
    """
    if max(abs(low), abs(high)) < MARGIN:
        return ALIKE
    if low > 0:
        return BETTER
    return WORSE if high < 0 else UNDECIDED


def finding(subject: str, first: pd.DataFrame, second: pd.DataFrame, on: list[str]) -> list[dict[str, Any]]:
    """Two shares, of runs that agree in ``on``; each layout or ladder counts once, or each run of one.

    Nothing without pairs.
    """
    both = paired(first, second.drop_duplicates(on), on)
    if both.empty:
        return []
    result = compare(both.assign(of="success"), "ladder" if subject == OPTIONS else "layout")
    low, high = result["difference_low"], result["difference_high"]
    if math.isnan(low):
        low, high = result["difference_least"], result["difference_most"]
    return [{"subject": subject, **result, "outcome": outcome_of(low, high)}]


def findings(results: Results) -> list[dict[str, Any]]:
    """Of every agent that chooses among several members, and of options on ladders, what the comparisons say."""
    success = results.of(quantity="success", sub_goal="")
    trained, played = per_run(success, "success"), success[success["scope"] == FROZEN]
    if played.empty:
        played = success[success["scope"] == OTHER_LAYOUTS]
    random = trained[trained["method"].isin([*chosen_by(results, "random")])]
    learned = chosen_by(results, "learned")
    task_of = results.facts.get("task_of", {})
    result = []
    for name, agent in learned.items():
        if agent["members"] == 1:
            continue
        training, frozen = _of(name, trained), _of(name, played)
        of_choosing = finding(CHOOSING, frozen, _of(UNIFORM, played), ["artefact", "layout"])
        of_choosing = [each | among_members(name, results) for each in of_choosing]
        # random choice while learning has other options
        of_choosing = of_choosing or finding(CHOOSING, training, random, ["layout", "seed"])
        result += [each | how_soon(name, results) for each in of_choosing]
        for other, single in learned.items():
            if single["members"] != 1 or task_of.get(name) != task_of.get(other):
                continue
            both = frozen, _of(other, played)
            if min(map(len, both)) == 0:
                both = training, _of(other, trained)
            result += finding(HYPOTHESES, *both, ["layout", "seed"])
    return [*result, *_of_ladders(results)]


def among_members(agent: str, results: Results) -> dict[str, float]:
    """How often an agent takes the better of two members of a sub-goal, and uniform-random choice; NaN if unknown."""
    taken = per_run(results.of(quantity="pair"), "pair", scope=FROZEN)
    agents, random = _of(agent, taken), _of(UNIFORM, taken)
    random = random[random["artefact"].isin(agents["artefact"])]
    return {"better": agents["value"].mean(), "better_at_random": random["value"].mean()}


def how_soon(agent: str, results: Results) -> dict[str, float]:
    """After how many episodes 95 % of the last ones were solved: the median of the runs that got there, their share.

    ``trained``: the median of how many a training had.
    """
    own = results.of(method=agent)
    soon, trained, every = (per_run(own, name)["value"] for name in ("episodes_to_95", "episodes", "success"))
    return {"episodes": soon.median(), "got_there": len(soon) / max(1, len(every)), "trained": trained.median()}


def _of(method, numbers):
    return numbers[numbers["method"] == method]


def _of_ladders(results):
    """How often options stop at the base: the one of the member that validation picks, else the first."""
    numbers = results.numbers[results.numbers["ladder"] != ""]
    picked = per_run(numbers, "reached_base", member=VALIDATED)
    first = per_run(numbers[numbers["member"] == 0], "reached_base")
    rows = pd.concat([picked, first]).drop_duplicates(["artefact", "sub_goal"])
    for method, own in rows.groupby("method", sort=False):
        if method != ONE and not str(method).startswith(ORACLE):
            yield from finding(OPTIONS, own, _of(ONE, rows), ["ladder", "seed", "N"])


def context(results):
    """For the template: findings, and what agents solved."""
    agents = results.facts["agents"]
    final = per_run(results.of(method=[*agents]), "success")
    return {
        "results": results,
        "margin": MARGIN,
        "enough": MEDIANS_FROM,
        "findings": findings(results),
        "undecided": results.facts.get("undecided", []),
        "agents": agents,
        "ladders": (results.numbers["ladder"] != "").any(),
        "solved": final.groupby("method", sort=False)["value"].mean().to_dict(),
    }
