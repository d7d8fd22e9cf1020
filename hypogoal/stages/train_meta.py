"""Spec A4, D5, E: learn the meta-policy over all options while their policies go on learning.

Without ``--options`` the policies start fresh (the paper's D5); with it they continue, and the steps already spent
count in every curve.
"""

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
from hypogoal.evaluation import run as tables
from hypogoal.meta.config import TrainMetaConfig
from hypogoal.meta.training import assemble, check_fit, description, start_arguments, train, write_trained
from hypogoal.needs import play_needs

# As of the options.
FIXED = (
    *("network", "embedding", "termination", "policy_view", "policy_pixels"),
    *("layout_seed", "start", "option_timeout"),
)
WORLD = ("domain_config", "cap", "max_episode_steps")  # where it differs, episodes of practice are none of the agent's


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
) -> dict[str, Any]:
    """Train the meta-policy over an ensemble's options, or over these ``options`` of it, and write the artefact
    ``out``.

    Returns steps, episodes, and success and length over the last 100 episodes.
    """
    device = prepare(device)
    source = open_artefact(ensemble, "ensemble").whole()
    trained = open_artefact(options, "options").whole() if options else None
    if trained:
        check_fit(trained, source, config, FIXED)
    inputs = [ensemble, options] if options else [ensemble]
    out = claim(out, kind="meta", inputs=inputs, force=force, resume=resume)
    domain = load_domain(source.config["domain"])
    start_arguments(domain, config, 1, seed)  # what cannot be is told before what it would need
    preflight("train-meta", out, play_needs(domain, source.config, config), resume=resume, quiet=quiet)
    loop = assemble(domain, source.path, source.config, config, seed, device)
    recorder = loop.recorder
    if trained:
        learned = load_tensors(trained.path / "options.safetensors")
        loop.learner.load(learned)
        loop.terminations.load(learned)
        if loop.initiation and "initiation.safetensors" in trained.manifest["files"]:
            loop.initiation.load(load_tensors(trained.path / "initiation.safetensors"))
        recorder.start_at(trained.config.get("ended_at", trained.config["steps"]))
    spent = {"options_steps": trained.config["steps"] if trained else 0}
    if trained and "ended_at" in trained.config:
        spent["options_ended_at"] = recorder.steps
    about = description(loop, domain, source.config, config, **spent)
    if trained and all(trained.config.get(key, 0.0) == about[key] for key in WORLD):
        recorder.episodes[:] = read_episodes(trained.path / "episodes.csv")
    with create_artefact(
        out, kind="meta", config=about, seed=seed, inputs=inputs, force=force, resume=resume
    ) as folder:
        log = MetricsLog(folder / "metrics.jsonl")
        with Progress("train-meta", total=config.steps, quiet=quiet) as progress:
            train(loop, config.steps, log, progress, checkpoints_of(folder))
        write_trained(folder, loop, domain, source.config, config, seed)
    counted = {"steps": recorder.steps, "episodes": len(recorder.episodes)}
    return counted | {"success": recorder.episodes.success(), "length": recorder.episodes.length()}


def read_episodes(path: Path) -> list[tuple[int, int, float, int, int]]:
    """The rows of an ``episodes.csv``: step, length, reward, terminated, succeeded."""
    table = tables.read_episodes(path)
    columns = (table.step, table.length, table.reward, table.terminated.astype(int), table.succeeded.astype(int))
    return list(zip(*(column.tolist() for column in columns), strict=True))
