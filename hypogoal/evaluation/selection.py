"""Question 5, Figures 7 and 8: which members the meta-policy prefers, and whether they are the good ones (Spec F6)."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray
from scipy.stats import rankdata

from hypogoal.core.artefacts import open_artefact
from hypogoal.core.seeding import rng_for
from hypogoal.domains.base import Engine, load_domain, step_of
from hypogoal.evaluation import page
from hypogoal.evaluation.curves import (
    BANDITS,
    LAYOUTS_OR_RUNS,
    LEARNED,
    PRETRAINING,
    RANDOM,
    base_name,
    control_of,
    variants,
    which,
)
from hypogoal.evaluation.numbers import Metrics, Row, mean_of, over, rows_of_members
from hypogoal.evaluation.page import Block, Drawn, Entry, Material, Question
from hypogoal.evaluation.pictures import overlay
from hypogoal.evaluation.plots import GREY, PICTURE_TITLE, drawing, grid_of_pictures, show_picture, style_of
from hypogoal.evaluation.run import Choices, read_choices, read_terminations, within
from hypogoal.hypotheses.scores import member_scores, most_and_least

if TYPE_CHECKING:
    from hypogoal.evaluation.judging import Work

LATE = 0.25  # the last part of training that is looked at by itself
PARTS = 20  # of training, in which choices are counted apart
SELECTED = (LEARNED, *BANDITS.values(), RANDOM, PRETRAINING)  # agents whose options are members: to select among
QUANTITIES = {
    "preference": "preference",
    "late_preference": "preference, last quarter",
    "share": "raw share (confounded)",
}
NUMBERED = {"open-red-door": "figure7", "go-to-goal": "figure8"}  # the sub-goals that the paper shows
MOST = ("most", "least")  # preferred
SCOPE = "layout"  # in numbers.csv: of choices, and of the match with the truth, on a run's layout


def preference(chosen: NDArray[Any], expected: NDArray[np.float64]) -> NDArray[np.float64]:
    """Spec F6: chosen / expected under uniform choice among the options offered, float64 (..., O).

    A raw share is confounded: a member that always fires is masked nearly always, one that never fires is offered
    always. This ratio is 1 for a chooser that does not care, whatever is offered how often, and NaN where an option was
    never offered. ``chosen`` are the decisions that chose each option, ``expected`` the sum of 1 / (options offered)
    over those that offered it.
    """
    safe = np.where(expected > 0, expected, 1.0)
    return np.where(expected > 0, chosen / safe, np.nan)


def shares(chosen: NDArray[Any]) -> NDArray[np.float64]:
    """Spec F6: the share of all decisions that chose each option, (O,); NaN without decisions."""
    total = chosen.sum()
    return chosen / total if total > 0 else np.full(chosen.shape, np.nan)


def rank_correlation(first: NDArray[np.float64], second: NDArray[np.float64]) -> float:
    """Spec F6: Spearman's rank correlation of (n,) and (n,), ties sharing their mean rank.

    Pairs with a NaN are left out. NaN where fewer than two pairs are left or one side is constant: then there is no
    ranking to compare.
    """
    defined = ~(np.isnan(first) | np.isnan(second))
    if defined.sum() < 2:
        return math.nan
    ranks = rankdata(first[defined]), rankdata(second[defined])
    deviations = [rank - rank.mean() for rank in ranks]
    spread = np.sqrt((deviations[0] ** 2).sum() * (deviations[1] ** 2).sum())
    return float((deviations[0] * deviations[1]).sum() / spread) if spread > 0 else math.nan


def rank_correlations(values: NDArray[np.float64], match: NDArray[np.float64], members: int) -> dict[str, float]:
    """Spec F6: rank correlation between members' values (their preference, say) and their match with the true sub-goal.

    Both are (G*K,), sub-goal * K + member; the match is balanced accuracy on the layout. ``all``: over all options at
    once; ``within``: the mean over sub-goals of the correlation among its own K members, so that a sub-goal that is
    chosen often does not count; NaN where not defined.
    """
    goals = zip(values.reshape(-1, members), match.reshape(-1, members), strict=True)
    within = [value for value in (rank_correlation(*goal) for goal in goals) if not np.isnan(value)]
    return {"all": rank_correlation(values, match), "within": mean_of(within)}


def over_training(choices: Choices, options: int, parts: int = PARTS) -> dict[str, NDArray[np.float64]]:
    """Spec E5, F6: choices counted in equal parts of training, in the order of time, each in the part in which it ends.

    ``step``, where each part ends (P,), and ``chosen`` and ``expected``, (P, O) each; P is ``parts``, or as many as
    there are choices where those are fewer.
    """
    windows = np.unique(choices.step)
    parts = min(parts, len(windows))
    ends = np.array([part[-1] for part in np.array_split(windows, parts)]) if parts else np.zeros(0)
    part = np.searchsorted(ends, choices.step)
    found = {"step": ends.astype(np.float64)}
    for name in ("chosen", "expected"):
        counts = np.bincount(part * options + choices.option, getattr(choices, name), minlength=parts * options)
        found[name] = counts.reshape(parts, options).astype(np.float64)
    return found


def selection_of_run(
    choices: Choices, match: NDArray[np.float64], sub_goals: Sequence[str], members: int
) -> dict[str, Any]:
    """Spec F6: how often each member was offered and chosen, beside how well it matches the true sub-goal here.

    Args:
        choices: the run's table of choices.
        match: float (G*K,), each member's balanced accuracy on the layout's reachable states.
        sub_goals: G names.
        members: K.

    Returns:
        ``sub_goals``: a row per member (option, offered, chosen, expected, preference, late_preference, share, reached,
        mean duration in steps, match), the most and the least preferred member; ``rank_correlation`` of preference,
        late preference (the last quarter of training) and raw share with the match, each over all options and within
        sub-goals. NaN where not defined.
    """
    options = len(sub_goals) * members
    totals = {name: choices.total(name, options) for name in ("offered", "chosen", "expected", "reached", "duration")}
    begin, end = (choices.step.min(), choices.step.max()) if len(choices.step) else (0, 0)
    late = choices.since(end - LATE * (end - begin))
    values = {
        "preference": preference(totals["chosen"], totals["expected"]),
        "late_preference": preference(late.total("chosen", options), late.total("expected", options)),
        "share": shares(totals["chosen"]),
    }
    duration = np.divide(totals["duration"], totals["chosen"], out=np.full(options, np.nan), where=totals["chosen"] > 0)
    floats = {"expected": totals["expected"], "duration": duration, "match": match, **values}
    columns = {name: totals[name].astype(np.int64) for name in ("offered", "chosen", "reached")} | floats
    order = ("offered", "chosen", "expected", "reached", "duration", "match", *values)
    by_goal = []
    for index, sub_goal in enumerate(sub_goals):
        start = index * members
        most, least = most_and_least(values["preference"][start : start + members])
        rows = [
            {"member": option - start, "option": option, **{name: columns[name][option].item() for name in order}}
            for option in range(start, start + members)
        ]
        by_goal.append({"sub_goal": sub_goal, "members": rows, "most": most, "least": least})
    correlations = {name: rank_correlations(value, match, members) for name, value in values.items()}
    return {"sub_goals": by_goal, "rank_correlation": correlations}


def numbers(work: Work) -> dict[str, Any]:
    """Spec F6: for each agent whose options are members: choices against match, per run and over runs."""
    found, metrics = work.contents, []
    artefacts = {found.name(artefact): artefact for artefact in found.agents}
    match_of = cache(match_on_layout)
    for agent in work.metrics["agents"]:
        rows = []
        for about in agent["runs"]:
            work.progress.advance()
            artefact = artefacts[about["path"]]
            config, folder = artefact.config, artefact.path
            if base_name(artefact.kind, config) not in SELECTED:
                continue
            ensemble = artefact.input("ensemble")
            match, choices = match_of(ensemble, about["layout_seed"]), read_choices(folder / "choices.csv")
            for option, states in read_terminations(folder / "terminations.h5").items():
                place = f"terminations/{about['path']}/{option}"
                work.arrays[place] = overlay(states)
                work.arrays[place].attrs["states"] = len(states)
            for column, counts in over_training(choices, len(config["sub_goals"]) * config["members"]).items():
                work.arrays[f"choices/{about['path']}/{column}"] = counts
            of = {name: about[name] for name in ("path", "seed", "layout_seed")}
            chosen = selection_of_run(choices, match, config["sub_goals"], config["members"])
            rows.append({**of, "ensemble": within(found, open_artefact(ensemble, "ensemble")), **chosen})
        if rows:
            metrics.append({"name": agent["name"], "runs": rows, "rank_correlation": _over_runs(agent["name"], rows)})
    return {"selection": metrics}


def match_on_layout(path: Path, layout_seed: int) -> NDArray[np.float64]:
    """Spec F6: the balanced accuracy of every member of an ensemble on the states of a layout, float (G*K,).

    NaN where the domain does not have the sub-goal, which the user's own labels told: its truth there is not known.
    """
    from hypogoal.hypotheses.ensemble import read_ensemble  # with PyTorch, which a report needs not

    source = open_artefact(path, "ensemble")
    domain = load_domain(source.config["domain"])
    engine = domain.make_engine(layout_seed, 1, 500, **domain.world(source.config["domain_config"]))
    ids = states_of_layout(engine)
    images, labels = engine.images(ids), dict(zip(domain.sub_goals, engine.labels(ids).T, strict=True))
    match = []
    for sub_goal in source.config["sub_goals"]:
        if sub_goal not in labels:
            match.append(np.full(source.config["members"], np.nan))
            continue
        ensemble = read_ensemble(source.path, source.config, sub_goal)
        verdicts = ensemble.verdicts(images, engine.positions(ids) if ensemble.needs_positions else None)
        match.append(member_scores(verdicts, labels[sub_goal])["balanced_accuracy"])
    return np.concatenate(match)


def states_of_layout(engine: Engine, steps: int = 2_000) -> NDArray[np.int64]:
    """The states of a fresh engine's layout: those that can be reached, or, where nobody knows them, what so many
    steps of random play meet; each once.
    """
    if (reachable := engine.reachable()) is not None:
        return reachable
    rng = rng_for(0, "states-of-layout")
    met = [
        step_of(engine, rng.integers(engine.n_actions, size=engine.count)).next_ids
        for _ in range(steps // engine.count)
    ]
    return np.unique(np.concatenate([engine.ids, *met]))


def _over_runs(name: str, rows: Sequence[Entry]) -> dict[str, Any]:
    layouts = [row["layout_seed"] for row in rows]

    def of(quantity: str, scope: str) -> dict[str, Any]:
        values = [row["rank_correlation"][quantity][scope] for row in rows]
        return over(values, "Spearman's rho", name, quantity, scope, layouts=layouts)

    return {quantity: {scope: of(quantity, scope) for scope in ("all", "within")} for quantity in QUANTITIES}


def rows(metrics: Metrics, arrays: Any) -> Iterator[Row]:
    """Every member as an option of every run."""
    for agent in metrics["selection"]:
        for run in agent["runs"]:
            about = {"method": agent["name"], "layout": run["layout_seed"], "seed": run["seed"], "scope": SCOPE}
            for goal in run["sub_goals"]:
                yield from rows_of_members(goal["members"], **about, sub_goal=goal["sub_goal"], artefact=run["path"])


def missing(work: Work) -> list[str]:
    """Sub-goals of which the domain does not know where they are reached."""
    goals = [goal for agent in work.metrics["selection"] for run in agent["runs"] for goal in run["sub_goals"]]
    unknown = [goal for goal in goals if all(math.isnan(member["match"]) for member in goal["members"])]
    names = dict.fromkeys(goal["sub_goal"] for goal in unknown)
    return [f"no truth of {name} in its domain, to match members with" for name in names]


CORRELATIONS = (
    page.label("chooser", "chooser", once=True),
    page.label("ranked by", "ranked by"),
    page.number("within sub-goals", "within", page.interval, 2),
    page.number("over all options", "all", page.interval, 2),
    page.number("runs", "within.n"),
)
MEMBERS = (
    page.label("sub-goal", "sub_goal", once=True),
    page.label("member", "name"),
    page.number("offered", "offered"),
    page.number("chosen", "chosen"),
    page.number("expected", "expected", page.fixed, 0),
    page.number("preference", "preference", page.fixed, 2),
    page.number("late", "late_preference", page.fixed, 2),
    page.number("share, %", "share", lambda share: page.fixed(None if share is None else 100 * share, 1)),
    page.number("steps", "duration", page.fixed, 1),
    page.number("match", "match", page.fixed, 2),
)


def sections(material: Material) -> list[Block]:
    """Where options stop and which are chosen, of a run with agents."""
    return [terminations_section(material), choices_section(material)] if material.of_agents() else []


def _agent(material: Material) -> Entry | None:
    """The variant of the option agent that is shown."""
    return next(iter(variants(material.metrics["selection"])), None)


def _name(run: Entry) -> str:
    return f"layout seed {run['layout_seed']}, run seed {run['seed']}"


def terminations_section(material: Material) -> Block:
    """Figures 7 and 8: where the most and the least preferred member's options stopped."""
    agent, title = _agent(material), "Where options stop"
    if agent is None:
        lacking = ["Overlaid termination states: they need a meta artefact with learned terminations: train-meta."]
        return page.section("terminations", title, [], [], lacking)
    text = (
        "The states in which a member's classifier ended its option, laid over each other: what all of them share is "
        "sharp, what few of them show is dim. For each sub-goal the member that the agent prefers most and the one "
        "it prefers least; match is the member's balanced accuracy against the true sub-goal on that layout."
    )
    blocks = [
        {
            "kind": "pairs",
            "heading": "" if index else _name(run),
            "folded": _name(run).capitalize() if index else "",
            "pairs": [_pair(material, run, goal) for goal in run["sub_goals"]],
            "caption": f"Figures 7 and 8 of the paper, for all sub-goals: {run['path']}, {_name(run)}. The last "
            "states, 128 at most, in which the option's own classifier said yes.",
        }
        for index, run in enumerate(agent["runs"])
    ]
    return page.section("terminations", title, [text, which(agent, material.metrics["selection"])], blocks)


