"""The stage that collects labelled, unlabelled and held-out states of a domain into an HDF5 file."""

from typing import Annotated, Any

from typer import Argument

from hypogoal.command.call import DOMAINS, NO_TRAINING, Call, Done
from hypogoal.command.stage import stage
from hypogoal.core.artefacts import DATA
from hypogoal.core.config import Config
from hypogoal.core.errors import UserError
from hypogoal.core.progress import Progress, say


@stage(
    "collect doorkey --out data/doorkey.h5",
    leaves_out=NO_TRAINING,
    then="train-ensemble {out} --out runs/{out.stem}/ensemble",
)
def collect(call: Call, domain: Annotated[str, Argument(help=DOMAINS)]) -> Done:
    """Collect labelled, unlabelled and held-out states.

    ``domain`` is a name or, in Python, a ``Domain``, which later stages find by its own name, in this process only.
    ``out`` is an HDF5 file. ``resume`` keeps a complete file, and begins an unfinished one anew.
    """
    from hypogoal.data import open_dataset, write_dataset
    from hypogoal.domains.find import BUILT_IN, load_domain
    from hypogoal.label_checks import doubts_of, require_names
    from hypogoal.look import count_lines

    name = _name_of(domain)
    played = load_domain(name)
    require_names(played.sub_goals)  # before play, because a fault would otherwise be told when the file is written
    config = call.settings(Config, name)
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
        labels = collected.labelled.labels, collected.heldout.labels
        for line in doubts_of(*labels, collected.sub_goals):
            say(f"hypogoal: {line}", err=True)
    counts = open_dataset(call.out).counts()
    return Done(count_lines(counts))


def _name_of(domain: Any) -> str:
    """Return the name by which later stages find a domain."""
    from hypogoal.domains.find import BUILT_IN, REGISTERED, load_domain

    if isinstance(domain, str):
        return domain
    if domain.name in BUILT_IN and load_domain(domain.name) is not domain:
        raise UserError("this domain has the name of one of hypogoal's", domain.name, "Give it another name.")
    REGISTERED[domain.name] = domain
    return str(domain.name)
