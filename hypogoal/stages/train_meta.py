"""Spec A4, D5, E: learn the meta-policy over all options while their policies go on learning.

Without ``--options`` the policies start fresh (the paper's D5); with it they continue, and the steps already spent
count in every curve.
"""

from pathlib import Path
from typing import Any

from hypogoal.core.artefacts import Artefact, open_artefact
from hypogoal.core.processes import prepare
from hypogoal.core.training import training
from hypogoal.domains.base import load_domain
from hypogoal.meta.config import TrainMetaConfig
from hypogoal.meta.training import (
    assemble,
    check_fit,
    continue_with,
    description,
    start_arguments,
    train,
    write_trained,
)
from hypogoal.options.tables import Episodes

FIXED = (  # as of the options trained before
    *("network", "recurrence", "embedding", "termination"),
    *("layout_seed", "start", "option_timeout"),
)
WORLD = ("domain_config", "cap", "max_episode_steps")  # where these differ, the agent does not count practice episodes


def train_meta(
    ensemble: Path,
    config: TrainMetaConfig,
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
    """Train the meta-policy over an ensemble's options, or over these ``options``, and write the artefact ``out``.

    ``tensorboard``, a folder, gets the numbers of the log.
    Returns steps, episodes, and success and length over the last 100 episodes.
    """
    device = prepare(device)
    source = open_artefact(ensemble, "ensemble")
    practice = open_artefact(options, "options") if options else None
    if practice:
        check_fit(practice, source, config, FIXED)
    inputs = [ensemble, options] if options else [ensemble]
    domain = load_domain(source.config["domain"])
    start_arguments(domain, config, 1, seed)  # refuse an impossible start before any work
    settings = description(domain, source.config, config, **steps_spent(practice))
    artefact: dict[str, Any] = {"kind": "meta", "config": settings, "seed": seed, "inputs": inputs, "force": force}
    how: dict[str, Any] = {"steps": config.steps, "quiet": quiet, "resume": resume, "tensorboard": tensorboard}
    with training("train-meta", out, **how, **artefact) as work:
        loop = assemble(domain, source.path, source.config, config, seed, device)
        recorder = loop.recorder
        if practice:
            continue_with(loop, practice)
            recorder.start_at(practice.config.get("ended_at", practice.config["steps"]))
            if all(practice.config[key] == settings[key] for key in WORLD):
                recorder.episodes.extend(Episodes.read(practice.path / Episodes.FILE).rows())
        train(loop, config.steps, work.log, work.progress, work.checkpoints)
        write_trained(work.folder, loop, domain, source.config, config, seed)
    return recorder.episodes.counts() | recorder.episodes.recent()


def steps_spent(practice: Artefact | None) -> dict[str, int]:
    """Steps of ``train-options``, for the manifest: as many as were asked for, and where it ended before."""
    if practice is None:
        return {"options_steps": 0}
    ended = {"options_ended_at": practice.config["ended_at"]} if "ended_at" in practice.config else {}
    return {"options_steps": practice.config["steps"], **ended}
