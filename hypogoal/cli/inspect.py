"""The commands that only look: ``show``, ``verify``, ``status``, ``config``."""

import itertools
import json
import shutil
import textwrap
from pathlib import Path
from typing import Annotated, Any

import typer
from typer import Argument, Option

from hypogoal.cli import common as cli
from hypogoal.core.config import DOMAIN
from hypogoal.core.errors import UserError
from hypogoal.core.files import replace_text
from hypogoal.core.terminal import say
from hypogoal.settings import CONFIGS, OFTEN, TABLES, described, preset_text

Made = Annotated[Path, Argument(help="A data file, an artefact or a run.")]


@cli.command(cli.LOOK, "show runs/mine")
def show(
    path: Made,
    as_json: cli.AsJson = False,
    pictures: Annotated[Path | None, Option(help="Draw labelled states of a data file into this folder.")] = None,
) -> None:
    """Describe a file or folder: kind, result, settings, inputs."""
    from hypogoal.look import describe, lines, outcome

    details = describe(path)
    cli.echo(details, as_json, [] if as_json else [*outcome(details), *lines(details)])
    if pictures is not None:
        from hypogoal.evaluation.pictures import write_contact_sheets

        for sheet in write_contact_sheets(path, pictures):
            say(sheet, err=as_json)


@cli.command(cli.LOOK, "verify runs/mine")
def verify(path: Made, as_json: cli.AsJson = False) -> None:
    """Check for missing or changed files; exit code 2 if there are any.

    Reads every file, and those inputs that lie within PATH. What is still being made is named, not checked.
    """
    from hypogoal.experiments.sweep import in_the_making
    from hypogoal.look import faults, parts_of

    found, notes = faults(path), in_the_making(path)
    state = "whole so far" if notes else "whole"
    verdict = f"{path}: {state if parts_of(path) else 'nothing is complete yet'}"
    cli.echo({"path": str(path), "faults": found, "notes": notes}, as_json, [*(found or [verdict]), *notes])
    if found:
        raise typer.Exit(2)


@cli.command(cli.LOOK, "status runs/mine")
def status(path: Annotated[Path, Argument(help="A run.")], as_json: cli.AsJson = False) -> None:
    """Say what is stale or unfinished, why, and which commands renew it."""
    from hypogoal.experiments.sweep import in_the_making
    from hypogoal.look import stale, stale_lines

    rows = stale(path)
    cli.echo(rows, as_json, [*in_the_making(path), *stale_lines(rows)])


@cli.command(cli.LOOK, "config train-ensemble --domain montezuma")
def config(
    context: typer.Context,
    stage: Annotated[
        str | None,
        Argument(help="For example train-meta; without it, the list of stages.", autocompletion=cli.offer("stage")),
    ] = None,
    domain: Annotated[str, Option(help=f"Settings for: {cli.DOMAINS}", autocompletion=cli.offer("domain"))] = DOMAIN,
    preset: cli.Preset = None,
    write: Annotated[Path | None, Option(help="Write them as a preset to edit: a new .toml file for --preset.")] = None,
    as_json: cli.AsJson = False,
) -> None:
    """List every setting of a stage: default, unit, meaning, source."""
    if stage is None:
        group: Any = context.parent and context.parent.command
        cli.echo(list(TABLES), as_json, [f"{name:15}{group.commands[name].get_short_help_str(64)}" for name in TABLES])
        return
    config_class = CONFIGS.get(stage)
    if config_class is None:  # a domain's or an experiment's, slower to load
        from hypogoal.experiments.run import config_class_of

        config_class = config_class_of(stage, domain)
    rows = described(config_class, stage, domain, preset)
    if write is not None:
        if write.exists() or write.suffix != ".toml":
            raise UserError("a preset needs a new .toml file", write, "Choose another name.")
        replace_text(write, preset_text(stage, rows))
        say(write)
        return
    if as_json:
        say(json.dumps(rows, indent=1))
        return
    width, often = min(shutil.get_terminal_size().columns, 100), OFTEN.get(stage, ())
    parts = [(part.__doc__ or "").partition(".")[0] for part in config_class.__mro__]
    # A range such as 0-9 or a command such as train-meta stays in one piece.
    wrapped = textwrap.TextWrapper(width, " " * 6, " " * 6, break_on_hyphens=False, break_long_words=False)
    rows.sort(key=lambda row: -1 if row["name"] in often else parts.index(row["part"]))
    for title, settings in itertools.groupby(rows, lambda row: "Most changed" if row["name"] in often else row["part"]):
        say(f"{title.replace('`', '')}:")
        for row in settings:
            default = ",".join(map(str, row["default"])) if isinstance(row["default"], tuple | list) else row["default"]
            allowed = f"   ({row['allowed']})" if row["allowed"] else ""
            head = f"  {row['name']} = {default} {row['unit']}".rstrip()
            for line in [head + allowed] if len(head + allowed) <= width else [head, " " * 6 + allowed.strip()]:
                say(line)
            text = row["meaning"] + (f" [{row['source']}]" if row["source"] else "")
            for line in wrapped.wrap(text):
                say(line)
