"""Spec A5, F: every number of the report, from whatever artefacts a run has; what is missing is named."""

from __future__ import annotations

import json
import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from hypogoal.core.artefacts import Artefact, claim, create_artefact, find_artefacts, open_artefact
from hypogoal.core.compute import prepare
from hypogoal.core.errors import UserError
from hypogoal.core.progress import Progress
from hypogoal.core.seeding import rng_for
from hypogoal.dataset import Split, open_dataset
from hypogoal.domains.base import load_domain
from hypogoal.evaluation.accuracy import member_scores
from hypogoal.evaluation.agents import (
    LEARNED,
    PRETRAINING,
    RANDOM,
    Run,
    agent_curves,
    agent_metrics,
    base_name,
    common_grid,
    group_runs,
    missing_agents,
)
from hypogoal.evaluation.choices import selection_of_run
from hypogoal.evaluation.curves import GAMMA, SOLVED, WINDOW
from hypogoal.evaluation.ensembles import ensemble_name, ensemble_names, hypotheses_table, sub_goal_metrics
from hypogoal.evaluation.examples import overlay, pick_examples
from hypogoal.evaluation.quantities import QUANTITIES
from hypogoal.evaluation.reading import read_choices, read_episodes, read_layout, read_terminations
from hypogoal.evaluation.statistics import aggregate
from hypogoal.evaluation.summary import hypotheses_summary, summary_table
from hypogoal.hypotheses.storage import read_ensemble
from hypogoal.options.verdicts import THRESHOLD

__all__ = ["evaluate", "hypotheses_summary", "summary_table"]

SELECTED = (LEARNED, RANDOM, PRETRAINING)  # agents whose options are members: the others have nothing to select
SETTINGS = {"window": WINDOW, "solved": SOLVED, "gamma": GAMMA, "threshold": THRESHOLD}


@dataclass(frozen=True)
class Found:
    """The artefacts of a run that are evaluated."""

    run: Path
    ensembles: list[Artefact]
    agents: list[Artefact]

    def name(self, artefact: Artefact) -> str:
        """Its path within the run."""
        return artefact.path.relative_to(self.run).as_posix()


def evaluate(run: Path, out: Path, *, force: bool = False, quiet: bool = False) -> dict[str, Any]:
    """Compute every number of the report and write the artefact ``out``: ``metrics.json`` and ``arrays.h5``.

    Args:
        run: a folder with ensemble, options, meta and baseline artefacts, any of them.
        out: the artefact to write.
        force, quiet: as for every stage.

    Returns:
        What ``metrics.json`` holds, see ``evaluation/quantities.py``.

    Raises:
        UserError: nothing to evaluate, a damaged artefact, or ``out`` exists.
    """
    import h5py

    prepare()
    claim(out, force=force)
    found = find(run)
    inputs = [artefact.path for artefact in (*found.ensembles, *found.agents)]
    data = sorted({artefact.input("data") for artefact in found.ensembles})
    with create_artefact(
        out, kind="evaluation", config=SETTINGS, seed=0, inputs=[*data, *inputs], force=force
    ) as folder:
        with (
            h5py.File(folder / "arrays.h5", "w") as arrays,
            Progress("evaluate", total=len(inputs), quiet=quiet) as progress,
        ):
            runs = [read_run(found, artefact) for artefact in found.agents]
            groups = group_runs(runs)
            agents = [agent_metrics(name, same) for name, same in groups.items()]
            if runs:
                write_curves(arrays, groups)
            selection = evaluate_selection(found, groups, arrays, progress)
            ensembles = evaluate_ensembles(found, arrays, progress)
        metrics = {
            "run": found.run.resolve().name,
            "settings": SETTINGS,
            "missing": missing(found, list(groups)),
            "agents": agents,
            "layouts": layouts_of(runs),
            "hypotheses": hypotheses_table(ensembles),
            "ensembles": ensembles,
            "selection": selection,
            "provenance": provenance(found, data),
            "quantities": QUANTITIES,
        }
        metrics = plain(metrics)
        text = json.dumps(metrics, indent=1, allow_nan=False)
        (folder / "metrics.json").write_text(text + "\n", encoding="utf-8")
    return metrics


def find(run: Path) -> Found:
    """The artefacts to evaluate: options that a meta artefact continues are part of that one.

    Raises:
        UserError: there is none, or one is damaged.
    """
    metas = find_artefacts(run, "meta")
    continued = {
        (artefact.path / entry["relative"]).resolve()
        for artefact in metas
        for entry in artefact.manifest["inputs"]
        if entry["kind"] == "options"
    }
    options = [artefact for artefact in find_artefacts(run, "options") if artefact.path.resolve() not in continued]
    found = Found(run, find_artefacts(run, "ensemble"), [*metas, *options, *find_artefacts(run, "baseline")])
    if not found.ensembles and not found.agents:
        raise UserError("nothing to evaluate", run, "Train something into it first, see 'hypogoal run --help'.")
    return found


