"""Spec F6 over a run: which members each agent chose, against how well each knows its sub-goal on that layout."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from hypogoal.core.artefacts import Artefact, open_artefact
from hypogoal.core.progress import Progress
from hypogoal.core.seeding import rng_for
from hypogoal.domains.base import Engine, load_domain, step_of
from hypogoal.evaluation.accuracy import member_scores
from hypogoal.evaluation.agents import LEARNED, PRETRAINING, RANDOM, Run, base_name
from hypogoal.evaluation.choices import over_training, selection_of_run
from hypogoal.evaluation.examples import overlay
from hypogoal.evaluation.found import Found, within
from hypogoal.evaluation.reading import read_choices, read_terminations
from hypogoal.evaluation.statistics import aggregate
from hypogoal.hypotheses.storage import read_ensemble

SELECTED = (LEARNED, RANDOM, PRETRAINING)  # agents whose options are members: the others have nothing to select


def evaluate_selection(
    found: Found, groups: Mapping[str, list[Run]], arrays: Any, progress: Progress
) -> list[dict[str, Any]]:
    """Spec F6: for each agent whose options are members: choices against match, per run and over runs."""
    matches: dict[tuple[Path, int], NDArray[np.float64]] = {}
    metrics = []
    for name, same in groups.items():
        rows = []
        for run in same:
            progress.advance()
            if base_name(run.kind, run.config) not in SELECTED:
                continue
            artefact = open_artefact(found.run / run.path)
            source = open_artefact(artefact.input("ensemble"), "ensemble")
            key = (source.path, run.layout["layout_seed"])
            if key not in matches:
                matches[key] = match_on_layout(source, run.layout["layout_seed"])
            choices = read_choices(artefact.path / "choices.csv")
            row = selection_of_run(choices, matches[key], run.config["sub_goals"], run.config["members"])
            for option, states in read_terminations(artefact.path / "terminations.h5").items():
                place = f"terminations/{run.path}/{option}"
                arrays[place] = overlay(states)
                arrays[place].attrs["states"] = len(states)
            for column, counts in over_training(choices, len(run.config["sub_goals"]) * run.config["members"]).items():
                arrays[f"choices/{run.path}/{column}"] = counts
            about = {"path": run.path, "seed": run.seed, "layout_seed": run.layout["layout_seed"]}
            about["ensemble"] = within(found, source)
            rows.append({**about, **row})
        if rows:
            metrics.append({"name": name, "runs": rows, "rank_correlation": _over_runs(name, rows)})
    return metrics


def match_on_layout(source: Artefact, layout_seed: int) -> NDArray[np.float64]:
    """Spec F6: every member's balanced accuracy on the states of a layout, float (G*K,).

    NaN where the domain does not have the sub-goal, which the user's own labels told: its truth there is not known.
    """
    domain = load_domain(source.config["domain"])
    engine = domain.make_engine(layout_seed, 1, 500, **domain.world(source.config["domain_config"]))
    ids = states_of_layout(engine)
    images, labels = engine.images(ids), engine.labels(ids)
    known_goals = list(domain.sub_goals)
    match = []
    for sub_goal in source.config["sub_goals"]:
        if sub_goal not in known_goals:
            match.append(np.full(source.config["members"], np.nan))
            continue
        ensemble = read_ensemble(source.path, source.config, sub_goal)
        verdicts = ensemble.verdicts(images, engine.positions(ids) if ensemble.needs_positions else None)
        match.append(member_scores(verdicts, labels[:, known_goals.index(sub_goal)])["balanced_accuracy"])
    return np.concatenate(match)


def states_of_layout(engine: Engine, steps: int = 2_000) -> NDArray[np.int64]:
    """The states of a fresh engine's layout: those that can be reached, or, where nobody knows them, what so many
    steps of random play meet; each once.
    """
    if (known := engine.reachable()) is not None:
        return known
    rng = rng_for(0, "states-of-layout")
    met = [
        step_of(engine, rng.integers(engine.n_actions, size=engine.count)).next_ids
        for _ in range(steps // engine.count)
    ]
    return np.unique(np.concatenate([engine.ids, *met]))


def _over_runs(name: str, rows: list[dict[str, Any]]) -> dict[str, Any]:
    layouts = [row["layout_seed"] for row in rows]
    return {
        quantity: {
            scope: aggregate(
                [row["rank_correlation"][quantity][scope] for row in rows],
                layouts,
                "Spearman's rho",
                rng_for(0, "bootstrap", name, quantity, scope),
            )
            for scope in ("all", "within")
        }
        for quantity in ("preference", "late_preference", "share")
    }
