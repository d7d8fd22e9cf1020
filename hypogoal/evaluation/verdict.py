"""The first thing on a page: what the task is, and whether hypotheses mattered there, by one rule (Spec F7).

Two comparisons say so: the agent with uniform-random choice among its own options (did choosing matter?), and an agent
with several members with one that has a single classifier (did hypotheses matter?).
"""

import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass
from functools import partial
from operator import attrgetter
from typing import Any

import numpy as np

from hypogoal.core.artefacts import Artefact
from hypogoal.domains.base import installed_domain
from hypogoal.evaluation.choosing import FROZEN, UNIFORM, UNIFORM_CHOICE
from hypogoal.evaluation.curves import LEARNED, RANDOM, Run, base_name, titled
from hypogoal.evaluation.judging import Work
from hypogoal.evaluation.numbers import (
    DIGITS,
    ONE,
    ORACLE,
    Metrics,
    by_unit,
    compare_pairs,
    ensemble_title,
    grouped,
    mean_of,
)
from hypogoal.evaluation.page import Block, Material, Question, listed, percent, picture, section
from hypogoal.evaluation.table import Row, select
from hypogoal.evaluation.zero_shot import SCOPE as NEW_LAYOUTS

MARGIN = 0.1  # a smaller difference between two shares of solved episodes is none
LEAST = 3  # units; two that agree by accident would have an interval without width
BETTER, WORSE, ALIKE, UNDECIDED = "better", "worse", "alike", "undecided"
CHOOSING, HYPOTHESES, OPTIONS = "choosing", "hypotheses", "options"  # what a finding is about
ASKED = (
    "Each sub-goal is known from one context, and each member of an ensemble is a hypothesis about it that becomes an "
    "option. Does a policy over all these options solve layouts that no data came from, and does it choose the "
    "hypotheses that hold there?"
)


@dataclass(frozen=True)
class Finding:
    """Two shares of solved episodes, compared run by run; each layout counts once, or each run of a single layout."""

    subject: str
    first: str  # of the agent, or of the method
    second: str  # what it is compared with
    success: float  # of the first, mean over units
    other: float  # of the second
    difference: float  # first - second
    interval: tuple[float, float]  # Student's 95 % of the difference, cut at -1 and 1; NaN for one unit
    units: int
    unit: str  # layout, seed or ladder
    outcome: str


def outcome_of(difference: float, low: float, high: float) -> str:
    """What a difference of shares says; of one unit, whose bounds are NaN, the difference alone.

    An interval within ``MARGIN`` of 0 is no difference, one above or below 0 is a difference, any other undecided.
    """
    if math.isnan(low):
        low = high = difference
        return ALIKE if abs(difference) < MARGIN else BETTER if difference > 0 else WORSE
    if max(abs(low), abs(high)) < MARGIN:
        return ALIKE
    return BETTER if low > 0 else WORSE if high < 0 else UNDECIDED


def compare(
    subject: str, first: str, second: str, pairs: Sequence[tuple[Row, Row]], unit: str = "layout"
) -> Finding | None:
    """The finding of pairs of rows, each a run's share of solved episodes; None without pairs."""
    if not pairs:
        return None
    places = [row.ladder or row.layout for row, _ in pairs]
    several = len(set(places)) > 1
    units = places if several else [row.seed for row, _ in pairs]
    shares = np.array([[row.value for row in pair] for pair in pairs], np.float64)
    result = compare_pairs(shares[:, 0], shares[:, 1], units)
    low, high = (float(np.clip(bound, -1, 1)) for bound in result["difference_interval"])
    first_mean, second_mean = (mean_of(by_unit(shares[:, column], units)) for column in (0, 1))
    count, difference = result["units"], result["difference"]
    kind, outcome = unit if several or count == 1 else "seed", outcome_of(difference, low, high)
    return Finding(subject, first, second, first_mean, second_mean, difference, (low, high), count, kind, outcome)


def paired(rows: Iterable[Row], others: Iterable[Row], *fields: str) -> list[tuple[Row, Row]]:
    """Rows of the first with those of the second that agree in ``fields``."""
    place = attrgetter(*fields)
    by_place = {place(row): row for row in others}
    return [(row, by_place[place(row)]) for row in rows if place(row) in by_place]


def findings(work: Work) -> Iterator[Finding]:
    """Of every agent that chooses among several members: choosing, and hypotheses against one classifier."""
    kinds = {name: base_name(runs[0].kind, runs[0].config) for name, runs in work.agents.items()}
    agents = {name: runs for name, runs in work.agents.items() if kinds[name] == LEARNED}
    several = [name for name, runs in agents.items() if runs[0].config["members"] > 1]
    single = [name for name, runs in agents.items() if runs[0].config["members"] == 1]
    played_on = partial(select, work.rows, quantity="success", sub_goal="")
    frozen = played_on(scope=FROZEN) or played_on(scope=NEW_LAYOUTS)
    trained = played_on(scope="", step="", member="")  # each run's last episodes of training
    uniform = select(frozen, method=UNIFORM)
    learning = [row for name, kind in kinds.items() if kind == RANDOM for row in select(trained, method=name)]
    for name in several:
        played, title = select(frozen, method=name), ensemble_title(agents[name][0].config["ensemble"])
        if pairs := paired(played, uniform, "artefact", "layout"):
            second = UNIFORM_CHOICE
        else:
            second = "an agent whose choice is uniform-random"  # it has learned other options
            pairs = paired(select(trained, method=name), learning, "layout", "seed")
        yield from filter(None, [compare(CHOOSING, title, second, pairs)])
        for other in single:
            rows = frozen if played and select(frozen, method=other) else trained
            pairs = paired(select(rows, method=name), select(rows, method=other), "layout", "seed")
            yield from filter(None, [compare(HYPOTHESES, title, ONE, pairs)])


