"""Spec A5, F: every number of the report, from whatever artefacts a run has; what is missing is named."""

from __future__ import annotations

import json
import math
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

from hypogoal.core.artefacts import Artefact, claim, create_artefact, open_artefact
from hypogoal.core.compute import prepare
from hypogoal.core.hdf5 import create_hdf5
from hypogoal.core.preflight import free_memory, preflight
from hypogoal.core.progress import Progress
from hypogoal.core.workers import cores
from hypogoal.dataset import open_dataset
from hypogoal.domains.base import installed_domain
from hypogoal.evaluation.agents import (
    Run,
    agent_metrics,
    group_runs,
    missing_agents,
)
from hypogoal.evaluation.arrays import write_curves
from hypogoal.evaluation.browsing import browse_states
from hypogoal.evaluation.comparisons import compare_agents, compare_distances, compare_hypotheses, compare_rooms
from hypogoal.evaluation.curves import GAMMA, SOLVED, WINDOW
from hypogoal.evaluation.distance import INSIDE, LAST, NEAR, ORACLE, distance_tables, ladder_numbers
from hypogoal.evaluation.ensembles import ensemble_name, ensemble_names, hypotheses_table, sub_goal_metrics
from hypogoal.evaluation.examples import overlay
from hypogoal.evaluation.found import Found, find, most_used, takes, within
from hypogoal.evaluation.judging import Case, cases_of, judge_all, processes_for, states_of
from hypogoal.evaluation.ladders import ladder_names, missing_ladders
from hypogoal.evaluation.quantities import QUANTITIES, plain
from hypogoal.evaluation.reading import read_episodes, read_executions, read_layout, read_terminations
from hypogoal.evaluation.rooms import groups_of, method_names, room_metrics, rooms_table
from hypogoal.evaluation.saliency import BASELINE
from hypogoal.evaluation.selecting import evaluate_selection
from hypogoal.evaluation.shown import show_states, show_stops
from hypogoal.evaluation.summary import hypotheses_summary, summary_table
from hypogoal.experiments.cells import DERIVED
from hypogoal.experiments.finished import stamp_of
from hypogoal.experiments.records import PLAN, read_plan
from hypogoal.hypotheses.ensemble import THRESHOLD
from hypogoal.needs import evaluation_needs

__all__ = ["evaluate", "hypotheses_summary", "summary_table"]

SETTINGS = {"window": WINDOW, "solved": SOLVED, "gamma": GAMMA, "threshold": THRESHOLD}
LADDERS = {"executions": LAST, "inside_counts": INSIDE, "near": NEAR}  # settings that only runs with ladders have


def evaluate(run: Path, out: Path, *, force: bool = False, resume: bool = False, quiet: bool = False) -> dict[str, Any]:
    """Compute every number of the report and write the artefact ``out``: ``metrics.json`` and ``arrays.h5``.

    Args:
        run: a folder with ensemble, options, meta and baseline artefacts, any of them.
        out: the artefact to write.
        force, resume, quiet: as for every stage.

    Returns:
        What ``metrics.json`` holds, see ``evaluation/quantities.py``.

    Raises:
        UserError: nothing to evaluate, a damaged artefact, or ``out`` exists.
    """
    prepare()
    out = claim(out, kind="evaluation", force=force, resume=resume)
    found = find(run)
    inputs = [artefact.whole().path for artefact in found.everything()]
    data = sorted({artefact.input("data") for artefact in found.ensembles})
    cases = cases_of(found.ensembles)
    workers = processes_for([case for _, case in cases], cores())
    needs = evaluation_needs(data, workers)
    if workers > 1 and needs.memory > (free_memory() or math.inf):
        workers, needs = 1, evaluation_needs(data, 1)
    preflight("evaluate", out, needs, resume=resume, quiet=quiet)
    with create_artefact(
        out, kind="evaluation", config=SETTINGS, seed=0, inputs=[*data, *inputs], force=force, resume=resume
    ) as folder:
        with (
            create_hdf5(folder / "arrays.h5") as arrays,
            Progress("evaluate", total=len(inputs), quiet=quiet) as progress,
        ):
            runs = [read_run(found, artefact) for artefact in found.agents]
            groups = group_runs(runs)
            agents = [agent_metrics(name, same) for name, same in groups.items()]
            if runs:
                write_curves(arrays, groups)
            selection = evaluate_selection(found, groups, arrays, progress)
            ensembles, saliency, explorer = evaluate_ensembles(found, cases, workers, arrays, progress)
            distance = evaluate_distance(found, ensembles, arrays, progress)
        rooms = rooms_table(ensembles)
        metrics = {
            "run": found.run.resolve().name,
            "settings": {**SETTINGS, **(LADDERS if found.ladders else {})},
            "missing": missing(found, list(groups), rooms, distance, selection),
            "agents": agents,
            "layouts": layouts_of(runs),
            "hypotheses": hypotheses_table(ensembles),
            "ensembles": ensembles,
            "rooms": rooms,
            "distance": distance,
            "saliency": saliency,
            "explorer": explorer,
            "selection": selection,
            "comparisons": {
                "agents": compare_agents(agents),
                "hypotheses": compare_hypotheses(ensembles),
                "rooms": compare_rooms(ensembles),
                "distance": compare_distances(distance["options"]),
            },
            "provenance": provenance(found, data),
            "quantities": QUANTITIES,
        }
        metrics = plain(metrics)
        text = json.dumps(metrics, indent=1, allow_nan=False)
        (folder / "metrics.json").write_text(text + "\n", encoding="utf-8")
    return metrics


