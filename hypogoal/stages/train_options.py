"""Spec A3: learn every member's option policy while options are chosen at random, for a time or until that succeeds."""

from pathlib import Path
from typing import Any

from hypogoal.core.artefacts import open_artefact
from hypogoal.core.processes import prepare
from hypogoal.core.training import training
from hypogoal.domains.base import load_domain
from hypogoal.meta.config import TrainOptionsConfig
from hypogoal.meta.training import (
    assemble,
    check_fit,
    continue_with,
    description,
    distances_of,
    options_of,
    start_arguments,
    train,
    write_trained,
)

# As of the options trained before.
FIXED = ("network", "recurrence", "embedding", "termination")


def train_options(
    ensemble: Path,
    config: TrainOptionsConfig,
    out: Path,
    *,
    options: Path | None = None,
    seed: int = 0,
    force: bool = False,
    resume: bool = False,
    quiet: bool = False,
    device: str = "auto",
    tensorboard: Path | None = None,
) -> dict[str, Any]:
    """Train the options of an ensemble artefact, or train ``options`` further, and write the artefact ``out``.

    ``tensorboard``, a folder, gets the numbers of the log.
    Returns steps, episodes, and success and length over the last 100 episodes of random choice; where each option
    begins an episode, instead of these two the shares of ``recorder.recent``. With ``until`` also ``ended``: by what.
    """
    device = prepare(device)
    source = open_artefact(ensemble, "ensemble")
    practice = open_artefact(options, "options") if options else None
    if practice:
        check_fit(practice, source, config, FIXED)
    inputs = [ensemble, options] if options else [ensemble]
    domain = load_domain(source.config["domain"])
    start_arguments(domain, config, 1, seed)  # refuse an impossible start before any work
    steps = config.steps * (options_of(source.config, config) if config.steps_for == "each" else 1)
    settings = description(domain, source.config, config, steps=steps)
    artefact: dict[str, Any] = {"kind": "options", "config": settings, "seed": seed, "inputs": inputs, "force": force}
    how: dict[str, Any] = {"steps": steps, "quiet": quiet, "resume": resume, "tensorboard": tensorboard}
    with training("train-options", out, **how, **artefact) as work:
        loop = assemble(domain, source.path, source.config, config, seed, device)
        if practice:
            continue_with(loop, practice)
        recorder = loop.recorder
        solved = train(loop, steps, work.log, work.progress, work.checkpoints, config.until)
        if domain.measures and loop.engine.position_names:
            sub_goals = source.config["sub_goals"]
            each = options_of(source.config, config) // len(sub_goals)
            recorder.write_executions(work.folder, distances_of(domain, sub_goals, each))
        write_trained(work.folder, loop, domain, source.config, config, seed)
        if config.until:
            settings |= {"ended_at": recorder.steps, "until_reached": solved}  # for the manifest, which comes last
    recent = recorder.recent(restarted=True) if config.restart_options else recorder.episodes.recent()
    counts: dict[str, Any] = {**recorder.episodes.counts(), **recent}
    if config.until:
        goal = f"until={config.until:g}"
        counts["ended"] = f"by {goal}" if solved else f"by the limit, {goal} not reached"
    return counts
