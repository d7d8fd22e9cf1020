"""What choosing is worth: how good options are, whether the better one is taken, and what random choice does (Spec H2).

An option is good where its execution brings about the true sub-goal; how well its classifier matches the truth on all
states says little of that. Choice is judged among the members of the sub-goal that was chosen, since which sub-goal is
due is another matter. The control has the agent's own final options and picks one of those offered at random.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import replace
from itertools import combinations
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray
from rich.table import Table as Printed
from scipy.stats import rankdata

from hypogoal.core.artefacts import Artefact
from hypogoal.core.seeding import rng_for
from hypogoal.domains.base import load_domain
from hypogoal.evaluation import page
from hypogoal.evaluation.curves import LEARNED, NEARLY, titled
from hypogoal.evaluation.judging import Work
from hypogoal.evaluation.numbers import DIGITS, Metrics, above, at_least, mean_of
from hypogoal.evaluation.page import Block, Material, Question
from hypogoal.evaluation.run import takes
from hypogoal.evaluation.table import Number, Row, Table, by_run, rows_of, select, tabulate

if TYPE_CHECKING:
    from hypogoal.evaluation.frozen import Choices
    from hypogoal.options.loop import OptionLoop

LEAST = 20.0  # expected choices of a member, below which its preference is not told
DIFFERENCE = 0.2  # between members' qualities, below which there is nothing to choose
MEMORYLESS = ("light", "planned")  # option policies that can be asked in any state
OF_PLAY = ("success", "near", "length")
OF_CHOICE = ("within_rho", "pair", "score")
TITLE = "What choosing is worth"


def qualities(loop: OptionLoop, goals: NDArray[np.int64], states: NDArray[np.int64]) -> NDArray[np.float64]:
    """How often each option's greedy execution brings about its true sub-goal, the episode not lost: float64 (O,).

    Of policies that remember nothing, in an engine that knows what follows. ``goals`` (O,) are columns of the engine's
    labels. Executions begin in ``states`` (D,), each as often as it is there: where the option is offered, its
    sub-goal does not hold, and can be had within the timeout; NaN for an option that begins nowhere.
    """
    from hypogoal.options.planned import distances, places_of

    plan = loop.engine.plan()
    assert plan is not None
    place = places_of(plan, loop.engine)
    truth = loop.engine.labels(plan.ids)
    away = distances(truth, place[plan.following], plan.final)
    column = np.full(loop.engine.n_actions, -1, dtype=np.int64)
    column[plan.actions] = np.arange(len(plan.actions))
    lost = plan.final & ~plan.solved
    distinct, counts = np.unique(states, return_counts=True)
    offered = ~loop.terminations.of(distinct)
    qualities = np.full(len(goals), np.nan)
    for option, goal in enumerate(goals.tolist()):
        steps = away[place[distinct], goal]
        begins = offered[:, option] & (steps > 0) & (steps <= loop.config.option_timeout)
        if not begins.any():
            continue
        ids, going = distinct[begins], np.arange(begins.sum())
        for age in range(loop.config.option_timeout):
            options = np.full(len(going), option)
            actions = loop.learner.act(ids[going], options, np.full(len(going), age), explore=False)
            ids[going] = plan.following[place[ids[going]], column[actions]]
            over = loop.terminations.of_running(ids[going], options) | plan.final[place[ids[going]]]
            going = going[~over]
            if not len(going):
                break
        rows = place[ids]
        qualities[option] = np.average(truth[rows, goal] & ~lost[rows], weights=counts[begins])
    return qualities


def rank_correlation(first: NDArray[np.float64], second: NDArray[np.float64]) -> float:
    """Spearman's rank correlation of (n,) and (n,), ties sharing their mean rank; NaN where a side is constant."""
    ranked, other = (ranks - ranks.mean() for ranks in (rankdata(first), rankdata(second)))
    spread = np.sqrt((ranked**2).sum() * (other**2).sum())
    return float((ranked * other).sum() / spread) if spread > 0 else math.nan


