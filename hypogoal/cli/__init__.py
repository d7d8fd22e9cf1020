"""The command line: each command parses, calls one stage and prints the artefact's path as its last line.

Spec A1-A8. Heavy imports are inside the commands, so that ``hypogoal --help`` is quick.
"""

import functools
import os
import signal
import sys
from dataclasses import fields
from typing import Annotated, Any

import typer
from typer import Option

from hypogoal.cli import stages, sweep, inspect, own_data  # isort: skip  # so --help has them in this order
from hypogoal.cli.common import Interrupted, app
from hypogoal.core import own_code, processes
from hypogoal.core.errors import Complete, printable
from hypogoal.core.terminal import say
from hypogoal.settings import CONFIGS, TABLES

__all__ = ["app", "inspect", "main", "own_data", "stages", "sweep"]


def _version(value: bool) -> None:
    if value:
        from hypogoal import __version__

        say(f"hypogoal {__version__}")
        raise typer.Exit


@app.callback()
def _root(
    version: Annotated[bool, Option("--version", callback=_version, is_eager=True, help="Show the version.")] = False,
    debug: Annotated[bool, Option("--debug", help="Show the traceback of an error.")] = False,
    trust: Annotated[bool, Option("--trust", help="Load code of your own that files name (module:object).")] = False,
) -> None:
    """Options before a command; ``main`` takes them anywhere."""


def main(arguments: list[str] | None = None) -> int:
    """Run the command line; returns the exit code: 2 for the user's mistakes, 1 for hypogoal's."""
    if arguments is None:
        signal.signal(signal.SIGTERM, processes.stop)  # a cancelled job, too, leaves nothing half-written
    words = sys.argv[1:] if arguments is None else arguments
    own_code.allow(words)
    debug = "--debug" in words
    words = [word for word in words if word not in ("--debug", own_code.TRUST)]
    try:
        if arguments is None and signal.getsignal(signal.SIGINT) is not signal.SIG_IGN:  # ignored in the background
            signal.signal(signal.SIGINT, processes.stop)
        return _called(words)
    except BrokenPipeError:  # whoever read what was printed, such as head, has enough
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())  # Python flushes it once more at its exit
        return 1
    except (Interrupted, KeyboardInterrupt) as stop:  # KeyboardInterrupt: before a command was reached
        if arguments is None:
            for number in processes.SIGNALS:  # all is cleaned up: a further signal may end the process at once
                signal.signal(number, signal.SIG_DFL)
        cause = stop.__cause__ or stop
        number = cause.args[0] if cause.args else signal.SIGINT
        return _fail("; ".join(["stopped", *(notes_of(cause) or ["nothing was half-written"])]), 128 + number)
    except (Exception, SystemExit) as error:
        ended = getattr(error, "exit_code", None)
        if ended is not None:
            message = getattr(error, "format_message", lambda: "")()
            return _fail(f"{message.rstrip('.')}. {_advice(error)}", 2) if message else int(ended)
        message, code = own_code.message(error)
        if debug or (code == 1 and isinstance(error, SystemExit)):  # typer's, at a closed pipe
            raise
        notes = notes_of(error)
        return _fail("; ".join([message.rstrip(".") if notes else message, *notes]), code)


def _advice(error: Any) -> str:
    """What to do about words that a command does not take; settings are often mistaken for options."""
    context, key = getattr(error, "ctx", None), getattr(error, "option_name", "").lstrip("-").replace("-", "_")
    stage = getattr(context, "info_name", "")
    if not hasattr(error, "possibilities") or stage not in TABLES:
        return f"See '{context.command_path if context else 'hypogoal'} --help'."
    is_setting = stage in CONFIGS and any(field.name == key for field in fields(CONFIGS[stage]))
    return f"Settings are given as --set {key if is_setting else 'key'}=VALUE; 'hypogoal config {stage}' lists them."


@functools.cache
def _commands() -> Any:
    """Typer's commands, built once per process: building takes longer than many commands."""
    return typer.main.get_command(app)


def _called(words: list[str]) -> int:
    try:
        code: object = _commands()(args=words, standalone_mode=False, prog_name="hypogoal")
    except Complete as complete:
        say(complete, err=True)
        say(complete.path)
        return 0
    return code if isinstance(code, int) else 0


def notes_of(error: BaseException) -> list[str]:
    """The notes that were added to an error, each once."""
    return list(dict.fromkeys(getattr(error, "__notes__", [])))


def _fail(message: str, code: int) -> int:
    say(f"hypogoal: {printable(message)}", err=True)
    return code


if __name__ == "__main__":
    sys.exit(main())