def _pair(material: Material, run: Entry, goal: Entry) -> dict[str, Any]:
    sides = []
    for word in MOST:
        side = {"png": "", "nothing": "never offered", "title": f"{word} preferred: none", "note": ""}
        if goal[word] is not None:
            title, note, image = _side(material, run["path"], goal, word)
            side |= {"nothing": "its classifier never ended it", "title": title, "note": note}
            if image is not None:
                alt = f"Overlaid termination states of {goal['sub_goal']}, member {goal[word]}"
                side |= {"png": page.picture(image), "alt": alt}
        sides.append(side)
    return {"title": goal["sub_goal"], "sides": sides}


def _side(material: Material, path: str, goal: Entry, word: str) -> tuple[str, str, NDArray[np.uint8] | None]:
    """Title, note and picture of the most or the least preferred member."""
    member = goal["members"][goal[word]]
    note = f"preference {page.fixed(member['preference'], 2)}, match {page.fixed(member['match'], 2)}"
    image = material.arrays.get(f"terminations/{path}/{member['option']}")
    return f"{word} preferred: member {goal[word]}", note, image


def choices_section(material: Material) -> Block:
    """Question 5: does reward lead to the hypotheses that transfer?"""
    agent, title, selection = _agent(material), "Which hypotheses are chosen", material.metrics["selection"]
    drawn = page.shown(material, _scatter(material))
    if agent is None:
        return page.section("choices", title, [], [drawn])
    text = (
        "Preference is how often an option was chosen over how often a uniform choice among the options offered "
        "would have chosen it. Raw shares are confounded by availability: a member that fires everywhere is masked "
        "nearly always, one that never fires is always offered. The random chooser's numbers show what no preference "
        "looks like."
    )
    correlations = page.table(
        CORRELATIONS,
        [
            {"chooser": chooser["name"], "ranked by": name, **chooser["rank_correlation"][key]}
            for chooser in selection
            for key, name in QUANTITIES.items()
        ],
        heading="Rank correlation with the match",
        caption="Spearman's rank correlation between how a member is ranked and its match with the true sub-goal on "
        "the run's layout. Within: mean over sub-goals of the correlation among a sub-goal's members. 1 would mean "
        "that reward picks out the hypotheses that transfer, 0 that it does not. "
        f"{page.INTERVALS.format(units=LAYOUTS_OR_RUNS)}",
    )
    members = [_members(run, folded=index > 0) for index, run in enumerate(agent["runs"])]
    control, variant = control_of(material, agent, selection), which(agent, selection)
    lacking = "No random chooser beside it: it needs a meta artefact with chooser=random."
    if variant:
        variant = f"{variant} Rank correlations are those of every variant."
        lacking = f"No random choice among the options of {agent['name']} was run."
    return page.section(
        "choices", title, [text, variant], [drawn, correlations, *members], [] if control else [lacking]
    )


