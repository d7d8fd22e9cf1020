"""Figure 6: agents on layouts of three-key DoorKey, with their controls and baselines (Spec E4, E6, E7)."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from math import prod
from pathlib import Path
from typing import Any

from hypogoal.core.config import STAGES as STAGES
from hypogoal.core.config import setting
from hypogoal.core.errors import UserError
from hypogoal.domains.base import load_domain
from hypogoal.experiments.cells import Cell, Cost, closing_cells, stage_cell, with_common
from hypogoal.learners.baselines.settings import DQNSettings, hyperparameters
from hypogoal.needs import BASE, LOGS, baseline_needs, ensemble_disk, ensemble_process, play_needs

DOMAIN = "doorkey"
DECIDED = {"layout_seed": "layout_seeds", "agent": "baselines"}  # settings of stages, and which of the run's they are

# What things cost on one core of the machine of docs/performance.md: seconds per environment step, per gradient step of
# a member (all five sub-goals), per ensemble that is evaluated.
PER_STEP = {"light": 0.8e-3, "paper": 65e-3}
PER_BASELINE_STEP = {"ppo-paper": 1.5e-3, "dqn-paper": 1.7e-3, "ppo-tuned": 0.45e-3, "dqn-tuned": 0.3e-3}
PER_MEMBER_STEP = 0.15
PER_COLLECTION = 15.0
PER_EVALUATION = 20.0


@dataclass(frozen=True)
class RunConfig:
    """Which cells the experiment has."""

    layout_seeds: tuple[int, ...] = setting(
        (100,), "layouts, each with an agent of its own", source="paper, Figure 6", low=0
    )
    seeds: tuple[int, ...] = setting((0,), "run seeds, each with an ensemble of its own", low=0)
    paired: bool = setting(
        False,
        "the first layout with the first seed, the second with the second, instead of all with all",
        source="paper, Figure 6",
    )
    pretrain: bool = setting(True, "train-options before train-meta; false is the paper's D5")
    controls: tuple[str, ...] = setting(
        ("random", "oracle"), "controls beside the agent", source="ours: controls", choices=("random", "oracle")
    )
    baselines: tuple[str, ...] = setting(
        ("ppo-paper", "ppo-tuned", "dqn-paper", "dqn-tuned"),
        "agents on the primitive actions",
        source="paper, Figure 6",
        choices=("ppo-paper", "ppo-tuned", "dqn-paper", "dqn-tuned"),
    )
    workers: int = setting(0, "cells at once; 0 for one per core", low=0, high=1024)


def _cases(config: RunConfig) -> list[tuple[int, int]]:
    """Layout seed and run seed of each agent."""
    layouts, seeds = config.layout_seeds, config.seeds
    if not config.paired:
        return [(layout, seed) for layout in layouts for seed in seeds]
    if len(layouts) != len(seeds):
        raise UserError(
            f"{len(layouts)} layouts cannot be paired with {len(seeds)} seeds",
            "layout_seeds",
            "Give as many of both, or paired=false for every layout with every seed.",
        )
    return list(zip(layouts, seeds, strict=True))


def cells(
    out: Path,
    config: RunConfig,
    resolved: Mapping[str, Any],
    common: Mapping[str, tuple[str, ...]],
    *,
    short: bool = False,
) -> list[Cell]:
    """The cells of a run.

    Args:
        out: the run's folder.
        config: which cells.
        resolved: by stage, its configuration.
        common: by stage, the arguments that brought that configuration about.
        short: where there is one agent only, leave its seed and layout out of names.

    Raises:
        UserError: layouts and seeds are to be paired and differ in number.
    """
    cases = _cases(config)
    domain = load_domain(DOMAIN)
    single = short and len(cases) == 1
    data = out / "data.h5"
    ensemble, play = resolved["train-ensemble"], resolved["train-meta"]
    states: int = domain.collected_bytes(resolved["collect"])
    taught: int = domain.collected_bytes(replace(resolved["collect"], heldout_layouts=0))
    collecting = Cost(PER_COLLECTION, BASE + 2 * states, states)
    planned = [stage_cell(data, out, ("collect", DOMAIN, *common["collect"]), cost=collecting)]
    goals = len(ensemble.sub_goals or domain.sub_goals)
    about = {"sub_goals": ensemble.sub_goals or domain.sub_goals, "members": ensemble.members}
    played = play_needs(domain, about, play)
    spent = resolved["train-options"].steps if config.pretrain else 0
    steps = spent + play.steps
    budget = str(steps)
    agents: list[Path] = []

    def add(
        name: str, arguments: Sequence[str], seed: int, layout: int | None, needs: tuple[Path, ...], cost: Cost
    ) -> Path:
        place = name if single else f"{name}/seed-{seed}" if layout is None else f"{name}/layout-{layout}-seed-{seed}"
        at = ("--seed", str(seed), *(("--layout-seed", str(layout)) if layout is not None else ()))
        axes: dict[str, str | int | float] = {"agent": name, "seed": seed}
        axes |= {} if layout is None else {"layout_seed": layout}
        planned.append(stage_cell(out / place, out, (*with_common(arguments, common), *at), needs, cost, axes))
        return out / place

    process = ensemble_process(taught, ensemble.members)
    seconds = PER_MEMBER_STEP * ensemble.members * ensemble.steps
    training = Cost(seconds, process, ensemble_disk(goals, ensemble.members), min(ensemble.workers or goals, goals))
    ensembles = {
        seed: add("ensemble", ("train-ensemble", str(data)), seed, None, (data,), training) for seed in config.seeds
    }
    for layout, seed in cases:
        source = ensembles[seed]
        extra: tuple[str, ...] = ()
        needs: tuple[Path, ...] = (source,)
        if config.pretrain:
            options = add(
                "options",
                ("train-options", str(source)),
                seed,
                layout,
                (source,),
                Cost(spent * PER_STEP[play.network], *played),
            )
            extra, needs = ("--options", str(options)), (source, options)
        costs = Cost(play.steps * PER_STEP[play.network], *played)
        agents.append(add("meta", ("train-meta", str(source), *extra), seed, layout, needs, costs))
    for control in config.controls:
        change = "chooser=random" if control == "random" else "termination=oracle"
        for layout, seed in cases:
            arguments = ("train-meta", str(ensembles[seed]), "--set", change, "--set", f"steps={budget}")
            costs = Cost(steps * PER_STEP[play.network], *played)
            agents.append(add(f"meta-{control}", arguments, seed, layout, (ensembles[seed],), costs))
    for baseline in config.baselines:
        agent, _, kind = baseline.partition("-")
        for layout, seed in cases:
            played_by = ("--data", str(data), "--agent", agent, "--set", f"setting={kind}", "--set", f"steps={budget}")
            picture = prod(domain.observation_shape)
            chosen = hyperparameters(agent, kind)
            kept = chosen.replay if isinstance(chosen, DQNSettings) else 0
            costs = Cost(steps * PER_BASELINE_STEP[baseline], *baseline_needs(picture, kept))
            agents.append(add(baseline, ("train-baseline", DOMAIN, *played_by), seed, layout, (data,), costs))
    evaluating = Cost(PER_EVALUATION * len(ensembles), BASE + 300e6 + 2 * states, 2 * LOGS)
    return planned + closing_cells(out, (*ensembles.values(), *agents), evaluating)