def evaluate_ensembles(found: Found, arrays: Any, progress: Progress) -> list[dict[str, Any]]:
    """Spec F1, F2: every ensemble of the run on its data's held-out and unlabelled states."""
    names = ensemble_names([artefact.config for artefact in found.ensembles])
    metrics = [
        {"path": found.name(artefact), "name": name, "seed": artefact.seed, "members": artefact.config["members"]}
        for artefact, name in zip(found.ensembles, names, strict=True)
    ]
    rows: list[list[dict[str, Any]]] = [[] for _ in metrics]
    sources = [artefact.input("data") for artefact in found.ensembles]
    for path in sorted(set(sources)):
        dataset = open_dataset(path)
        unlabelled = dataset.unlabelled()
        for sub_goal in dataset.sub_goals:
            split = dataset.heldout(sub_goal)  # read once for all ensembles: it is the largest thing here
            for index, artefact in enumerate(found.ensembles):
                if sources[index] == path and sub_goal in artefact.config["sub_goals"]:
                    examples = arrays.create_group(f"examples/{sub_goal}") if index == 0 else None
                    rows[index].append(_evaluate_sub_goal(artefact, sub_goal, split, unlabelled, examples))
    progress.advance(len(metrics))
    return [{**about, "sub_goals": own} for about, own in zip(metrics, rows, strict=True)]


def _evaluate_sub_goal(
    artefact: Artefact, sub_goal: str, split: Split, unlabelled: NDArray[np.uint8], examples: Any
) -> dict[str, Any]:
    ensemble = read_ensemble(artefact.path, artefact.config, sub_goal)
    probabilities = ensemble.predict(split.observations)
    seeds = split.origins.get("layout_seed")
    if examples is not None:
        picked = pick_examples(probabilities, split.labels, threshold=THRESHOLD)
        index = np.array([index for index, _ in picked], dtype=np.int64)
        examples["observations"] = split.observations[index]
        examples["probabilities"] = probabilities[index]
        examples["labels"] = split.labels[index]
        examples["layout_seeds"] = seeds[index] if seeds is not None else np.full(len(index), -1)
        examples["kinds"] = json.dumps([kind for _, kind in picked])
    verdicts = ensemble.predict(unlabelled) > THRESHOLD
    return sub_goal_metrics(sub_goal, probabilities > THRESHOLD, split.labels, seeds, verdicts)


def read_run(found: Found, artefact: Artefact) -> Run:
    """The episodes and the layout of one trained agent."""
    config = artefact.config
    if artefact.kind != "baseline":
        source = open_artefact(artefact.input("ensemble"), "ensemble")
        config["ensemble"] = ensemble_name(source.config)
    episodes = read_episodes(artefact.path / "episodes.csv")
    layout = read_layout(artefact.path / "layout.json")
    return Run(artefact.kind, found.name(artefact), artefact.seed, config, episodes, layout)


def write_curves(arrays: Any, groups: Mapping[str, list[Run]]) -> None:
    """Figure 6: ``curves/grid`` and ``curves/<agent's index>/{reward,success,length}``, float (runs, grid)."""
    grid = common_grid([run for same in groups.values() for run in same])
    arrays["curves/grid"] = grid
    for index, same in enumerate(groups.values()):
        for key, values in agent_curves(same, grid).items():
            arrays[f"curves/{index}/{key}"] = values


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
            about = {"path": run.path, "seed": run.seed, "layout_seed": run.layout["layout_seed"]}
            rows.append({**about, **row})
        if rows:
            metrics.append({"name": name, "runs": rows, "rank_correlation": _over_runs(name, rows)})
    return metrics


def match_on_layout(source: Artefact, layout_seed: int) -> NDArray[np.float64]:
    """Spec F6: every member's balanced accuracy on the reachable states of a layout, float (G*K,)."""
    domain = load_domain(source.config["domain"])
    known = source.config["domain_config"]
    extra = {key: known[key] for key in ("keyring", "door_label") if key in known}
    engine: Any = domain.make_engine(layout_seed, 1, 500, **extra)
    ids = engine.reachable()
    images, labels = engine.images(ids), engine.labels(ids)
    columns = [domain.sub_goals.index(sub_goal) for sub_goal in source.config["sub_goals"]]
    match = []
    for sub_goal, column in zip(source.config["sub_goals"], columns, strict=True):
        verdicts = read_ensemble(source.path, source.config, sub_goal).predict(images) > THRESHOLD
        match.append(member_scores(verdicts, labels[:, column])["balanced_accuracy"])
    return np.concatenate(match)


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


def layouts_of(runs: Iterable[Run]) -> list[dict[str, Any]]:
    """Spec F5: each layout's shortest path and random play's success."""
    by_seed = {run.layout["layout_seed"]: dict(run.layout) for run in runs}
    return [by_seed[seed] for seed in sorted(by_seed)]


def missing(found: Found, names: list[str]) -> list[str]:
    """One line for everything of section F that this run has no artefacts for."""
    lines = [] if found.ensembles else ["no ensemble"]
    return [*lines, *missing_agents(names)]


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
        for artefact in (*found.ensembles, *found.agents)
    ]
    collected = []
    for path in data:
        dataset = open_dataset(path)
        about = {"path": path.name, "domain": dataset.domain, "config": dataset.config, "counts": dataset.counts()}
        collected.append({**about, "seed": dataset.attributes.get("seed")})
    return {"artefacts": artefacts, "data": collected}


def plain(value: Any) -> Any:
    """JSON-ready: NaN becomes null, NumPy numbers become Python's."""
    if isinstance(value, Mapping):
        return {str(key): plain(inner) for key, inner in value.items()}
    if isinstance(value, (list, tuple)):
        return [plain(inner) for inner in value]
    if isinstance(value, np.generic):
        value = value.item()
    if isinstance(value, float) and not math.isfinite(value):
        return None
    return value
