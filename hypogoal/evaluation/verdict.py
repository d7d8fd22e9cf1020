"""The first thing on a page: what the task is, and whether hypotheses mattered there, by one rule (Spec F7, I1).

Two comparisons say so: the agent with uniform-random choice among its own options (did choosing matter?), and an agent
with several members with one that has a single classifier (did hypotheses matter?). On ladders the second is of the
options that validation picks.
"""

import math
from collections.abc import Iterator, Mapping
from typing import Any

import numpy as np
import pandas as pd

from hypogoal.domains.base import installed_domain
from hypogoal.evaluation.choosing import FROZEN
from hypogoal.evaluation.curves import is_learned
from hypogoal.evaluation.house import DIGITS, compare, per_run
from hypogoal.evaluation.judging import Work
from hypogoal.evaluation.names import ONE, ORACLE, RANDOM, UNIFORM
from hypogoal.evaluation.page import Results
from hypogoal.evaluation.rooms import VALIDATED
from hypogoal.evaluation.run import read_layout
from hypogoal.evaluation.zero_shot import SCOPE as OTHER_LAYOUTS
from hypogoal.options.tables import Episodes

MARGIN = 0.1  # a smaller difference between two shares of solved episodes is none
LEAST = 3  # units; two that agree by accident would have an interval without width
BETTER, WORSE, ALIKE, UNDECIDED = "better", "worse", "alike", "undecided"
CHOOSING, HYPOTHESES, OPTIONS = "choosing", "hypotheses", "options"  # what a finding is about


def facts(work: Work) -> dict[str, Any]:
    """The task, and whether it is the paper's."""
    first: Mapping[str, Any] = next((artefact.config for artefact in work.contents.agents), {})
    cap = {"caps": caps(work), "cap": first.get("cap")}
    return {"tasks": tasks(work), "is_papers": as_in_paper(work), **cap}


def tasks(work: Work) -> list[str]:
    """What every agent of the run has to do, in the domain's own words; nothing of domains that are not installed."""
    texts = []
    for artefact in work.contents.agents or work.contents.ladders:
        config = artefact.config
        domain = installed_domain(config["domain"]) if config.get("domain") else None
        if domain is not None:
            texts.append(domain.task(domain.world(config.get("domain_config") or {})))
    return [text for text in dict.fromkeys(texts) if text]


def caps(work: Work) -> list[int]:
    """After how many steps episodes are cut; nothing where each has a single step."""
    steps = set()
    for artefact in work.contents.agents:
        config = artefact.config
        if (Episodes.read(artefact.path / "episodes.csv").length <= 1).all():
            continue
        shortest = read_layout(artefact.path / "layout.json")["shortest_path"]
        if config.get("cap") and shortest:
            steps.add(math.ceil(round(config["cap"] * shortest, DIGITS)))
        elif config.get("max_episode_steps"):
            steps.add(config["max_episode_steps"])
    return sorted(steps)


def as_in_paper(work: Work) -> bool:
    """Whether the task is one of the paper's: one DoorKey layout with harmless keys and no cap, or ladders."""
    configs = [artefact.config for artefact in (*work.contents.agents, *work.contents.ladders)]
    return bool(configs) and all(_is_papers(config) for config in configs)


def _is_papers(config: Mapping[str, Any]) -> bool:
    if config.get("domain") != "doorkey":
        return config.get("domain") == "montezuma"
    harmless = (config.get("domain_config") or {}).get("wrong_key", "harmless") == "harmless"
    return harmless and not config.get("cap") and not config.get("layouts")


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
    subject: str, first: pd.DataFrame, second: pd.DataFrame, against: str, on: list[str]
) -> dict[str, Any] | None:
    """Two shares of solved episodes, of runs that agree in ``on``; each layout counts once, or each run of one layout.

    None without pairs.
    """
    both = first.merge(second.drop_duplicates(on), on=on, suffixes=("", "_second"))
    if both.empty:
        return None
    place = "ladder" if subject == OPTIONS else "layout"
    several = both[place].nunique() > 1
    unit = both[place] if several else both["seed"]
    result = compare(both["value"], both["value_second"], unit)
    low, high = np.clip([result["difference_low"], result["difference_high"]], -1, 1).tolist()
    by_unit = both.groupby(unit.to_numpy(), sort=False)[["value", "value_second"]].mean().mean()
    return {
        "subject": subject,
        "first": first["method"].iloc[0],
        "second": against,
        "share": by_unit["value"],
        "other": by_unit["value_second"],
        "difference": result["difference"],
        "low": low,
        "high": high,
        "units": result["units"],
        "unit": place if several or result["units"] == 1 else "seed",
        "outcome": outcome_of(result["difference"], low, high),
    }


def tables(results: Results) -> dict[str, pd.DataFrame]:
    """Of each agent, or method on ladders, what the comparisons say."""
    return {"verdict": pd.DataFrame(findings(results))}