def _members(run: Entry, *, folded: bool) -> Block:
    lines = [
        {**member, "sub_goal": goal["sub_goal"], "name": page.noted(index, {word: goal[word] for word in MOST}, most=1)}
        for goal in run["sub_goals"]
        for index, member in enumerate(goal["members"])
    ]
    name = f"Every member: {_name(run)}"
    return page.table(
        MEMBERS,
        lines,
        heading="" if folded else name,
        folded=name if folded else "",
        caption="Decisions at which the option was offered and chosen; expected under uniform choice; preference "
        "over all and over the last quarter of training; raw share of decisions; mean steps of an execution; match "
        "on this layout.",
    )


def figures(material: Material) -> Iterator[Drawn]:
    """Preference against match; Figures 7 and 8 and the other sub-goals', of the agent's first run."""
    yield _scatter(material)
    agent, selection = _agent(material), material.metrics["selection"]
    run = agent["runs"][0] if agent else {"sub_goals": []}
    for goal in run["sub_goals"]:
        sides = [_side(material, run["path"], goal, word) for word in MOST if goal[word] is not None]
        if not sides:
            continue
        name = NUMBERED.get(goal["sub_goal"], f"terminations-{goal['sub_goal']}")
        title = name.replace("figure", "Figure ") if name in NUMBERED.values() else "As Figures 7 and 8"
        caption = (
            f"{title} of the paper: overlaid termination states of {goal['sub_goal']}, of the member that the agent "
            f"prefers most and of the one it prefers least ({run['path']}, {_name(run)}); the last states, 128 at "
            "most, in which the member's classifier ended its option. Preference: chosen / expected under uniform "
            f"choice; match: balanced accuracy on that layout. {which(agent, selection) if agent else ''}"
        ).rstrip()
        drawn = termination_states([(f"{title}\n{note}", image) for title, note, image in sides])
        yield Drawn(name, title, drawn, caption)


