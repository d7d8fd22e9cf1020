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

from hypogoal.core.arrays import Bools, Doubles, Ints
from hypogoal.core.artefacts import Artefact
from hypogoal.core.seeding import rng_for
from hypogoal.domains.base import load_domain
from hypogoal.evaluation import house
from hypogoal.evaluation.judging import Work
from hypogoal.evaluation.names import UNIFORM
from hypogoal.evaluation.page import Results
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
TITLE = "What choosing is worth"
BY = ["method", "chooser"]


def qualities(loop: OptionLoop, goals: Ints, states: Ints) -> Doubles:
    """How often each option's greedy execution brings about its true sub-goal, the episode not lost: float64 (O,).

    Of policies that remember nothing, in an engine that knows what follows. ``goals`` (O,) are columns of the engine's
    labels. Executions begin in ``states`` (D,), each as often as it is there: where the option is offered, its
    sub-goal does not hold, and can be had within the timeout; NaN for an option that begins nowhere.
    """
    from hypogoal.options.planned import distances, places_of

    engine, timeout = loop.engine, loop.config.option_timeout
    plan = engine.plan()
    assert plan is not None
    place = places_of(plan, engine)
    truth = engine.labels(plan.ids)
    away = distances(truth, place[plan.following], plan.final)
    column = np.full(engine.n_actions, -1)
    column[plan.actions] = np.arange(len(plan.actions))
    good = truth & ~(plan.final & ~plan.solved)[:, None]
    distinct, counts = np.unique(states, return_counts=True)
    offered = ~loop.terminations.of(distinct)
    qualities = np.full(len(goals), np.nan)
    for option, goal in enumerate(goals):
        steps = away[place[distinct], goal]
        begins = offered[:, option] & (steps > 0) & (steps <= timeout)
        if not begins.any():
            continue
        ids = distinct[begins]
        going = np.arange(len(ids))
        for age in range(timeout):
            options = np.full(len(going), option)
            actions = loop.learner.act(ids[going], options, np.full(len(going), age), explore=False)
            ids[going] = plan.following[place[ids[going]], column[actions]]
            ended = loop.terminations.of_running(ids[going], options) | plan.final[place[ids[going]]]
            going = going[~ended]
            if not len(going):
                break
        qualities[option] = np.average(good[place[ids], goal], weights=counts[begins])
    return qualities


def judge(choices: Choices, quality: Doubles, members: int) -> dict[str, Any]:
    """Whether the better of K members are taken, where at least two of the chosen sub-goal's were offered.

    ``quality`` (G*K,) is of :func:`qualities`; NaN where it is not known. Returns ``preference`` (G*K,): chosen /
    expected among the members of the chosen sub-goal, NaN below ``LEAST`` expected; ``within_rho``: Spearman's rho of
    the two, mean over sub-goals whose members' qualities differ by ``DIFFERENCE``; ``pair``: of two members offered
    whose qualities differ by that, how often the better of those taken (.5 at random); ``score``: (quality taken - mean
    quality) / (best - mean), over decisions (0 at random).
    """
    goals = np.arange(len(quality)) // members
    of_goal = choices.offered & (goals == goals[choices.options][:, None])
    counts = of_goal.sum(axis=1)
    several = counts > 1
    taken, among = choices.options[several], of_goal[several]
    shares = among / counts[several][:, None]
    expected = shares.sum(axis=0).round(house.DIGITS)  # in any order of decisions
    chosen = np.bincount(taken, minlength=len(quality))
    preference = np.where(house.at_least(expected, LEAST), chosen / np.maximum(expected, 1e-12), np.nan)
    return {
        "preference": preference,
        "within_rho": _within_rho(quality, preference, goals),
        "pair": _better_of_two(quality, taken, among, goals),
        "score": _score(quality, taken, among),
    }


def _within_rho(quality: Doubles, preference: Doubles, goals: Ints) -> float:
    both = pd.DataFrame({"quality": quality, "preference": preference}).dropna()
    rhos = []
    for _, alike in both.groupby(goals[both.index]):
        differ = house.at_least(np.ptp(alike["quality"]), DIFFERENCE)
        if differ and alike["preference"].nunique() > 1:
            rhos.append(alike["quality"].corr(alike["preference"], method="spearman"))
    return pd.Series(rhos, dtype=float).mean()