def findings(results: Results) -> list[dict[str, Any]]:
    """Of every agent that chooses among several members, and of options on ladders, what the comparisons say."""
    agents = {name: agent for name, agent in results.facts["agents"].items() if is_learned(agent)}
    several = [name for name, agent in agents.items() if agent["members"] > 1]
    single = [name for name, agent in agents.items() if agent["members"] == 1]
    success = results.of(quantity="success", sub_goal="")
    frozen = success[success["scope"] == FROZEN]
    if frozen.empty:
        frozen = success[success["scope"] == OTHER_LAYOUTS]
    trained = success[(success["scope"] == "") & success["step"].isna()]
    compared = []
    for name in several:
        compared.append(_of_choosing(results, name, frozen, trained))
        played = frozen[frozen["method"] == name]
        for other in single:
            rows = frozen if len(played) and (frozen["method"] == other).any() else trained
            ours, theirs = rows[rows["method"] == name], rows[rows["method"] == other]
            compared.append(finding(HYPOTHESES, ours, theirs, ONE, ["layout", "seed"]))
    compared += _of_ladders(results)
    return [each for each in compared if each is not None]


def _of_choosing(results: Results, name: str, frozen: pd.DataFrame, trained: pd.DataFrame) -> dict[str, Any] | None:
    played = frozen[frozen["method"] == name]
    uniform = frozen[frozen["method"] == UNIFORM]
    compared = finding(CHOOSING, played, uniform, UNIFORM, ["artefact", "layout"])
    if compared is not None:
        return compared
    agents = results.facts["agents"]
    random = [other for other, agent in agents.items() if agent["kind"] == "meta" and agent["chooser"] == "random"]
    learning = trained[trained["method"].isin(random) & trained["method"].str.startswith(RANDOM)]
    # it has learned other options
    return finding(CHOOSING, trained[trained["method"] == name], learning, RANDOM, ["layout", "seed"])


def stopping(results: Results) -> pd.DataFrame:
    """The share of executions on ladders that stop at the base, of the option that validation picks, else the first."""
    numbers = results.numbers[results.numbers["ladder"] != ""]
    picked = per_run(numbers, "reached_base", member=VALIDATED)
    first = numbers[numbers["member"] == 0]
    others = per_run(first, "reached_base")
    keys = ["artefact", "sub_goal"]
    unpicked = others.merge(picked[keys], on=keys, how="left", indicator=True)
    return pd.concat([picked, unpicked[unpicked["_merge"] == "left_only"]])


def _of_ladders(results: Results) -> Iterator[dict[str, Any] | None]:
    if not results.facts["ladders"]:
        return
    rows = stopping(results)
    single = rows[rows["method"] == ONE]
    for method in rows["method"].unique():
        if method != ONE and not method.startswith(ORACLE):
            yield finding(OPTIONS, rows[rows["method"] == method], single, ONE, ["ladder", "seed", "N"])


def context(results: Results) -> dict[str, Any]:
    """For the template: task, findings, and what there is to say where nothing can be compared."""
    compared = findings(results)
    agents = results.facts["agents"]
    final = per_run(results.numbers, "success")
    solved = final[final["method"].isin([*agents])].groupby("method", sort=False)["value"].mean()
    steps = results.of(quantity="steps").groupby("method", sort=False)["value"].max()
    baselines = [
        {"name": name, "success": solved[name], "steps": steps[name]}
        for name, agent in agents.items()
        if agent["kind"] == "baseline" and name in solved
    ]
    return {
        "tasks": results.facts["tasks"],
        "caps": results.facts["caps"],
        "cap": results.facts["cap"],
        "findings": compared,
        "alone": sum(each["subject"] == CHOOSING for each in compared) < 2,
        "units": max((each["units"] for each in compared), default=0),
        "least": LEAST,
        "agents": agents,
        "solved": solved.to_dict(),
        "baselines": baselines,
        "options": _options_alone(results) if not compared else {},
        "members": _members_alone(results) if not compared and not agents else [],
    }


def _options_alone(results: Results) -> dict[str, float]:
    """How often options on ladders stop at the base, of each method."""
    if not results.facts["ladders"]:
        return {}
    shares = stopping(results).groupby("method", sort=False)["value"].mean()
    return dict(zip(shares.index, shares, strict=True))


def _members_alone(results: Results) -> list[dict[str, Any]]:
    """How far members differ on held-out states, mean over sub-goals, of each method."""
    rows = []
    for which in ("best", "mean", "worst"):
        rows.append(per_run(results.numbers, "balanced_accuracy", "heldout", which, which))
    accuracies = pd.concat(rows)
    wide = accuracies.pivot_table(index="method", columns="quantity", values="value", sort=False)
    return [dict(row) for _, row in wide.reset_index().iterrows()]
