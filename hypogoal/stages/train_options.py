"""Spec A3: learn every member's option policy while options are chosen at random."""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from hypogoal.core.artefacts import claim, create_artefact, open_artefact
from hypogoal.core.compute import prepare
from hypogoal.core.config import as_dict, setting
from hypogoal.core.progress import MetricsLog, Progress
from hypogoal.core.seeding import rng_for
from hypogoal.core.tensors import save_tensors
from hypogoal.domains.base import load_domain
from hypogoal.meta.playing import PlayConfig, build, layout_facts, play
from hypogoal.options.execution import OptionLoop, RandomChooser
from hypogoal.options.recording import Recorder


@dataclass(frozen=True)
class TrainOptionsConfig(PlayConfig):
    """How the options are learned, and for how long."""

    steps: int = setting(60_000, "environment steps, all environments together", unit="steps", low=1)


def train_options(
    ensemble: Path,
    config: TrainOptionsConfig,
    out: Path,
    *,
    seed: int = 0,
    force: bool = False,
    quiet: bool = False,
    device: str = "auto",
) -> dict[str, Any]:
    """Train the options of an ensemble artefact and write the artefact ``out``.

    Returns:
        Steps, episodes, and success and length over the last 100 episodes of random choice.
    """
    prepare(device)
    source = open_artefact(ensemble, "ensemble")
    claim(out, force=force)
    domain = load_domain(source.config["domain"])
    engine, verdicts, learner = build(domain, source.path, source.config, config, seed)
    members = verdicts.options // len(source.config["sub_goals"])
    about = as_dict(config) | {
        "sub_goals": source.config["sub_goals"],
        "members": members,
        "domain": domain.name,
        "domain_config": source.config["domain_config"],
        "chooser": "random",
        "setting": config.network,
    }
    with create_artefact(out, kind="options", config=about, seed=seed, inputs=[ensemble], force=force) as folder:
        recorder = Recorder(verdicts.options)
        chooser = RandomChooser(rng_for(seed, "random-choice"))
        loop = OptionLoop(engine, verdicts, learner, chooser, recorder, config, gamma=1.0)
        log = MetricsLog(folder / "metrics.jsonl")
        with Progress("train-options", total=config.steps, quiet=quiet) as progress:
            play(loop, config.steps, log, progress)
        log.close()
        recorder.write(folder, engine.images)
        save_tensors(folder / "options.safetensors", learner.state())
        (folder / "layout.json").write_text(json.dumps(layout_facts(engine, config, seed)) + "\n", encoding="utf-8")
    return {
        "steps": recorder.steps,
        "episodes": len(recorder.episodes),
        "success": recorder.success(),
        "length": recorder.length(),
    }