def _better_of_two(quality: Doubles, taken: Ints, among: Bools, goals: Ints) -> float:
    better, both = 0, 0
    for pair in combinations(range(len(quality)), 2):
        bad, good = sorted(pair, key=lambda option: quality[option])
        if goals[bad] != goals[good] or not house.at_least(quality[good] - quality[bad], DIFFERENCE):
            continue
        of_both = taken[among[:, good] & among[:, bad]]
        better += (of_both == good).sum()
        both += np.isin(of_both, pair).sum()
    return better / both if both else math.nan


def _score(quality: Doubles, taken: Ints, among: Bools) -> float:
    judged = among & ~np.isnan(quality)
    compared = (judged.sum(axis=1) > 1) & ~np.isnan(quality[taken])
    if not compared.any():
        return math.nan
    values = np.where(judged, quality, np.nan)[compared]
    average = np.nanmean(values, axis=1)
    gain = (np.nanmax(values, axis=1) - average).sum()
    gained = (quality[taken[compared]] - average).sum()
    return gained / gain if house.above(gain, 0.0) else math.nan


def rows(work: Work) -> Iterator[pd.DataFrame]:
    """Every run of an agent that learned to choose among members' options, in a domain that knows what follows.

    The agent's numbers, those of uniform-random choice, and every member's.
    """
    for artefact in work.contents.agents:
        played = play_agent(artefact)
        if played is None:
            continue
        place = {**work.place(artefact), "scope": FROZEN}
        agent, uniform, members = played
        yield house.tidy(agent, **place)
        yield house.tidy(uniform, **(place | {"method": UNIFORM}))
        yield members.melt(["sub_goal", "member"], var_name="quantity").assign(**place)


def is_playable(artefact: Artefact) -> bool:
    """Whether it chose to learn among options that can be asked in any state, of one layout of a known domain."""
    config = artefact.config
    if artefact.kind != "meta" or not takes(artefact) or config["chooser"] == "random":
        return False
    # Of many layouts the states are too many to say what follows in each.
    if config["network"] not in MEMORYLESS or config.get("layouts"):
        return False
    sub_goals = load_domain(config["domain"]).sub_goals
    return set(config["sub_goals"]) <= set(sub_goals) and "options.safetensors" in artefact.manifest.files


def play_agent(artefact: Artefact) -> tuple[dict[str, float], dict[str, float], pd.DataFrame] | None:
    """A trained agent played on, frozen, and uniform-random choice among its own options.

    Returns ``OF_PLAY`` and ``OF_CHOICE`` of both, and a row per member: sub_goal, member, quality and
    conditional_preference. None where it is not playable, or the engine does not know what each action leads to.
    """
    from hypogoal.evaluation.frozen import ENVIRONMENTS, play  # with PyTorch, which a report does not need
    from hypogoal.meta.episodes import agent_of
    from hypogoal.options.choosers import RandomChooser

    config, seed = artefact.config, artefact.seed
    # one game first, since many take long to begin
    if not is_playable(artefact) or agent_of(artefact, seed).engine.plan() is None:
        return None
    loop = agent_of(artefact, seed, ENVIRONMENTS)
    sub_goals, members = config["sub_goals"], config["members"]
    table = pd.MultiIndex.from_product([sub_goals, range(members)], names=["sub_goal", "member"]).to_frame(index=False)
    in_domain = load_domain(config["domain"]).sub_goals
    goals = table["sub_goal"].map(in_domain.index).to_numpy()
    uniform = RandomChooser(rng_for(seed, "uniform-choice"))
    of_both = [play(loop, chooser) for chooser in (loop.chooser, uniform)]
    quality = qualities(loop, goals, of_both[0].choices.states)  # where the agent itself decides
    numbers = []
    for episodes in of_both:
        scores = episodes.scores(loop.engine.shortest_path()) | {"length": episodes.length}
        means = {name: scores[name].mean() for name in OF_PLAY}
        numbers.append(means | judge(episodes.choices, quality, members))
    preference, _ = [of_one.pop("preference") for of_one in numbers]
    return numbers[0], numbers[1], table.assign(quality=quality, conditional_preference=preference)


def runs(results: Results) -> pd.DataFrame:
    """Each agent (``chooser`` its own), and uniform-random choice among its own options."""
    return with_choosers(house.per_run(results.of(sub_goal=""), *OF_PLAY, *OF_CHOICE, scope=FROZEN))


def with_choosers(runs: pd.DataFrame) -> pd.DataFrame:
    """The same with a column ``chooser``; the method of uniform-random choice is the agent whose options it has."""
    uniform = runs["method"] == UNIFORM
    agents = runs[~uniform].drop_duplicates("artefact").set_index("artefact")["method"]
    return runs.assign(
        chooser=runs["method"].where(uniform, "the agent's"),
        method=runs["artefact"].map(agents),
    )
