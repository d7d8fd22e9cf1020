"""What ``train-options``, ``train-meta`` and ``audit`` share: their settings, their manifest, training, files."""

from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from hypogoal.core.artefacts import Artefact, sha256_of
from hypogoal.core.errors import UserError
from hypogoal.core.tensors import save_tensors
from hypogoal.evaluation.nearness import Near, nearness
from hypogoal.learners.world import write_layout
from hypogoal.meta.training import Setup, train
from hypogoal.options.choosers import FILE
from hypogoal.options.loop import OptionLoop
from hypogoal.stages import Call, Training


def settings_of(call: Call, source: Artefact, practice: Artefact | None, fixed: Iterable[str]) -> Any:
    """The stage's settings. Of options of an artefact, trained further, the ``fixed`` ones hold.

    Where other ones are typed, or these options are of another ensemble, it is a ``UserError``.
    """
    if practice is None:
        return call.settings(source.config["domain"])
    before = practice.config
    hold = {name: before[name] for name in fixed if name in before}
    if before["layouts"]:  # options of many layouts may be played in any
        hold.pop("layout_seed", None)
    config = call.settings(source.config["domain"], hold)
    made_from = [entry.sha256 for entry in practice.manifest.inputs if entry.kind == "ensemble"]
    if sha256_of(source.path) not in made_from:
        fault = "these options were trained with another ensemble"
        raise UserError(fault, practice.path, f"Train them from {source.path}.")
    for name, value in hold.items():
        wanted = getattr(config, name, value)  # a part's, where the network has that part
        if wanted != value:
            fault = f"these options were trained with {name}={value}, not {wanted}"
            raise UserError(fault, practice.path, f"Give --set {name}={value}, or leave it out.")
    return config


def description(setup: Setup, **more: Any) -> dict[str, Any]:
    """An artefact's configuration: the stage's, what it takes from its ensemble's, and ``more``."""
    return setup.config.model_dump(mode="json") | {
        "sub_goals": setup.source["sub_goals"],
        "members": setup.members,
        "domain": setup.source["domain"],
        "domain_config": setup.world,
        **more,
        "setting": setup.config.network,
    }


def learn(work: Training, setup: Setup, loop: OptionLoop, steps: int, until: float = 0.0) -> bool:
    """Train for so many steps, see :func:`.train`, then write what was learned, and what happened meanwhile."""
    near = nearness(setup, loop.engine)
    if near:  # so that a user's labels fail before training
        near(np.repeat(loop.engine.ids[:1], setup.options), np.arange(setup.options))
    solved = train(loop, steps, work.log, work.progress, work.draft.checkpoints(), until)
    _write(work.draft.files, setup, loop, near)
    return solved


def _write(folder: Path, setup: Setup, loop: OptionLoop, near: Near | None) -> None:
    config = setup.config
    loop.recorder.write(folder)
    if near:
        loop.recorder.write_exploits(folder, near, loop.terminations.log_odds)
    if loop.visited:
        loop.visited.write(folder, setup.domain, setup.source, setup.seed)
    save_tensors(folder / "options.safetensors", loop.learner.state() | loop.terminations.state())
    weights: Mapping[str, Any] = loop.chooser.state()
    if weights:
        save_tensors(folder / FILE, weights)
    layouts = config.layouts.strip()
    if layouts.isdecimal():
        layouts = f"{config.layout_seed}-{config.layout_seed + int(layouts) - 1}"
    write_layout(folder, loop.engine, config, setup.seed, layouts)