def _values(agent: Mapping[str, Any], key: str) -> NDArray[np.float64]:
    """Float (runs, sub-goals, members)."""
    runs = [[[member[key] for member in goal["members"]] for goal in run["sub_goals"]] for run in agent["runs"]]
    return np.array(runs, dtype=np.float64)


def _scatter(material: Material) -> Drawn:
    agent, selection = _agent(material), material.metrics["selection"]
    if agent is None:
        needed = "It needs a meta artefact with learned terminations: train-meta."
        return Drawn("preference", "Which hypotheses are chosen", None, missing=needed)
    control = control_of(material, agent, selection)
    uncaring = (_values(control, "match").ravel(), _values(control, "preference").ravel()) if control else None
    names = [goal["sub_goal"] for goal in agent["runs"][0]["sub_goals"]]
    drawn = preference_against_match(names, _values(agent, "match"), _values(agent, "preference"), uncaring)
    layouts = sorted({run["layout_seed"] for run in agent["runs"]})
    caption = (
        "Question 5 of the paper: a point per member and run, over all of training; up: chosen more often than by a "
        f"uniform chooser; right: closer to the true sub-goal on that layout (layout seed {page.listed(layouts)}; "
        f"runs: {len(agent['runs'])}). {which(agent, selection)}"
    ).rstrip()
    return Drawn("preference", "Preference against match", drawn, caption)


