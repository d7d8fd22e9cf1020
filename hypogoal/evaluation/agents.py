"""Runs put together into named agents, and each agent's numbers over its layouts and seeds (Spec E6, E7, F5)."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from hypogoal.core.seeding import rng_for
from hypogoal.evaluation.curves import Episodes, curves, run_numbers
from hypogoal.evaluation.naming import name_apart
from hypogoal.evaluation.statistics import aggregate

LEARNED = "options (learned members)"
RANDOM = "random choice"
ORACLE = "oracle terminations"
ORACLE_RANDOM = "oracle terminations, random choice"
PRETRAINING = "random choice while options learn"
BASELINES = ("PPO tuned", "PPO paper", "DQN tuned", "DQN paper")
ORDER = (LEARNED, RANDOM, PRETRAINING, ORACLE, ORACLE_RANDOM, *BASELINES)

UNITS = {
    "success": "share of episodes",
    "reward": "undiscounted, per episode",
    "length": "steps",
    "length_over_shortest": "ratio to the layout's shortest path",
    "discounted_return": "reward discounted by 0.99 per step",
}


@dataclass(frozen=True)
class Run:
    """One trained agent.

    Attributes:
        kind: options, meta or baseline.
        path: of its artefact, relative to the run's folder.
        seed: of the training.
        config: its resolved settings, with those of its ensemble that matter.
        episodes: its training episodes.
        layout: layout_seed, shortest_path, random_success, random_episodes.
    """

    kind: str
    path: str
    seed: int
    config: Mapping[str, Any]
    episodes: Episodes
    layout: Mapping[str, Any]

    @property
    def budget(self) -> int:
        """Environment steps, those of earlier stages included."""
        return int(self.config["steps"]) + int(self.config.get("options_steps", 0))


def base_name(kind: str, config: Mapping[str, Any]) -> str:
    """Spec E6, E7: what an agent is called by how it chooses and what ends its options."""
    if kind == "baseline":
        return f"{config['agent'].upper()} {config['setting']}"
    if kind == "options":
        return PRETRAINING
    if config["termination"] == "oracle":
        return ORACLE_RANDOM if config["chooser"] == "random" else ORACLE
    return RANDOM if config["chooser"] == "random" else LEARNED


def group_runs(runs: Sequence[Run]) -> dict[str, list[Run]]:
    """Runs by the name of their agent, in the order of ``ORDER``.

    Runs of the same name whose settings differ (the layout aside) are different agents: what differs is added to
    the name, so that nothing is averaged that should not be.
    """
    bases = [base_name(run.kind, run.config) for run in runs]
    names = name_apart(bases, [run.config for run in runs])
    groups: dict[str, list[Run]] = {}
    for _, name, run in sorted(zip(map(_rank, bases), names, runs, strict=True), key=lambda item: (item[0], item[1])):
        groups.setdefault(name, []).append(run)
    return groups


def _rank(base: str) -> int:
    return ORDER.index(base) if base in ORDER else len(ORDER)


def agent_metrics(name: str, runs: Sequence[Run]) -> dict[str, Any]:
    """Spec F5: each run's numbers and, for each number, what is said of it over runs.

    Returns:
        name, kind, runs (rows of numbers), one entry per key of ``UNITS`` (see ``statistics.aggregate``), and
        ``steps_to_95``: how many of the runs reached it, and the median over all runs, None where half did not.
    """
    rows = []
    for run in runs:
        shortest = run.layout.get("shortest_path")
        numbers = run_numbers(run.episodes, shortest)
        rows.append(
            {
                "path": run.path,
                "seed": run.seed,
                "layout_seed": run.layout["layout_seed"],
                "shortest_path": shortest,
                "steps": run.budget,
                **numbers,
            }
        )
    layouts = [row["layout_seed"] for row in rows]
    metrics: dict[str, Any] = {"name": name, "kind": runs[0].kind, "runs": rows}
    for key, unit in UNITS.items():
        rng = rng_for(0, "bootstrap", name, key)
        metrics[key] = aggregate([row[key] for row in rows], layouts, unit, rng)
    reached = [np.inf if row["steps_to_95"] is None else float(row["steps_to_95"]) for row in rows]
    median = float(np.quantile(reached, 0.5, method="higher"))
    metrics["steps_to_95"] = {
        "reached": int(np.isfinite(reached).sum()),
        "median": median if np.isfinite(median) else None,
        "n": len(rows),
        "unit": "environment steps",
    }
    return metrics


def agent_curves(runs: Sequence[Run], grid: NDArray[np.int64]) -> dict[str, NDArray[np.float64]]:
    """Figure 6: reward, success and length of every run on the common grid, each (R, G); NaN beyond a run's budget."""
    found = []
    for run in runs:
        own = curves(run.episodes, grid)
        found.append({key: np.where(grid <= run.budget, values, np.nan) for key, values in own.items()})
    return {key: np.stack([own[key] for own in found]) for key in found[0]}


def common_grid(runs: Sequence[Run], points: int = 151) -> NDArray[np.int64]:
    """Environment steps from 0 to the largest budget, int64 (G,)."""
    return np.linspace(0, max(run.budget for run in runs), points).round().astype(np.int64)


def missing_agents(names: Sequence[str]) -> list[str]:
    """Spec E6, E7: the comparisons that are not there, so that nothing is silently left out."""
    lines = []
    for wanted in (LEARNED, RANDOM, ORACLE, *BASELINES):
        if not any(name == wanted or name.startswith(f"{wanted}, ") for name in names if name != ORACLE_RANDOM):
            lines.append(f"no agent '{wanted}'")
    return lines
