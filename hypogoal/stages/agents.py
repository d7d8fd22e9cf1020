"""What ``train-options``, ``train-meta`` and ``audit`` share: set-up, manifest, training and files."""

from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np

from hypogoal.command.call import Call, Training
from hypogoal.core.artefacts import Artefact, open_artefact, sha256_of
from hypogoal.core.errors import UserError
from hypogoal.core.tensors import save_tensors
from hypogoal.domains.find import load_domain
from hypogoal.domains.world import write_layout
from hypogoal.meta.config import PlayConfig
from hypogoal.meta.nearness import nearness
from hypogoal.meta.setup import Setup
from hypogoal.meta.training import train
from hypogoal.options.choosers import FILE
from hypogoal.options.loop import OptionLoop


def setup_of(call: Call, ensemble: Path, practice: Artefact | None, fixed: Iterable[str]) -> Setup:
    """Return the set-up of an ensemble's options in its domain, with the stage's settings.

    If ``practice``, options that were trained before, is given, its ``fixed`` settings hold. Raises ``UserError`` if
    other values of these settings are typed, or if ``practice`` is of another ensemble.
    """
    source = open_artefact(ensemble, "ensemble")
    held = {}
    if practice:
        require_ensemble(practice, source.path)
        held = {name: practice.config[name] for name in fixed if name in practice.config}
        if practice.config["layouts"]:  # options of many layouts may be played on any layout
            held.pop("layout_seed", None)
    config = call.settings(PlayConfig, source.config["domain"], held)
    settings = config.flat()
    for name, value in held.items():
        wanted = settings.get(name, value)  # a setting of a part is missing if the network lacks the part
        if wanted != value:
            fault = f"these options were trained with {name}={value}, not {wanted}"
            raise UserError(fault, None, f"Give --set {name}={value}, or leave it out.")
    return Setup(
        load_domain(source.config["domain"]),
        source.config,
        source.path,
        config,
        call.seed,
        call.device,
    )


def require_ensemble(trained: Artefact, ensemble: Path) -> None:
    """Raise ``UserError`` if the options ``trained`` are of another ensemble."""
    made_from = [entry.sha256 for entry in trained.manifest.inputs if entry.kind == "ensemble"]
    if sha256_of(ensemble) not in made_from:
        do = f"Train them from {ensemble}."
        raise UserError("these options were trained with another ensemble", trained.path, do)


def description(setup: Setup, **more: Any) -> dict[str, Any]:
    """Return an artefact's configuration: the stage's, what comes from its ensemble's, and ``more``."""
    return setup.config.flat() | {
        "sub_goals": setup.source["sub_goals"],
        "members": setup.members,
        "domain": setup.source["domain"],
        "domain_config": setup.world,
        **more,
        "setting": setup.config.network,
    }


def learn(work: Training, setup: Setup, loop: OptionLoop, steps: int, until: float = 0.0) -> bool:
    """Train for ``steps`` steps, see :func:`.train`, then write what was learned, and what happened meanwhile.

    Returns whether training ended because of ``until``.
    """
    near = nearness(setup, loop.engine)
    if near:  # called once, so that a user's faulty labels fail before training
        near(np.repeat(loop.engine.ids[:1], setup.options), np.arange(setup.options))
    kept = work.draft.checkpoints()
    solved = train(loop, steps, work.log, work.progress, kept, until)
    folder = work.draft.files
    loop.recorder.write(folder)
    if near:
        loop.recorder.write_exploits(folder, near, loop.terminations.log_odds)
    if loop.visited:
        loop.visited.write(folder, setup.source, setup.seed)
    save_tensors(folder / "options.safetensors", loop.learner.state() | loop.terminations.rule.state())
    weights = loop.chooser.state()
    if weights:
        save_tensors(folder / FILE, weights)
    config = setup.config
    layouts = config.layouts.strip()
    if layouts.isdecimal():  # a number of layouts, from ``layout_seed`` on
        last = config.layout_seed + int(layouts) - 1
        layouts = f"{config.layout_seed}-{last}"
    write_layout(folder, loop.engine, config, setup.seed, layouts)
    return solved
