"""The program ``hypogoal`` for Typer: its commands by name, its own options, and how commands are made and print."""

import json
from collections.abc import Iterable
from pathlib import Path
from typing import Annotated, Any

import typer
from typer import Argument, Option
from typer.core import TyperGroup

from hypogoal.command import stage
from hypogoal.core.progress import say

MAKE = "Make"  # a group of commands


class Commands(TyperGroup):
    """The commands. Those of stages are made when they are called, since their settings take time to load."""

    def resolve_command(self, context: Any, words: list[str]) -> Any:
        name, *rest = words
        if name in stage.LISTED:
            return name, stage.load_stage(name).command, rest
        return super().resolve_command(context, words)


app = typer.Typer(
    cls=Commands,
    help="Learn sub-goals that hold in new places, by several hypotheses about what the labels mean.\n\nStart here: "
    "[bold]hypogoal run rooms --preset demo[/bold] makes a report from nothing, in two minutes.",
    epilog="Each command's --help ends with an example. 'hypogoal config STAGE' lists the settings of a command, "
    "such as train-meta.",
    no_args_is_help=True,
    pretty_exceptions_enable=False,
    context_settings={"help_option_names": ["-h", "--help"]},
)
Made = Annotated[Path, Argument(help="A data file, an artefact (a folder that a command wrote), or a run.")]
Json = Annotated[bool, Option("--json", metavar="", help="Print JSON for programs.")]


def command(panel: str, example: str, name: str | None = None) -> Any:
    """Return a decorator that makes a function a command of a group. The command's ``--help`` ends with an example."""
    return app.command(name, rich_help_panel=panel, epilog=f"Example:\n\n[bold]hypogoal {example}[/bold]")


def _version(wanted: bool) -> None:
    if wanted:
        from hypogoal import __version__

        say(f"hypogoal {__version__}")
        raise typer.Exit


@app.callback()
def _root(
    version: Annotated[
        bool, Option("--version", metavar="", callback=_version, is_eager=True, help="Show the version.")
    ] = False,
    debug: Annotated[bool, Option("--debug", metavar="", help="Show the traceback of an error.")] = False,
    trust: Annotated[
        bool, Option("--trust", metavar="", help="Run code of your own if a file names it (as module:object).")
    ] = False,
) -> None:
    """Options before a command; ``main`` takes them anywhere."""


def echo(value: Any, as_json: bool, text: Iterable[str]) -> None:
    """Print a value for programs, or its text for people."""
    if as_json:
        text = [json.dumps(value, indent=1)]
    say(*text)
