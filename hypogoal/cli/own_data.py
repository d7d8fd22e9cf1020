"""The commands for what users bring: ``import``, ``export``, ``check``."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer
from typer import Argument, Option

from hypogoal.cli import common as cli
from hypogoal.core.errors import UserError
from hypogoal.core.files import MOST_INTEGER
from hypogoal.core.terminal import say
from hypogoal.settings import configuration

LARGE = 160  # pixels of a side; larger pictures get the advice to shrink them. At 160 training fits in 2 GB

if TYPE_CHECKING:
    from hypogoal.check import Verdict


@cli.command(cli.OWN, "import states.npz --sub-goal door-open --out data/own.h5", "import")
def import_(
    source: Annotated[Path, Argument(help="Arrays, pictures, or episodes (Minari, LeRobot, robomimic, films).")],
    out: cli.Out,
    sub_goal: Annotated[
        list[str] | None, Option(help="The sub-goal's name; one per column of the labels, in order.")
    ] = None,
    label: Annotated[
        list[str] | None,
        Option(
            metavar="NAME=RULE",
            help="Episodes: a column, last:N frames, FILE.csv or MODULE:FUNCTION; data file: FILE.csv.",
        ),
    ] = None,
    key: Annotated[list[str] | None, Option(help="Episodes: which observation to take; repeatable.")] = None,
    every: Annotated[int, Option(min=1, help="Episodes: take every N-th frame.")] = 1,
    heldout: Annotated[float, Option(min=0.01, max=0.9, help="Share of labelled states to hold out.")] = 0.2,
    resize: Annotated[
        list[str] | None, Option(metavar="[KEY=]N", help="Most pixels on the longer side of pictures, or of a key's.")
    ] = None,
    group: Annotated[str, Option(help="Arrays: which one says what states belong together; held out whole.")] = "",
    stack: Annotated[bool, Option("--stack", help="Axes of frames and colours become channels.")] = False,
    domain: Annotated[str, Option(help="Where the states come from, for train-options.")] = "imported",
    seed: cli.Seed = 0,
    force: cli.Force = False,
    quiet: cli.Quiet = False,
) -> None:
    """Make a data file of your arrays, pictures or recorded episodes."""
    from hypogoal.data import open_dataset
    from hypogoal.importing.data_file import import_data

    labels = dict(text.partition("=")[::2] for text in label or ())
    if not all(name and function for name, function in labels.items()):
        do = "For example --label won=next.success, or of Minari --label won=mine:won."
        raise UserError("--label needs NAME=RULE", " ".join(label or ()), do)
    sizes = dict(text.rpartition("=")[::2] for text in resize or ())
    if not all(size.isdecimal() and int(size) <= MOST_INTEGER for size in sizes.values()):
        raise UserError("--resize needs a number of pixels", " ".join(resize or ()), "Give --resize 128 or KEY=128.")
    sides = {name: int(size) for name, size in sizes.items() if int(size)}
    said = import_data(
        source, out, sub_goals=sub_goal or (), labels=labels, keys=[*filter(None, key or ())], share=heldout,
        sides=sides, every=every, stack=stack, group=group, domain=domain, seed=seed, force=force,
    )  # fmt: skip
    for line in said:
        say(f"hypogoal: {line}", err=True)
    _print_observations(out, bool(sides), quiet)
    cli.print_counts(open_dataset(out).counts(), quiet)
    cli.print_next(quiet, "train-ensemble", out, "--out", cli.run_of(out) / "ensemble")
    say(out)


def _print_observations(data: Path, resized: bool, quiet: bool) -> None:
    """Say how states were read, as pictures or numbers; of large pictures, how to import them smaller."""
    from hypogoal.data import open_dataset
    from hypogoal.observations import PICTURE, fields_of

    dataset = open_dataset(data)
    for key, (dtype, shape) in fields_of(dataset.observation_shape, dataset.observation_dtype).items():
        sizes = " x ".join(map(str, shape))
        if not quiet:
            kind = "pictures" if dtype == PICTURE else "numbers"
            say(f"{f'{key}: ' if key else ''}taken for {kind}, {sizes} {dtype}")
        if dtype == PICTURE and max(shape[:2]) > LARGE and not resized:
            say(f"hypogoal: pictures of {sizes} need much memory and time; add --resize {LARGE} --force", err=True)


@cli.command(cli.OWN, "export data/doorkey.h5 --out states.npz")
def export(
    source: Annotated[Path, Argument(help="A data file, or the folder of a meta or an ensemble artefact.")],
    out: Annotated[Path, Option("--out", help="The .npz file, or the folder; a Minari dataset's is NAME-v0.")],
    episodes: Annotated[int, Option(min=1, help="How many episodes an agent plays.")] = 20,
    seed: Annotated[int, Option(min=0, max=MOST_INTEGER, help="Seed of the agent's choices.")] = 0,
    force: cli.Force = False,
    quiet: cli.Quiet = False,
) -> None:
    """Write states, an agent's episodes or an ensemble for other software.

    States as NumPy arrays, episodes as a Minari dataset. 'import' reads both.
    Ensembles as a folder that torch and safetensors load without hypogoal.
    """
    from hypogoal.tools.export import export as written

    line = written(source, out, episodes=episodes, seed=seed, force=force, quiet=quiet)
    if line and not quiet:
        say(line)
    say(out)


@cli.command(cli.OWN, "check mine:DOMAIN")
def check(
    domain: Annotated[str | None, Argument(help=cli.DOMAINS, autocompletion=cli.offer("domain"))] = None,
    diversity: Annotated[str | None, Option(help="A diversity objective: a name or module:function.")] = None,
    network: Annotated[str | None, Option(help="A member network: a name or module:function.")] = None,
    set_: cli.Set = None,
    seed: cli.Seed = 0,
    layout_seed: Annotated[int, Option(min=0, max=MOST_INTEGER, help="The layout to play.")] = 0,
) -> None:
    """Check that your domain, objective or network keeps its contract.

    Exit code 2 if not. It collects a few states of the domain twice; --set
    changes how, as for 'collect'.
    """
    if domain is None and diversity is None and network is None:
        raise UserError("nothing to check", None, "Give a domain, --diversity or --network.")
    broken = False
    config = configuration("collect", domain, None, set_, {}) if domain else None
    for verdict in _verdicts(domain, diversity, network, config, layout_seed, seed):
        for line in verdict.lines:
            say(line)
        broken |= not verdict.ok
    if broken:
        raise typer.Exit(2)


def _verdicts(
    domain: str | None, diversity: str | None, network: str | None, config: Any, layout_seed: int, seed: int
) -> Iterator[Verdict]:
    from hypogoal.check import check_domain, check_network, check_objective

    observations: tuple[Any, ...] = ()
    if domain is not None:
        from hypogoal.domains.base import load_domain

        loaded = load_domain(domain)
        yield from check_domain(loaded, config, layout_seed=layout_seed, seed=seed)
        observations = tuple(loaded.observation_shape), loaded.observation_dtype
    if diversity is not None:
        from hypogoal.diversity import load_objective

        yield from check_objective(load_objective(diversity))
    if network is not None:
        yield from check_network(network, *observations)