def evaluate_ensembles(
    found: Found, cases: Sequence[tuple[int, Case]], workers: int, arrays: Any, progress: Progress
) -> tuple[list[dict[str, Any]], dict[str, Any] | None, dict[str, Any] | None]:
    """Spec F1, F2: every ensemble of the run on its data's held-out and unlabelled states.

    Of one ensemble, the first of those with the most members, example states and attributions are kept too; of one,
    the one with the most members whose options were learned most often, states to browse.
    """
    configs = [artefact.config for artefact in found.ensembles]
    rows: list[list[dict[str, Any]]] = [[] for _ in configs]
    left = [len(config["sub_goals"]) for config in configs]
    shown = max(range(len(configs)), key=lambda index: configs[index]["members"], default=None)
    browsed = most_used(found)
    explained, browsable = [], []

    def done(number: int) -> None:
        index = cases[number][0]
        left[index] -= 1
        progress.advance(left[index] == 0)

    judgements = judge_all([case for _, case in cases], workers, done)
    for (index, case), judged in zip(cases, judgements, strict=True):
        split, unlabelled = states_of(case.data, case.sub_goal)
        kinds = getattr(installed_domain(open_dataset(case.data).domain), "kinds", ())
        layouts = split.origins.get("layout_seed")
        row = sub_goal_metrics(case.sub_goal, judged.verdicts, split.labels, layouts, judged.told)
        if "seen" in split.origins:
            row["rooms"] = room_metrics(judged.verdicts, split.labels, split.origins, kinds, judged.probabilities)
        rows[index].append(row)
        both = (judged.probabilities, judged.verdicts)
        if index == shown:
            explained.append(show_states(case.read(), case.sub_goal, split, both, unlabelled, arrays))
        if index == browsed:
            count = len(configs[index]["sub_goals"])
            states = browse_states(case.read(), case.sub_goal, split, both, unlabelled, kinds, count, arrays)
            browsable.append(states)
    states_of.cache_clear()
    metrics = _named(found, rows)
    if shown is None or browsed is None:
        return metrics, None, None
    about = {"ensemble": metrics[shown]["path"], "seed": metrics[shown]["seed"], "baseline": BASELINE}
    other = {"ensemble": metrics[browsed]["path"], "seed": metrics[browsed]["seed"], "baseline": BASELINE}
    return metrics, {**about, "sub_goals": explained}, {**other, "sub_goals": browsable}


def _named(found: Found, rows: list[list[dict[str, Any]]]) -> list[dict[str, Any]]:
    """What was computed of each ensemble with its names; the method and N where it was judged room by room."""
    configs = [artefact.config for artefact in found.ensembles]
    named = []
    for artefact, name, method, own in zip(
        found.ensembles, ensemble_names(configs), method_names(configs), rows, strict=True
    ):
        about: dict[str, Any] = {"path": found.name(artefact), "name": name, "seed": artefact.seed}
        about["members"] = artefact.config["members"]
        if any("rooms" in row for row in own):
            about |= {"method": method, "groups": groups_of(artefact.config)}
        named.append({**about, "sub_goals": own})
    return named


def evaluate_distance(
    found: Found, ensembles: list[dict[str, Any]], arrays: Any, progress: Progress
) -> dict[str, list[dict[str, Any]]]:
    """Spec F3, F4: where the options of each ladder stopped, and how near that is to a true base.

    Returns:
        ``options``: a row per artefact and sub-goal; ``by_ladder`` and ``over_ladders``: over seeds; ``shown``: what
        Figure 5 is drawn of, for each ladder and N the best members of the first seed, whose stops are in the arrays.
    """
    abouts = _ladders_named(found, ensembles)
    executions = {}
    rows = []
    for artefact, about in zip(found.ladders, abouts, strict=True):
        config, path = artefact.config, found.name(artefact)
        own = executions[path] = read_executions(artefact.path / "executions.csv")
        if "terminations.h5" in artefact.manifest["files"]:
            for option, states in read_terminations(artefact.path / "terminations.h5").items():
                arrays.create_dataset(f"terminations/{path}/{option}", data=overlay(states), compression="gzip")
        validated = about.pop("validated")
        found_rows = ladder_numbers(
            own, config["sub_goals"], config["members"], validated, masked=config["mask_reached"]
        )
        rows += [{"path": path, "ladder": config["start"], "seed": artefact.seed, **about, **row} for row in found_rows]
        progress.advance()
    names = {artefact.config["domain"] for artefact in found.ladders}
    domain = installed_domain(names.pop()) if len(names) == 1 else None
    used = {row["ladder"] for row in rows}
    starts = [start for start in (domain.starts if domain else ()) if start in used]
    ladders = [*starts, *sorted(used - set(starts))]
    shown = show_stops(rows, ladders, executions, domain, arrays)
    return {"options": rows, **distance_tables(rows, ladders), "shown": shown}


