"""Spec A1, B3: collect labelled, unlabelled and held-out states of a domain into an HDF5 file."""

from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from hypogoal.core.artefacts import DATA, claim, versions
from hypogoal.core.checkpoints import checkpoints_of
from hypogoal.core.config import as_dict
from hypogoal.core.drafts import check_complete, draft, put_in_place, unfinished
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
    requested, out = out, claim(out, kind=DATA, force=force, resume=resume)
    identity: dict[str, Any] = {"domain": name or domain.name, "config": as_dict(config), "seed": seed}
    if resume and out.exists() and not unfinished(out):
        existing = open_dataset(out)
        before = {"domain": existing.domain, "config": existing.config, "seed": existing.seed}
        raise check_complete(before, identity, requested)
    if domain.doubt:
        say(f"hypogoal: {domain.doubt}", err=True)
    with draft(out, {"kind": "data", **identity, "versions": versions()}, force=force, resume=resume) as work:
        kept = {"kept": partial(checkpoints_of, work.files)} if domain.resumes else {}
        with Progress(f"collect {identity['domain']}", total=1, quiet=quiet) as progress:
            collected = domain.collect(config, seed, progress, **kept)
        file = work.files / out.name
        write_dataset(file, collected, **identity, force=True)
        put_in_place(file, out)
    if identity["domain"] not in BUILT_IN:
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