def judge(choices: Choices, quality: NDArray[np.float64], members: int) -> dict[str, Any]:
    """Whether the better of K members are taken, where at least two of the chosen sub-goal's were offered.

    ``quality`` (G*K,) is of :func:`qualities`; NaN where it is not known. Returns ``preference`` (G*K,): chosen /
    expected among the members of the chosen sub-goal, NaN below ``LEAST`` expected; ``within_rho``: Spearman's rho of
    the two, mean over sub-goals whose members' qualities differ by ``DIFFERENCE``; ``pair``: of two members offered
    whose qualities differ by that, how often the better of those taken (.5 at random); ``score``: (quality taken - mean
    quality) / (best - mean), over decisions (0 at random).
    """
    options = np.arange(len(quality))
    of_goal = choices.offered & (options // members == (choices.options // members)[:, None])
    several = of_goal.sum(axis=1) > 1
    taken, among = choices.options[several], of_goal[several]
    expected = (among / among.sum(axis=1, keepdims=True)).sum(axis=0).round(DIGITS)  # in any order of decisions
    chosen = np.bincount(taken, minlength=len(quality))
    preference = np.where(at_least(expected, LEAST), chosen / np.maximum(expected, 1e-12), np.nan)
    rhos, better, worse = [], 0, 0
    for alike in options.reshape(-1, members):  # of one sub-goal
        comparable = alike[~np.isnan(quality[alike]) & ~np.isnan(preference[alike])]
        if len(comparable) > 1 and at_least(np.ptp(quality[comparable]), DIFFERENCE):
            rhos.append(rank_correlation(quality[comparable], preference[comparable]))
        for option, other in combinations(alike.tolist(), 2):
            if at_least(abs(quality[option] - quality[other]), DIFFERENCE):
                good, bad = (option, other) if quality[option] > quality[other] else (other, option)
                both = among[:, option] & among[:, other]
                better, worse = better + int((taken[both] == good).sum()), worse + int((taken[both] == bad).sum())
    values = np.where(among & ~np.isnan(quality), quality, np.nan)
    rows = (~np.isnan(values)).sum(axis=1) > 1
    rows[rows] = ~np.isnan(quality[taken[rows]])
    values, got = values[rows], quality[taken[rows]]
    mean, best = (np.nanmean(values, axis=1), np.nanmax(values, axis=1)) if rows.any() else (got, got)
    gain = float((best - mean).sum())
    return {
        "preference": preference,
        "within_rho": mean_of([rho for rho in rhos if not math.isnan(rho)]),
        "pair": better / (better + worse) if better + worse else math.nan,
        "score": float((got - mean).sum()) / gain if above(gain, 0.0) else math.nan,
    }


def rows(work: Work) -> Iterator[Row]:
    """Every run of an agent that learned to choose among members' options, in a domain that knows what follows.

    The agent's numbers, those of uniform-random choice, and every member's.
    """
    for name, run in ((name, run) for name, runs in work.agents.items() for run in runs):
        artefact = work.artefact(run.path)
        config = artefact.config
        learned = artefact.kind == "meta" and takes(artefact) and config["chooser"] != "random"
        playable = config.get("network") in MEMORYLESS and "options.safetensors" in artefact.manifest.files
        # Of many layouts the states are too many to say what follows in each.
        if not learned or not playable or config.get("layouts") or (played := play_agent(artefact, run.seed)) is None:
            continue
        place = {"scope": FROZEN, "layout": run.layout["layout_seed"], "seed": run.seed, "artefact": run.path}
        for method, numbers in ((name, played), (UNIFORM, played["uniform"])):
            yield from rows_of({key: numbers[key] for key in (*OF_PLAY, *OF_CHOICE)}, method=method, **place)
        for member in played["members"]:
            where = {"sub_goal": member.pop("sub_goal"), "member": member.pop("member")}
            yield from rows_of(member, method=name, **where, **place)


def view(work: Work) -> dict[str, Any]:
    """Over runs each agent, and ``uniform``: uniform-random choice among its own options."""
    rows = select(work.rows, scope=FROZEN)
    agents = [row for row in rows if row.method != UNIFORM]
    by_agent = replace(TABLE, by={"name": lambda row: work.agent_of[row.artefact]}, cell=lambda key: (*key, "uniform"))
    uniform = {entry["name"]: entry for entry in tabulate(select(rows, method=UNIFORM), by_agent)}
    table = tabulate(agents, TABLE)
    for entry in table:
        entry["uniform"] = uniform[entry["name"]]
        entry["runs"] = by_run(select(agents, method=entry["name"]))
    return {"choosing": table}


def play_agent(artefact: Artefact, seed: int) -> dict[str, Any] | None:
    """``OF_PLAY`` and ``OF_CHOICE`` of a trained agent played on, frozen; ``uniform``: those of uniform-random choice
    among its own options; ``members``: each one's quality and conditional preference.

    None where the engine does not know what each action leads to, or the sub-goals are not the domain's.
    """
    from hypogoal.evaluation.frozen import ENVIRONMENTS, play  # with PyTorch, which a report does not need
    from hypogoal.meta.episodes import agent_of
    from hypogoal.options.choosers import RandomChooser

    config, sub_goals = artefact.config, load_domain(artefact.config["domain"]).sub_goals
    if not set(config["sub_goals"]) <= set(sub_goals):
        return None
    if agent_of(artefact, seed).engine.plan() is None:  # one game, since many take long to begin
        return None
    loop = agent_of(artefact, seed, ENVIRONMENTS)
    members, shortest = config["members"], loop.engine.shortest_path()
    goals = np.repeat([sub_goals.index(goal) for goal in config["sub_goals"]], members)
    of_both = [play(loop, chooser) for chooser in (loop.chooser, RandomChooser(rng_for(seed, "uniform-choice")))]
    quality, numbers = qualities(loop, goals, of_both[0].choices.states), []  # where the agent itself decides
    for episodes in of_both:
        scores = episodes.scores(shortest) | {"length": episodes.length}
        played = {name: mean_of(scores[name].ravel()) for name in OF_PLAY}
        numbers.append(played | judge(episodes.choices, quality, members))
    preference = numbers[0].pop("preference")
    del numbers[1]["preference"]
    by_member = [
        {
            "sub_goal": config["sub_goals"][option // members],
            "member": option % members,
            "quality": float(quality[option]),
            "conditional_preference": float(preference[option]),
        }
        for option in range(len(quality))
    ]
    return {**numbers[0], "members": by_member, "uniform": numbers[1]}


UNITS = {"length": "steps", "within_rho": "Spearman's rho", "score": "ratio"}
FROZEN = "frozen"  # in numbers.csv: played after training
UNIFORM = "uniform among its own options"  # in numbers.csv
UNIFORM_CHOICE = "uniform-random choice among its own options"  # for people
TABLE = Table(
    {"name": "method"}, {name: Number(name, FROZEN, UNITS.get(name, "fraction")) for name in (*OF_PLAY, *OF_CHOICE)}
)
COLUMNS = (
    page.label("chooser", lambda entry: titled(entry["chooser"])),
    page.number("solved", "success", page.spread, 2),
    page.number(*NEARLY, page.spread, 2),
    page.number("steps", "length", page.spread, 1),
    page.number("preference follows quality (within-rho)", "within_rho", page.spread, 2),
    page.number("better of two taken", "pair", page.spread, 2),
    page.number("quality gained, of the most possible (score)", "score", page.spread, 2),
    page.number("runs", "success.n"),
)


def _choosers(agents: list[Any]) -> list[dict[str, Any]]:
    """Each agent, and below it uniform-random choice among its own options."""
    both = ((agent | {"chooser": agent["name"]}, agent["uniform"] | {"chooser": UNIFORM_CHOICE}) for agent in agents)
    return [chooser for pair in both for chooser in pair]


def summary(metrics: Metrics) -> list[Printed]:
    """For a terminal, where there is anything to choose."""
    agents = metrics["choosing"]
    return [page.terminal(TITLE, (*COLUMNS[:2], COLUMNS[-1]), _choosers(agents))] if agents else []


def sections(material: Material) -> list[Block]:
    """One table; each member's quality and preference are in ``numbers.csv``."""
    agents = material.metrics["choosing"]
    if not agents:
        return []
    text = (
        "The trained agent plays without learning: the first episodes of each of many environments, as many in each. "
        "For comparison, uniform-random choice plays with the agent's own final options. An "
        "option's quality is the share of its executions that reach the true sub-goal, begun where agents decide. "
        "Choice is judged among the members of the sub-goal that was chosen. Within-rho: the rank correlation of "
        "preference with quality (1: the better, the more often chosen; 0 at random). Better of two taken: how often, "
        "of two whose qualities differ by .2 (.5 at random). Score: how much of the way from the mean to the best "
        "quality the choices go (1: always the best; 0 at random)."
    )
    table = page.table(COLUMNS, _choosers(agents), main=lambda entry: entry["chooser"] == LEARNED)
    return [page.section("choosing", TITLE, [text], [table])]


QUESTION = Question(rows=rows, view=view, summary=summary, sections=sections)