def _ladders_named(found: Found, ensembles: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """Of each ladder's options method and N, those of its ensemble, and the member that validation chooses."""
    by_path = {(found.run / ensemble["path"]).resolve(): ensemble for ensemble in ensembles}
    methods: list[str] = []
    groups: list[int | None] = []
    validated: list[dict[str, int | None]] = []
    sources: list[str | None] = []
    for artefact in found.ladders:
        source = open_artefact(artefact.input("ensemble"), "ensemble")
        known = by_path.get(source.path.resolve(), {})
        oracle = not takes(artefact)
        sources.append(None if oracle else within(found, source))
        methods.append(ORACLE if oracle else known.get("method", ensemble_name(source.config)))
        groups.append(None if oracle else groups_of(source.config))
        validated.append({} if oracle else validated_members(known))
    names = ladder_names(methods, groups, [artefact.config for artefact in found.ladders])
    return [
        {"method": name, "groups": own, "ensemble": path, "validated": member}
        for name, own, path, member in zip(names, groups, sources, validated, strict=True)
    ]


def validated_members(ensemble: Mapping[str, Any]) -> dict[str, int | None]:
    """Per sub-goal the member that the rooms of labelled groups pick."""
    rows = [row for row in ensemble.get("sub_goals", ()) if "rooms" in row]
    return {row["sub_goal"]: row["rooms"]["validated"]["member"] for row in rows}


def read_run(found: Found, artefact: Artefact) -> Run:
    """The episodes and the layout of one trained agent."""
    config = artefact.config
    if artefact.kind != "baseline":
        source = open_artefact(artefact.input("ensemble"), "ensemble")
        config["ensemble"] = ensemble_name(source.config)
    episodes = read_episodes(artefact.path / "episodes.csv")
    layout = read_layout(artefact.path / "layout.json")
    return Run(artefact.kind, found.name(artefact), artefact.seed, config, episodes, layout)


def layouts_of(runs: Iterable[Run]) -> list[dict[str, Any]]:
    """Spec F5: each layout's shortest path and random play's success."""
    by_seed = {run.layout["layout_seed"]: dict(run.layout) for run in runs}
    return [by_seed[seed] for seed in sorted(by_seed)]


def missing(
    found: Found,
    names: list[str],
    rooms: list[dict[str, Any]],
    distance: Mapping[str, list[dict[str, Any]]],
    selection: list[dict[str, Any]],
) -> list[str]:
    """One line for everything of section F that this run has no artefacts for.

    A run with ladders is asked for what Figures 3 to 5 need, one with agents for those that Figure 6 has beside them.
    """
    lines = [] if found.ensembles else ["no ensemble"]
    lines += [f"no truth of {goal} in its domain, to match members with" for goal in _unknown_goals(selection)]
    lines += [f"no executions.csv in {found.name(artefact)}: its domain tells no distance" for artefact in found.silent]
    if rooms or found.ladders:
        lines += missing_ladders(rooms, distance["options"])
    if names:
        lines += missing_agents(names)
    elif not (rooms or found.ladders):
        lines.append("no agents")  # nor anything to compare: which ones Figure 6 has, the report says
    return lines + _unfinished_cells(found.run)


def _unfinished_cells(run: Path) -> list[str]:
    """Of a sweep, the cells that it was to have and has not: failed, or not run yet."""
    if not (run / PLAN).is_file():
        return []
    planned, _ = read_plan(run)
    left = [cell.name for cell in planned.cells if cell.stage not in DERIVED and stamp_of(cell) is None]
    names = ", ".join([*left[:5], *(["..."] if len(left) > 5 else [])])
    return [f"{len(left)} of the sweep's cells are not done: {names}"] if left else []


def _unknown_goals(selection: list[dict[str, Any]]) -> list[str]:
    goals = [goal for agent in selection for run in agent["runs"] for goal in run["sub_goals"]]
    unknown = [goal for goal in goals if all(math.isnan(member["match"]) for member in goal["members"])]
    return list(dict.fromkeys(goal["sub_goal"] for goal in unknown))


def provenance(found: Found, data: list[Path]) -> dict[str, Any]:
    """Spec A8: what everything was made from and with."""
    artefacts = [
        {
            "path": found.name(artefact),
            "kind": artefact.kind,
            "seed": artefact.seed,
            "config": artefact.config,
            "inputs": artefact.manifest["inputs"],
            "command": artefact.manifest.get("command", []),
            "versions": artefact.manifest.get("versions", {}),
        }
        for artefact in (*found.everything(), *found.continued)
    ]
    collected = []
    for path in data:
        dataset = open_dataset(path)
        about = {"path": path.name, "domain": dataset.domain, "config": dataset.config, "counts": dataset.counts()}
        collected.append({**about, "seed": dataset.attributes.get("seed")})
    return {"artefacts": artefacts, "data": collected}
