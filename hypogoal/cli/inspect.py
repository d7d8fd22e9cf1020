"""The commands that only look: ``show``, ``verify``, ``watch``, ``config``."""

from pathlib import Path
from typing import Annotated

import typer

from hypogoal.cli.common import AsJson, app, echo
from hypogoal.core.errors import UserError
from hypogoal.core.terminal import draw, give, say


@app.command()
def show(
    path: Annotated[Path, typer.Argument(help="A data file, an artefact or a run.")],
    as_json: AsJson = False,
    pictures: Annotated[
        Path | None, typer.Option(help="Of a data file: draw its states with their labels into this folder.")
    ] = None,
) -> None:
    """What is this: kind, configuration, inputs; of data the counts, of an evaluation or its run the numbers."""
    from hypogoal.inspection import describe_path, lines, numbers_of, summary_of, write_contact_sheets

    about, numbers = describe_path(path), None
    if not as_json:
        echo(about, False, lines(about))
    try:
        numbers = numbers_of(path)
    except UserError as error:  # what it is can be told all the same
        say(f"hypogoal: {error}", err=True)
    if as_json:
        echo(about if numbers is None else {**about, "metrics": numbers}, True, [])
    elif numbers is not None:
        draw(summary_of(numbers, path), 100)
    if pictures is not None:
        for sheet in write_contact_sheets(path, pictures):
            give(sheet, err=as_json)


@app.command()
def verify(
    path: Annotated[Path, typer.Argument(help="A data file, an artefact or a run.")],
    as_json: AsJson = False,
) -> None:
    """Check schema, hashes, numbers and the inputs within PATH; exit code 2 when something is wrong."""
    from hypogoal.inspection import faults_of, notes_of

    faults, notes = faults_of(path), notes_of(path)
    echo({"path": str(path), "faults": faults, "notes": notes}, as_json, [*(faults or [f"{path}: whole"]), *notes])
    if faults:
        raise typer.Exit(2)


@app.command()
def watch(
    run: Annotated[Path, typer.Argument(help="A run, finished or not.")],
    once: Annotated[bool, typer.Option("--once", help="Print it once instead of following it.")] = False,
    tensorboard: Annotated[
        Path | None, typer.Option(help="Write the logs into this new folder too, for TensorBoard (an extra).")
    ] = None,
) -> None:
    """Follow a run in the terminal: each artefact's steps and success or loss so far. Ctrl-C ends it."""
    from hypogoal.live_view import Boards
    from hypogoal.live_view import watch as look

    look(run, once=once, boards=Boards(tensorboard) if tensorboard else None)


@app.command()
def config(
    stage: Annotated[str, typer.Argument(help="For example train-meta.")],
    domain: Annotated[
        str, typer.Option(help="Whose settings: doorkey, montezuma, which-feature, or module:object.")
    ] = "doorkey",
    as_json: AsJson = False,
) -> None:
    """Every setting of a stage: default, unit, meaning, source."""
    from hypogoal.core.config import describe
    from hypogoal.domains.base import defaults_of
    from hypogoal.stages.sweep import config_class_of

    rows = describe(config_class_of(stage, domain), defaults_of(domain, stage, given=True))
    if as_json:
        echo(rows, True, [])
        return
    for row in rows:
        default = ",".join(map(str, row["default"])) if isinstance(row["default"], tuple) else row["default"]
        unit = f" {row['unit']}" if row["unit"] else ""
        say(f"{row['name']} = {default}{unit}" + (f"   ({row['allowed']})" if row["allowed"] else ""))
        say(f"    {row['meaning']}" + (f" [{row['source']}]" if row["source"] else ""))