def preference_against_match(
    sub_goals: Sequence[str],
    match: NDArray[np.float64],
    preference: NDArray[np.float64],
    control: tuple[NDArray[np.float64], NDArray[np.float64]] | None = None,
) -> Figure:
    """Question 5 of the paper: is the member that is chosen more often the one that fits the true sub-goal?

    ``match``, balanced accuracy on the run's layout, and ``preference``, chosen / expected under uniform choice, are
    (R, G, K); ``control`` is the same two, flat, of the random chooser.
    """
    with drawing(3.9, 3, handletextpad=0.3) as (figure, axes):
        if control is not None:
            axes.plot(*control, ".", color=GREY, markersize=5, alpha=0.6, label="random choice")
        for index, name in enumerate(sub_goals):
            colour, marker = style_of(index)
            x, y = match[:, index].ravel(), preference[:, index].ravel()
            axes.plot(x, y, marker, color=colour, markersize=6, alpha=0.85, linestyle="none", label=name)
        axes.axhline(1.0, color=GREY, linewidth=1.2, linestyle=":")
        axes.set_yscale("symlog", base=2, linthresh=0.25)
        top = max(2.0, float(np.nanmax(preference))) if np.isfinite(preference).any() else 2.0
        ticks = [0, 0.25, 0.5, *(2.0**power for power in range(int(np.ceil(np.log2(top))) + 1))]
        axes.set_yticks(ticks, [f"{tick:g}" for tick in ticks])
        axes.minorticks_off()
        axes.set_ylim(-0.04, ticks[-1] * 1.1)
        axes.set_xlabel("match: balanced accuracy on the run's layout")
        axes.set_ylabel("preference: chosen / expected")
    return figure


def termination_states(sides: Sequence[tuple[str, NDArray[np.uint8] | None]]) -> Figure:
    """Figures 7 and 8: overlaid termination states of some members, the most preferred first.

    A side is a title and an overlay uint8 (H, W, C), None where its classifier never ended an execution.
    """
    figure, places = grid_of_pictures(1, max(2, len(sides)), PICTURE_TITLE)
    for place, (title, image) in zip(places, sides, strict=False):
        if image is None:
            place.set_title(title, fontsize=9)
            place.text(0.5, 0.5, "never ended\nby its classifier", ha="center", va="center", color=GREY)
        else:
            show_picture(place, image, title)
    return figure


QUESTION = Question(
    numbers=numbers,
    missing=missing,
    rows=rows,
    sections=sections,
    figures=figures,
    needed={
        "figure7": "a meta artefact with learned terminations that has open-red-door: train-meta",
        "figure8": "a meta artefact with learned terminations that has go-to-goal: train-meta",
    },
)
