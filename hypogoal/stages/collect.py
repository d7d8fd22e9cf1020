"""Spec A1, B3: collect labelled, unlabelled and held-out states of a domain into an HDF5 file."""

from pathlib import Path
from typing import Annotated, Any

from typer import Argument

from hypogoal.core.artefacts import DATA
from hypogoal.core.errors import UserError
from hypogoal.core.progress import Progress
from hypogoal.core.terminal import say
from hypogoal.stages import DOMAINS, NO_TRAINING, Call, Done, stage


@stage("collect doorkey --out data/doorkey.h5", leaves_out=NO_TRAINING)
def collect(call: Call, domain: Annotated[str, Argument(help=DOMAINS)]) -> Done:
    """Collect labelled, unlabelled and held-out states.

    ``domain`` is a name, or in Python a ``Domain``, which later stages find by its own name, in this process only.
    ``out`` is an HDF5 file. ``resume`` keeps a complete one and begins an unfinished one anew.
    """
    from hypogoal.data import open_dataset, require_names, write_dataset
    from hypogoal.domains.base import BUILT_IN, load_domain
    from hypogoal.look import count_lines

    name = _name_of(domain)
    played = load_domain(name)
    require_names(played.sub_goals)  # before play, not when the file is written
    config = call.settings(name)
    settings = config.model_dump(mode="json")
    with call.draft(DATA, settings | {"domain": name}) as draft:
        with Progress(f"collect {name}", total=1, quiet=call.quiet) as progress:
            collected = played.collect(config, call.seed, progress)
        write_dataset(
            draft.files / call.out.name,
            collected,
            domain=name,
            config=settings,
            seed=call.seed,
        )
    if name not in BUILT_IN:
        for line in _doubts(played, collected):
            say(f"hypogoal: {line}", err=True)
    run = call.out.parent if call.out.name == "data.h5" else Path("runs", call.out.stem)
    counts = open_dataset(call.out).counts()
    then = ("train-ensemble", call.out, "--out", run / "ensemble")
    return Done(count_lines(counts), then)


def _name_of(domain: Any) -> str:
    """The name by which later stages find a domain."""
    from hypogoal.domains.base import BUILT_IN, REGISTERED, load_domain

    if isinstance(domain, str):
        return domain
    if domain.name in BUILT_IN and load_domain(domain.name) is not domain:
        raise UserError("this domain has the name of one of hypogoal's", domain.name, "Give it another name.")
    REGISTERED[domain.name] = domain
    return str(domain.name)


def _doubts(domain: Any, collected: Any) -> list[str]:
    """What may be hard about the states of a domain of the user's own."""
    import numpy as np

    from hypogoal.data import doubts_of
    from hypogoal.options.config import OptionConfig

    labelled = collected.labelled
    lines = doubts_of(labelled.labels, collected.heldout.labels, collected.sub_goals)
    steps = labelled.origins.get("step")
    defaults = domain.defaults.get("train-options", {})
    if steps is None or "option_timeout" in defaults:
        return lines
    soonest = [steps[holds].min() for holds in labelled.labels.T]
    apart = int(np.diff(sorted([0, *soonest])).max())  # of two sub-goals, or the start and one
    if 2 * apart > OptionConfig().option_timeout:
        fault = f"play took up to {apart} steps from one sub-goal to the next, each at its earliest"
        lines.append(f"{fault}: train-options --option-timeout {2 * apart} gives options time for that")
    return lines