def on_ladders(work: Work) -> Iterator[Finding]:
    """Of options on ladders: how often the member that validation picks stops at the base, against one classifier."""
    rows = []
    for entry in work.metrics["distance"]["options"]:
        place = {"seed": entry["seed"], "ladder": entry["ladder"], "N": entry["groups"]}
        rows.append(Row("reached_base", _stopping(entry), entry["method"], **place))
    for method in dict.fromkeys(row.method for row in rows if row.N is not None):
        if method != "single CNN":
            pairs = paired(select(rows, method=method), select(rows, method="single CNN"), "ladder", "seed", "N")
            yield from filter(None, [compare(OPTIONS, ensemble_title(method), ONE, pairs, "ladder")])


def _stopping(entry: Mapping[str, Any]) -> float:
    """The share of executions that stop at the base, of the option that validation picks."""
    share: float = entry["options"][entry["validated"] or 0]["reached_base"]
    return share


def tasks(work: Work) -> list[str]:
    """What every agent of the run has to do, and how long it may take."""
    sentences = []
    for runs in work.agents.values():
        config = work.artefact(runs[0].path).config
        sentences.append(" ".join(filter(None, [task_of(config), cap_of(config, runs)])))
    sentences += [task_of(artefact.config) for artefact in work.contents.ladders] if not sentences else []
    longest = [text for text in sentences if not any(other != text and other.startswith(text) for other in sentences)]
    return list(dict.fromkeys(filter(None, longest)))


def scenes(work: Work) -> list[dict[str, Any]]:
    """The domain's scenes of the first agent's task, their pictures put into the arrays as ``scenes/<i>``."""
    first: Mapping[str, Any] = next((work.artefact(runs[0].path).config for runs in work.agents.values()), {})
    domain = installed_domain(first["domain"]) if first.get("domain") else None
    shown = domain.scenes(domain.world(first.get("domain_config") or {})) if domain else ()
    for index, scene in enumerate(shown):
        work.arrays[f"scenes/{index}"] = scene.picture
    return [{"title": scene.title, "features": dict(scene.features)} for scene in shown]


def task_of(config: Mapping[str, Any]) -> str:
    """The domain's own words; nothing where it is not installed."""
    domain = installed_domain(config["domain"]) if config.get("domain") else None
    return domain.task(domain.world(config.get("domain_config") or {})) if domain else ""


def cap_of(config: Mapping[str, Any], runs: Sequence[Run]) -> str:
    """After how many steps an episode is cut; nothing where each has a single step."""
    if all((run.episodes.length <= 1).all() for run in runs):
        return ""
    shortest = [run.layout.get("shortest_path") for run in runs]
    if config.get("cap") and all(shortest):
        caps = sorted({math.ceil(round(config["cap"] * steps, DIGITS)) for steps in shortest})
        count = str(caps[0]) if len(caps) == 1 else f"{caps[0]} to {caps[-1]}"
        return f"An episode is cut after {count} steps, {config['cap']:g} times the shortest path."
    return f"An episode is cut after {config['max_episode_steps']} steps." if config.get("max_episode_steps") else ""


def as_in_paper(artefacts: Iterable[Artefact]) -> bool:
    """Whether the task is one of the paper's: one DoorKey layout with harmless keys and no cap, or ladders."""
    configs = [artefact.config for artefact in artefacts]
    return bool(configs) and all(
        config.get("domain") == "montezuma"
        or (
            config.get("domain") == "doorkey"
            and not config.get("cap")
            and not config.get("layouts")
            and (config.get("domain_config") or {}).get("wrong_key", "harmless") == "harmless"
        )
        for config in configs
    )


def view(work: Work) -> dict[str, Any]:
    """``verdict``: the task with its scenes, whether it is the paper's, and the findings."""
    artefacts = [*work.contents.agents, *work.contents.ladders]
    compared = [asdict(finding) for finding in (*findings(work), *on_ladders(work))]
    task = {"task": tasks(work), "scenes": scenes(work), "paper": as_in_paper(artefacts)}
    return {"verdict": {**task, "findings": compared}}


