"""What choosing is worth: how good options are, whether the better one is taken, and what random choice does (Spec H2).

An option is good where its execution brings about the true sub-goal; how well its classifier matches the truth on all
states says little of that. Choice is judged among the members of the sub-goal that was chosen, since which sub-goal is
due is another matter. The control has the agent's own final options and picks one of those offered at random.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from itertools import combinations
from typing import TYPE_CHECKING, Any

import numpy as np
import pandas as pd
from numpy.typing import NDArray
from scipy.stats import spearmanr

from hypogoal.core.artefacts import Artefact
from hypogoal.core.seeding import rng_for
from hypogoal.domains.base import load_domain
from hypogoal.evaluation.curves import NEAR
from hypogoal.evaluation.house import DIGITS, above, at_least, mean_of, over, per_run, tidy
from hypogoal.evaluation.judging import Work
from hypogoal.evaluation.names import UNIFORM
from hypogoal.evaluation.page import Results, displayed, spread
from hypogoal.evaluation.run import takes

if TYPE_CHECKING:
    from hypogoal.evaluation.frozen import Choices
    from hypogoal.options.loop import OptionLoop

LEAST = 20.0  # expected choices of a member, below which its preference is not told
DIFFERENCE = 0.2  # between members' qualities, below which there is nothing to choose
MEMORYLESS = ("light", "planned")  # option policies that can be asked in any state
OF_PLAY = ("success", "near", "length")
OF_CHOICE = ("within_rho", "pair", "score")
FROZEN = "frozen"  # the scope of what is played after training
SEVERAL = 5  # runs from which on a rank correlation of a few members is shown
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
    return {
        "preference": preference,
        "within_rho": _within_rho(quality, preference, members),
        "pair": _better_of_two(quality, taken, among, members),
        "score": _score(quality, taken, among),
    }


def _within_rho(quality: NDArray[np.float64], preference: NDArray[np.float64], members: int) -> float:
    rhos = []
    for start in range(0, len(quality), members):  # of each sub-goal
        alike = slice(start, start + members)
        is_known = ~np.isnan(quality[alike]) & ~np.isnan(preference[alike])
        good, preferred = quality[alike][is_known], preference[alike][is_known]
        if len(good) > 1 and at_least(np.ptp(good), DIFFERENCE) and np.ptp(preferred) > 0:
            rhos.append(spearmanr(good, preferred).statistic)
    return mean_of(rhos)


def _better_of_two(
    quality: NDArray[np.float64], taken: NDArray[np.int64], among: NDArray[np.bool_], members: int
) -> float:
    better, worse = 0, 0
    for start in range(0, len(quality), members):
        for option, other in combinations(range(start, start + members), 2):
            if not at_least(abs(quality[option] - quality[other]), DIFFERENCE):
                continue
            good, bad = (option, other) if quality[option] > quality[other] else (other, option)
            both = among[:, option] & among[:, other]
            better += int((taken[both] == good).sum())
            worse += int((taken[both] == bad).sum())
    return better / (better + worse) if better + worse else math.nan


def _score(quality: NDArray[np.float64], taken: NDArray[np.int64], among: NDArray[np.bool_]) -> float:
    values = np.where(among & ~np.isnan(quality), quality, np.nan)
    is_compared = (~np.isnan(values)).sum(axis=1) > 1
    is_compared[is_compared] = ~np.isnan(quality[taken[is_compared]])
    if not is_compared.any():
        return math.nan
    average = np.nanmean(values[is_compared], axis=1)
    gain = float((np.nanmax(values[is_compared], axis=1) - average).sum())
    gained = float((quality[taken[is_compared]] - average).sum())
    return gained / gain if above(gain, 0.0) else math.nan


def rows(work: Work) -> Iterator[pd.DataFrame]:
    """Every run of an agent that learned to choose among members' options, in a domain that knows what follows.

    The agent's numbers, those of uniform-random choice, and every member's.
    """
    for artefact in work.contents.agents:
        played = play_agent(artefact) if _is_playable(artefact) else None
        if played is None:
            continue
        place = {**work.place(artefact), "scope": FROZEN}
        agent, uniform, members = played
        yield tidy(agent, **place)
        yield tidy(uniform, **{**place, "method": UNIFORM})
        for sub_goal, of_goal in members.groupby("sub_goal", sort=False):
            columns = of_goal[["member", "quality", "conditional_preference"]]
            yield columns.melt("member", var_name="quantity").assign(**place, sub_goal=sub_goal)


def _is_playable(artefact: Artefact) -> bool:
    config = artefact.config
    learned = artefact.kind == "meta" and takes(artefact) and config["chooser"] != "random"
    playable = config.get("network") in MEMORYLESS and "options.safetensors" in artefact.manifest.files
    # Of many layouts the states are too many to say what follows in each.
    return learned and playable and not config.get("layouts")


def play_agent(artefact: Artefact) -> tuple[dict[str, float], dict[str, float], pd.DataFrame] | None:
    """A trained agent played on, frozen, and uniform-random choice among its own options.

    Returns ``OF_PLAY`` and ``OF_CHOICE`` of both, and a row per member: sub_goal, member, quality and
    conditional_preference. None where the engine does not know what each action leads to, or the sub-goals are not the
    domain's.
    """
    from hypogoal.evaluation.frozen import ENVIRONMENTS, play  # with PyTorch, which a report does not need
    from hypogoal.meta.episodes import agent_of
    from hypogoal.options.choosers import RandomChooser

    config, seed = artefact.config, artefact.seed
    sub_goals = load_domain(config["domain"]).sub_goals
    if not set(config["sub_goals"]) <= set(sub_goals):
        return None
    if agent_of(artefact, seed).engine.plan() is None:  # one game, since many take long to begin
        return None
    loop = agent_of(artefact, seed, ENVIRONMENTS)
    members = config["members"]
    goals = np.repeat([sub_goals.index(goal) for goal in config["sub_goals"]], members)
    uniform = RandomChooser(rng_for(seed, "uniform-choice"))
    of_both = [play(loop, chooser) for chooser in (loop.chooser, uniform)]
    quality = qualities(loop, goals, of_both[0].choices.states)  # where the agent itself decides
    numbers = []
    for episodes in of_both:
        scores = episodes.scores(loop.engine.shortest_path()) | {"length": episodes.length}
        played = {name: mean_of(scores[name].ravel()) for name in OF_PLAY}
        numbers.append(played | judge(episodes.choices, quality, members))
    preference = numbers[0].pop("preference")
    del numbers[1]["preference"]
    of_members = pd.DataFrame(
        {
            "sub_goal": np.repeat(config["sub_goals"], members),
            "member": np.tile(np.arange(members), len(config["sub_goals"])),
            "quality": quality,
            "conditional_preference": preference,
        }
    )
    return numbers[0], numbers[1], of_members


def tables(results: Results) -> dict[str, pd.DataFrame]:
    """Over runs each agent (``chooser`` its own), and uniform-random choice among its own options."""
    numbers = results.of(scope=FROZEN, sub_goal="")
    agents = numbers[numbers["method"] != UNIFORM].drop_duplicates("artefact").set_index("artefact")["method"]
    runs = pd.concat([per_run(numbers, name, FROZEN) for name in (*OF_PLAY, *OF_CHOICE)])
    chooser = runs["method"].where(runs["method"] == UNIFORM, "the agent's")
    runs = runs.assign(chooser=chooser, method=runs["artefact"].map(agents))
    return {"choosing": over(runs, ["method", "chooser"])}


def context(results: Results) -> dict[str, Any] | None:
    """For the template: each agent, and below it uniform-random choice among its own options."""
    if results.of(scope=FROZEN).empty:
        return None
    table = tables(results)["choosing"]
    columns = {
        "solved": ("success", spread(2)),
        f"within {NEAR} shortest paths": ("near", spread(2)),
        "steps": ("length", spread(1)),
        "better of two taken": ("pair", spread(2)),
        "quality gained": ("score", spread(2)),
        "runs": ("success", lambda row: str(row["n"])),
    }
    if table["n"].max() >= SEVERAL:
        columns["within-rho"] = ("within_rho", spread(2))
    shown = displayed(table, {"method": "agent", "chooser": "choice"}, columns)
    return {"table": shown, "printed": shown[["solved", "runs"]], "has_rho": "within-rho" in shown}
