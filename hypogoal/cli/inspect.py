"""The commands that only look: ``show``, ``verify``, ``watch``, ``config``."""

import itertools
import json
import shutil
import textwrap
from pathlib import Path
from typing import Annotated, Any

import typer

from hypogoal.cli.common import LOOK, AsJson, Preset, command, echo, print_counts
from hypogoal.core.config import DOMAIN
from hypogoal.core.errors import UserError
from hypogoal.core.terminal import draw, give, say
from hypogoal.settings import CONFIGS, TABLES, described

OFTEN = "Most changed: the options of its command"


@command(LOOK, "show runs/mine")
def show(
    path: Annotated[Path, typer.Argument(help="A data file, an artefact or a run.")],
    as_json: AsJson = False,
    pictures: Annotated[
        Path | None, typer.Option(help="Of a data file: draw its states with their labels into this folder.")
    ] = None,
) -> None:
    """What is this: its result, configuration and inputs."""
    from hypogoal.inspection import describe_path, lines, numbers_of, summary_of, write_contact_sheets

    about, numbers = describe_path(path), None
    try:
        numbers = numbers_of(path)
    except UserError as error:  # what it is can be told all the same
        say(f"hypogoal: {error}", err=True)
    if as_json:
        give(json.dumps(about if numbers is None else {**about, "metrics": numbers}, indent=1))
    else:
        if numbers is not None:
            draw(summary_of(numbers, path), 100)
        if "counts" in about:
            print_counts(about.pop("counts"), False)
        for line in lines(about):
            say(line)
    if pictures is not None:
        for sheet in write_contact_sheets(path, pictures):
            give(sheet, err=as_json)


@command(LOOK, "verify runs/mine")
def verify(
    path: Annotated[Path, typer.Argument(help="A data file, an artefact or a run.")],
    as_json: AsJson = False,
) -> None:
    """Is it whole? Exit code 2 when something is wrong.

    Checks schema, hashes, numbers, and the inputs within PATH.
    """
    from hypogoal.inspection import faults_of, notes_of

    faults, notes = faults_of(path), notes_of(path)
    echo({"path": str(path), "faults": faults, "notes": notes}, as_json, [*(faults or [f"{path}: whole"]), *notes])
    if faults:
        raise typer.Exit(2)


@command(LOOK, "watch runs/mine")
def watch(
    run: Annotated[Path, typer.Argument(help="A run, finished or not.")],
    once: Annotated[bool, typer.Option("--once", help="Print it once instead of following it.")] = False,
    tensorboard: Annotated[
        Path | None, typer.Option(help="Write the logs into this new folder too, for TensorBoard (an extra).")
    ] = None,
) -> None:
    """Follow a run: steps, success or loss so far. Ctrl-C ends it."""
    from hypogoal.live_view import Boards
    from hypogoal.live_view import watch as look

    look(run, once=once, boards=Boards(tensorboard) if tensorboard else None)


@command(LOOK, "config train-ensemble --domain montezuma")
def config(
    context: typer.Context,
    stage: Annotated[str | None, typer.Argument(help="For example train-meta; without one, all are listed.")] = None,
    domain: Annotated[
        str, typer.Option(help="Whose settings: doorkey, montezuma, which-feature, or module:object.")
    ] = DOMAIN,
    preset: Preset = None,
    as_json: AsJson = False,
) -> None:
    """Every setting of a stage: default, unit, meaning, source."""
    if stage is None:
        commands: Any = context.parent and context.parent.command
        echo(list(TABLES), as_json, [f"{name:15}{commands.commands[name].get_short_help_str(64)}" for name in TABLES])
        return
    config_class = CONFIGS.get(stage)
    if config_class is None:  # slower: a domain's or an experiment's
        from hypogoal.stages.sweep import config_class_of

        config_class = config_class_of(stage, domain)
    rows = described(config_class, stage, domain, preset)
    if as_json:
        give(json.dumps(rows, indent=1))
        return
    width = min(shutil.get_terminal_size().columns, 100)
    homes = [(part.__doc__ or "").partition("\n")[0] for part in config_class.__mro__]
    rows.sort(key=lambda row: -1 if row["often"] else homes.index(row["part"]))
    for title, settings in itertools.groupby(rows, lambda row: OFTEN if row["often"] else row["part"]):
        say(f"{title.rstrip('.')}:")
        for row in settings:
            default = ",".join(map(str, row["default"])) if isinstance(row["default"], tuple | list) else row["default"]
            allowed = f"   ({row['allowed']})" if row["allowed"] else ""
            say(f"  {row['name']} = {default} {row['unit']}".rstrip() + allowed)
            told = row["meaning"] + (f" [{row['source']}]" if row["source"] else "")
            for line in textwrap.wrap(told, width, initial_indent="      ", subsequent_indent="      "):
                say(line)