def sections(material: Material) -> list[Block]:
    """The scenes, where the domain has any."""
    cards = [
        {
            "png": picture(material.arrays[f"scenes/{index}"]),
            "alt": scene["title"],
            "title": scene["title"],
            "lines": [
                {"class": "positive" if holds else "negative", "text": f"{name}: {'yes' if holds else 'no'}"}
                for name, holds in scene["features"].items()
            ],
        }
        for index, scene in enumerate(material.metrics.get("verdict", {}).get("scenes", []))
    ]
    return [section("scenes", "The task in pictures", [], [{"kind": "cards", "cards": cards}])] if cards else []


QUESTION = Question(view=view, sections=sections)

CAUSES = {CHOOSING: "choosing", HYPOTHESES: "several hypotheses", OPTIONS: "several hypotheses"}
OUTCOMES = {
    BETTER: "{} mattered",
    WORSE: "{} made it worse",
    ALIKE: "{} made no difference",
    UNDECIDED: "whether {} mattered is undecided",
}
SECONDS = {
    CHOOSING: "{first} solves {a} of the episodes, {second} {b}",
    HYPOTHESES: "with {first} the agent solves {a} of the episodes, with {second} {b}",
    OPTIONS: "options of {first} stop at the sub-goal in {a} of the executions, those of {second} in {b}",
}


def sentence(finding: Mapping[str, Any], *, alone: bool = True) -> str:
    """A finding for people; ``alone``: no other agent of the run chooses among several members."""
    units, unit = finding["units"], finding["unit"]
    place = f"on this {unit}" if units == 1 else f"over {units} {unit}s"
    first = "the agent" if finding["subject"] == CHOOSING and alone else finding["first"]
    shares = {"a": percent(finding["success"]), "b": percent(finding["other"])}
    text = SECONDS[finding["subject"]].format(first=first, second=finding["second"], **shares)
    low, high = finding["interval"]
    points = "" if low is None else f" ({100 * finding['difference']:+.0f} points [{100 * low:.0f}, {100 * high:.0f}])"
    outcome = OUTCOMES[finding["outcome"]].format(CAUSES[finding["subject"]])
    return f"{outcome[0].upper()}{outcome[1:]} {place}: {text}{points}."


def verdict(metrics: Metrics) -> list[str]:
    """Sentences: what the comparisons say, and how much evidence it is; without any, what is missing for one."""
    comparisons = metrics.get("verdict", {}).get("findings", [])
    alone = sum(finding["subject"] == CHOOSING for finding in comparisons) < 2
    lines = [sentence(finding, alone=alone) for finding in comparisons]
    if comparisons and (most := max(finding["units"] for finding in comparisons)) < LEAST:
        count = "One run is" if most == 1 else "Two runs are"
        lines.append(f"{count} not evidence: train more layouts or seeds.")
    if metrics["agents"] and all(agent["success"]["mean"] is None for agent in metrics["agents"]):
        return ["No episode of an agent has ended yet: train with more steps."]
    if not comparisons and metrics["agents"]:
        agent = next(agent for agent in metrics["agents"] if agent["success"]["mean"] is not None)
        share, name = percent(agent["success"]["mean"]), titled(agent["name"])
        lines.append(f"{name[:1].upper()}{name[1:]}: {share} of the last training episodes solved.")
        lines.append(
            "Whether hypotheses mattered is unknown: the run has neither uniform-random choice nor an agent with one "
            "classifier to compare with."
        )
    if not comparisons and not metrics["agents"]:
        options = list(_of_options(metrics))
        lines += options or ["No agent has been trained yet, so no reward has shown which hypotheses transfer."]
        lines += [] if options else list(_of_members(metrics))
    return lines


def _of_options(metrics: Metrics) -> Iterator[str]:
    """How often options on ladders stop at the base, of each method."""
    of_method = grouped(metrics["distance"]["options"], lambda entry: str(entry["method"]))
    for name, entries in of_method.items():
        options = "Options that end at true sub-goals" if name == ORACLE else f"Options of {ensemble_title(name)}"
        share = mean_of([_stopping(entry) for entry in entries])
        yield f"{options} stop at the sub-goal in {percent(share)} of their executions."
    if of_method:
        yield "Whether hypotheses mattered is unknown: the run has no options of one classifier to compare with."


def _of_members(metrics: Metrics) -> Iterator[str]:
    """How far members differ on held-out states, mean over sub-goals, of each method."""
    for name, entries in grouped(metrics["hypotheses"], lambda entry: str(entry["name"])).items():
        best, middle, worst = (
            mean_of([entry[which]["mean"] for entry in entries if entry[which]["mean"] is not None])
            for which in ("best", "mean", "worst")
        )
        yield (
            f"{ensemble_title(name)}: balanced accuracy on held-out states {best:.2f} for the best member, "
            f"{middle:.2f} on average, {worst:.2f} for the worst."
        )


def baselines(metrics: Metrics) -> str:
    """What agents on primitive actions reach, and with how many steps; nothing without one."""
    parts = []
    for agent in metrics["agents"]:
        if agent["kind"] == "baseline" and agent["success"]["mean"] is not None:
            steps = max(run["steps"] for run in agent["runs"])
            parts.append(f"{agent['name']} {percent(agent['success']['mean'])} (after {steps:,} steps)")
    return f"On primitive actions, with the same cap: {listed(parts)}." if parts else ""
