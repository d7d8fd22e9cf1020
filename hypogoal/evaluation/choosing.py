"""What choosing is worth: how good options are, whether the better option is taken, and what random choice does.

An option is good if its execution brings about the true sub-goal. How well its classifier matches the truth on all
states says little of that. Choice is judged among the members of the sub-goal that was chosen, since which sub-goal is
due is another matter. The control has the agent's own final options, and picks one of those offered at random.
"""

from __future__ import annotations

import math
from itertools import combinations
from typing import TYPE_CHECKING, Any

import numpy as np
import pandas as pd

from hypogoal.core.arrays import Doubles, Ints
from hypogoal.core.artefacts import Artefact
from hypogoal.domains.find import load_domain
from hypogoal.evaluation import statistics, table
from hypogoal.evaluation.names import UNIFORM
from hypogoal.evaluation.run import choice_of
from hypogoal.evaluation.selection import engine_on

if TYPE_CHECKING:
    from hypogoal.evaluation.frozen import Choices
    from hypogoal.options.loop import OptionLoop

LEAST = 20.0  # expected choices of a member; with fewer, its preference is not told
DIFFERENCE = 0.2  # between members' qualities; with less, there is nothing to choose
MEMORYLESS = ("light", "planned")  # option policies that can be asked in any state
RULES_OF_STATES = ("learned", "oracle")  # values of ``termination`` that end an option by its state alone
OF_PLAY = ("success", "near", "length")
OF_CHOICE = ("within_rho", "pair", "score")
FROZEN = "frozen"  # the scope of episodes that are played after training
TITLE = "What choosing is worth"
BY = ["method", "chooser"]


