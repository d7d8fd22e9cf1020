"""Spec A1, B3: collect labelled, unlabelled and held-out states of a domain into an HDF5 file."""

from pathlib import Path
from typing import Any

import numpy as np

from hypogoal.core.artefacts import DATA, create
from hypogoal.core.config import as_dict
from hypogoal.core.progress import Progress
from hypogoal.core.terminal import say
from hypogoal.data import GET_MORE, hard_to_judge, hard_to_learn, open_dataset, require_names, write_dataset
from hypogoal.domains.base import BUILT_IN, Domain
from hypogoal.options.config import OptionConfig


def collect(
    domain: Domain,
    config: Any,
    out: Path,
    *,
    name: str | None = None,
    seed: int = 0,
    force: bool = False,
    resume: bool = False,
    quiet: bool = False,
) -> dict[str, Any]:
    """Collect ``domain``'s states into the HDF5 file ``out``, with an instance of its ``config_class``.

    ``name``, by default the domain's own, is the one by which later stages find it. ``resume``: continue an unfinished
    output, for domains that can. Returns numbers of states and positives per split and sub-goal.
    """
    require_names(domain.sub_goals)  # before play, not when the file is written
    name, settings = name or domain.name, as_dict(config)
    about = settings | {"domain": name}
    with create(out, kind=DATA, config=about, seed=seed, force=force, resume=resume) as draft:
        if domain.doubt:
            say(f"hypogoal: {domain.doubt}", err=True)
        kept = {"kept": draft.checkpoints} if domain.resumes else {}
        with Progress(f"collect {name}", total=1, quiet=quiet) as progress:
            collected = domain.collect(config, seed, progress, **kept)
        write_dataset(draft.files / out.name, collected, domain=name, config=settings, seed=seed)
    if name not in BUILT_IN:
        warnings = [f"{line}. {GET_MORE}" for line in hard_to_learn(collected.labelled.labels, collected.sub_goals)]
        for line in warnings + hard_to_judge(collected.heldout.labels, collected.sub_goals):
            say(f"hypogoal: {line}", err=True)
        if "step" in collected.labelled.origins and "option_timeout" not in domain.defaults.get("train-options", {}):
            soonest = (collected.labelled.origins["step"][held].min() for held in collected.labelled.labels.T)
            apart = int(np.diff(sorted([0, *soonest])).max())  # of two sub-goals, or the start and one
            if 2 * apart > OptionConfig.option_timeout and not quiet:
                message = f"play took up to {apart} steps from one sub-goal to the next, each at its earliest"
                do = f"train-options --option-timeout {2 * apart} gives options time for that"
                say(f"hypogoal: {message}: {do}", err=True)
    return open_dataset(out).counts()
