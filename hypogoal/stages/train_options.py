"""Spec A3: learn every member's option policy while options are chosen at random, for a time or until that succeeds."""

from pathlib import Path
from typing import Any

from hypogoal.cards import create_artefact
from hypogoal.core.artefacts import claim, open_artefact
from hypogoal.core.checkpoints import checkpoints_of
from hypogoal.core.compute import prepare
from hypogoal.core.preflight import preflight
from hypogoal.core.progress import MetricsLog, Progress
from hypogoal.core.tensors import load_tensors
from hypogoal.domains.base import load_domain
from hypogoal.meta.config import TrainOptionsConfig
from hypogoal.meta.training import assemble, check_fit, description, start_arguments, train, write_trained
from hypogoal.needs import play_needs


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
) -> dict[str, Any]:
    """Train the options of an ensemble artefact, or those of ``options`` further, and write the artefact ``out``.

    Returns steps, episodes, and success and length over the last 100 episodes of random choice; where each option
    begins an episode, instead of these two the shares of ``recorder.recent``. With ``until`` also ``ended``: by what.
    """
    device = prepare(device)
    source = open_artefact(ensemble, "ensemble").whole()
    trained = open_artefact(options, "options").whole() if options else None
    if trained:
        check_fit(trained, source, config, ("network", "embedding", "termination", "policy_view", "policy_pixels"))
    inputs = [ensemble, options] if options else [ensemble]
    out = claim(out, kind="options", inputs=inputs, force=force, resume=resume)
    domain = load_domain(source.config["domain"])
    start_arguments(domain, config, 1, seed)  # what cannot be is told before what it would need
    preflight("train-options", out, play_needs(domain, source.config, config), resume=resume, quiet=quiet)
    loop = assemble(domain, source.path, source.config, config, seed, device)
    if trained:
        learned = load_tensors(trained.path / "options.safetensors")
        loop.learner.load(learned)
        loop.terminations.load(learned)
    recorder = loop.recorder
    steps = config.steps * (loop.terminations.options if config.steps_for == "each" else 1)
    about = description(loop, domain, source.config, config, steps=steps)
    with create_artefact(
        out, kind="options", config=about, seed=seed, inputs=inputs, force=force, resume=resume
    ) as folder:
        log = MetricsLog(folder / "metrics.jsonl")
        with Progress("train-options", total=steps, quiet=quiet) as progress:
            solved = train(loop, steps, log, progress, checkpoints_of(folder), config.until)
        if domain.measures and loop.engine.position_names:
            recorder.write_executions(folder, domain.distance)
        write_trained(folder, loop, domain, source.config, config, seed)
        if config.until:
            about |= {"ended_at": recorder.steps, "until_reached": solved}  # the manifest, which comes last, says so
    counted: dict[str, Any] = {"steps": recorder.steps, "episodes": len(recorder.episodes)}
    if config.restart_options:
        counted |= recorder.recent(restarted=True)
    else:
        counted |= {"success": recorder.episodes.success(), "length": recorder.episodes.length()}
    if config.until:
        counted["ended"] = (
            f"by until={config.until:g}" if solved else f"by the limit, until={config.until:g} not reached"
        )
    return counted