def qualities(loop: OptionLoop, goals: Ints, states: Ints) -> Doubles:
    """Return how often each option's greedy execution brings about its true sub-goal without losing: float64 (O,).

    The policies must remember nothing, and the engine must know what follows. ``goals`` (O,) are columns of the
    engine's labels. An execution begins in each of ``states`` (D,) in which the option's member is negative, and the
    sub-goal does not hold but can be had within the timeout. An option that begins nowhere has NaN.
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
    negative = ~loop.terminations.of(distinct)
    qualities = np.full(len(goals), np.nan)
    for option, goal in enumerate(goals):
        steps = away[place[distinct], goal]
        begins = negative[:, option] & (steps > 0) & (steps <= timeout)
        if not begins.any():
            continue
        ids = distinct[begins]
        going = np.arange(len(ids))
        for age in range(timeout):
            options, ages = np.full((2, len(going)), [[option], [age]])
            actions = loop.learner.act(ids[going], options, ages, explore=False)
            ids[going] = plan.following[place[ids[going]], column[actions]]
            ended = loop.terminations.of_running(ids[going], options)
            final = plan.final[place[ids[going]]]
            going = going[~ended & ~final]
            if not len(going):
                break
        qualities[option] = np.average(good[place[ids], goal], weights=counts[begins])
    return qualities


def judge(choices: Choices, quality: Doubles, members: int) -> dict[str, Any]:
    """Return whether the better of K members are taken, where at least two of the chosen sub-goal's were offered.

    ``quality`` (G*K,) is the result of :func:`qualities`, NaN if it is not known. Returns ``preference`` (G*K,), which
    is chosen / expected among the members of the chosen sub-goal, NaN below ``LEAST`` expected; ``within_rho``,
    Spearman's rho of quality and preference, mean over sub-goals whose members' qualities differ by ``DIFFERENCE``;
    ``pair``, how often the better of two members is taken if both were offered, one of them was taken, and their
    qualities differ by ``DIFFERENCE`` (.5 at random); and ``score``, (quality taken - mean quality) / (best - mean),
    over decisions (0 at random).
    """
    goals = np.arange(len(quality)) // members
    of_goal = choices.offered & (goals == goals[choices.options][:, None])
    counts = of_goal.sum(axis=1)
    several = counts > 1
    taken, among = choices.options[several], of_goal[several]
    shares = among / counts[several][:, None]
    expected = shares.sum(axis=0).round(statistics.DIGITS)  # equal for any order of decisions
    chosen = np.bincount(taken, minlength=len(quality))
    preference = chosen / np.where(statistics.at_least(expected, LEAST), expected, np.nan)
    return {
        "preference": preference,
        "within_rho": _within_rho(quality, preference, goals),
        "pair": _better_of_two(quality, taken, among, goals),
        "score": _score(quality, taken, among),
    }


def _within_rho(quality, preference, goals):
    both = pd.DataFrame({"quality": quality, "preference": preference}).dropna()
    rhos = []
    for _, alike in both.groupby(goals[both.index]):
        differ = statistics.at_least(np.ptp(alike["quality"]), DIFFERENCE)
        if differ and alike["preference"].nunique() > 1:
            rhos.append(alike.corr("spearman").loc["quality", "preference"])
    return pd.Series(rhos, dtype=float).mean()


def _better_of_two(quality, taken, among, goals):
    better, both = 0, 0
    for pair in combinations(range(len(quality)), 2):
        bad, good = sorted(pair, key=quality.__getitem__)
        if goals[bad] == goals[good] and statistics.at_least(quality[good] - quality[bad], DIFFERENCE):
            of_both = taken[among[:, good] & among[:, bad]]
            better += (of_both == good).sum()
            both += np.isin(of_both, pair).sum()
    return better / both if both else math.nan


def _score(quality, taken, among):
    offered = pd.DataFrame(np.where(among, quality, np.nan))
    own = quality[taken]
    compared = (offered.count(axis=1) > 1) & np.isfinite(own)
    average = offered.mean(axis=1)
    gain = (offered.max(axis=1) - average)[compared].sum()
    gained = (own - average)[compared].sum()
    return gained / gain if statistics.above(gain, 0.0) else math.nan


def rows(work):
    """Yield the numbers of every agent that learned to choose among members' options, if its domain knows what follows.

    The numbers are the agent's, those of uniform-random choice, and every member's.
    """
    for artefact in work.contents.agents:
        played = play_agent(artefact)
        if played is None:
            continue
        place = work.place(artefact) | {"scope": FROZEN}
        agent, uniform, members = played
        yield table.tidy(agent, **place)
        yield table.tidy(uniform, **place | {"method": UNIFORM})
        yield table.melted(members, table.options_of(artefact.config), **place)


def is_playable(artefact: Artefact) -> bool:
    """Return whether an agent learned to choose, on one layout of a known domain, among options without memory."""
    config = artefact.config
    if choice_of(artefact) != "learned" or config["termination"] not in RULES_OF_STATES:
        return False
    # Many layouts have too many states to say what follows in each.
    if config["network"] not in MEMORYLESS or config.get("layouts"):
        return False
    return {*config["sub_goals"]} <= {*load_domain(config["domain"]).sub_goals}


def play_agent(artefact: Artefact) -> tuple[dict[str, float], dict[str, float], dict[str, Doubles]] | None:
    """Play a trained agent, frozen, and uniform-random choice among its own options.

    Returns ``OF_PLAY`` and ``OF_CHOICE`` of the agent, the same of random choice, and each option's quality and
    conditional_preference (G*K,). Returns None if the agent is not playable, or if the engine does not know what each
    action leads to.
    """
    from hypogoal.evaluation.frozen import ENVIRONMENTS, play_both  # with PyTorch, which a report does not need
    from hypogoal.meta.episodes import agent_of

    config, seed = artefact.config, artefact.seed
    # an engine with one game is asked first, since many games take long to begin
    if not is_playable(artefact) or engine_on(config, [config["layout_seed"]]).plan() is None:
        return None
    loop = agent_of(artefact, seed, ENVIRONMENTS)
    of_options = table.options_of(config).get_level_values("sub_goal")
    goals = of_options.map(load_domain(config["domain"]).sub_goals.index).to_numpy()
    of_both = play_both(loop, seed)
    quality = qualities(loop, goals, of_both[0].choices.states)  # executions begin where the agent itself decided
    numbers, preferences = [], []
    for played in of_both:
        scores = played.scores(loop.engine.shortest_path())
        judged = judge(played.choices, quality, config["members"])
        preferences.append(judged.pop("preference"))
        numbers.append({name: scores[name].mean() for name in OF_PLAY} | judged)
    return (numbers[0], numbers[1], {"quality": quality, "conditional_preference": preferences[0]})


def context(results):
    """Return the tables of each agent (``chooser`` its own), and of uniform-random choice among its own options."""
    runs = table.per_run(results.of(sub_goal=""), *OF_PLAY, *OF_CHOICE, scope=FROZEN)
    return statistics.tables_of(with_choosers(runs), BY)


def with_choosers(runs: pd.DataFrame) -> pd.DataFrame:
    """Return the numbers of runs with a column ``chooser``.

    The method of uniform-random choice becomes the agent whose options are chosen from.
    """
    uniform = runs["method"] == UNIFORM
    agents = runs[~uniform].drop_duplicates("artefact").set_index("artefact")["method"]
    return runs.assign(chooser=runs["method"].where(uniform, "the agent's"), method=runs["artefact"].map(agents))
