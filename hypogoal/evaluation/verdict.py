"""The first thing on a page: what the task is, and whether hypotheses mattered there, by one rule.

Two comparisons say so. Did choosing matter? The agent is compared with uniform-random choice among its own options. Did
hypotheses matter? An agent with several members is compared with an agent that has a single classifier. On ladders, the
second comparison is of the options that validation picks.
"""

import math
from typing import Any

import pandas as pd

from hypogoal.domains.find import installed_domain
from hypogoal.evaluation.choosing import FROZEN
from hypogoal.evaluation.curves import chosen_by
from hypogoal.evaluation.hypotheses import VALIDATED
from hypogoal.evaluation.names import ONE, ORACLE, UNIFORM
from hypogoal.evaluation.run import Results
from hypogoal.evaluation.statistics import MEDIANS_FROM, compare, paired
from hypogoal.evaluation.table import per_run
from hypogoal.evaluation.zero_shot import SCOPE as OTHER_LAYOUTS

MARGIN = 0.1  # a smaller difference between two shares of solved episodes counts as no difference
BETTER, WORSE, ALIKE, UNDECIDED = "better", "worse", "alike", "undecided"
CHOOSING, HYPOTHESES, OPTIONS = "choosing", "hypotheses", "options"  # what a finding is about


def facts(work):
    """Return the tasks of a run in their domains' words, the task of each agent, and the cap of episodes.

    The cap is in multiples of the shortest path.
    """
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
    """Return what the interval of a difference of shares says.

    If there are too few units for an interval, it is the range of their differences. An interval within ``MARGIN`` of 0
    is no difference, an interval above or below 0 is a difference, and any other is undecided.
    """
    if max(abs(low), abs(high)) < MARGIN:
        return ALIKE
    if low > 0:
        return BETTER
    return WORSE if high < 0 else UNDECIDED


def finding(subject: str, first: pd.DataFrame, second: pd.DataFrame, on: list[str]) -> list[dict[str, Any]]:
    """Return a comparison of two shares, over runs that agree in ``on``, or nothing if there are no pairs.

    Each layout or ladder counts once. If there is only one layout or ladder, each run counts once.
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
    """Return what the comparisons say of every agent that chooses among several members, and of options on ladders."""
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
        # last, because random choice while learning has other options
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
    """Return how often an agent, and uniform-random choice, takes the better of two members of a sub-goal.

    The values are NaN if this is unknown.
    """
    taken = per_run(results.of(quantity="pair"), "pair", scope=FROZEN)
    agents, random = _of(agent, taken), _of(UNIFORM, taken)
    random = random[random["artefact"].isin(agents["artefact"])]
    return {"better": agents["value"].mean(), "better_at_random": random["value"].mean()}


def how_soon(agent: str, results: Results) -> dict[str, float]:
    """Return after how many ``episodes`` 95 % of recent episodes were solved, and the share of runs that ``got_there``.

    ``episodes`` is the median of the runs that got there. ``trained`` is the median number of a run's training
    episodes.
    """
    own = results.of(method=agent)
    soon, trained, every = (per_run(own, name)["value"] for name in ("episodes_to_95", "episodes", "success"))
    return {"episodes": soon.median(), "got_there": len(soon) / max(1, len(every)), "trained": trained.median()}


def _of(method, numbers):
    return numbers[numbers["method"] == method]


def _of_ladders(results):
    """Yield findings on how often options stop at the base.

    The options are those of the member that validation picks or, if there is none, of the first member.
    """
    numbers = results.numbers[results.numbers["ladder"] != ""]
    picked = per_run(numbers, "reached_base", member=VALIDATED)
    first = per_run(numbers[numbers["member"] == 0], "reached_base")
    rows = pd.concat([picked, first]).drop_duplicates(["artefact", "sub_goal"])
    for method, own in rows.groupby("method", sort=False):
        if method != ONE and not str(method).startswith(ORACLE):
            yield from finding(OPTIONS, own, _of(ONE, rows), ["ladder", "seed", "N"])


def context(results):
    """Return what the template needs: findings, and what agents solved."""
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
