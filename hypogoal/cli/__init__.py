"""The command line: each command parses, calls one stage and prints the artefact's path as its last line.

Spec A1-A8. Heavy imports are inside the commands, so that ``hypogoal --help`` is quick.
"""

import errno
import functools
import os
import re
import signal
import sys
from dataclasses import fields
from typing import Annotated, Any

import typer
from typer import Option

from hypogoal.cli import stages, sweep, inspect, own_data  # isort: skip  # so --help has them in this order
from hypogoal.cli.common import Interrupted, app
from hypogoal.core import stopping
from hypogoal.core.errors import Complete, NumericalError, UserError, one_line
from hypogoal.core.terminal import Unprinted, give, open_streams, say
from hypogoal.settings import CONFIGS, TABLES

NO_MEMORY = "Lower batch_size, workers or environments (--set batch_size=N), or allow more (ulimit -v)."
# Texts of errors that torch and the loader of libraries raise in place of a MemoryError.
MEMORY_TEXTS = (
    "can't allocate memory",
    "Cannot allocate memory",
    "not enough memory",
    "CUDA out of memory",
    "failed to map segment",
)

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
) -> None:
    """Options before a command."""


def main(arguments: list[str] | None = None) -> int:
    """Run the command line; returns the exit code: 2 for the user's mistakes, 1 for hypogoal's."""
    if arguments is None:
        signal.signal(signal.SIGTERM, stopping.stop)  # a cancelled job, too, leaves nothing half-written
        sys.unraisablehook = stopping.unraised
        open_streams()
    words = sys.argv[1:] if arguments is None else arguments
    debug = "--debug" in words
    words = [argument for argument in words if argument != "--debug"]
    try:
        if arguments is None and signal.getsignal(signal.SIGINT) is not signal.SIG_IGN:  # ignored in the background
            signal.signal(signal.SIGINT, stopping.stop)
        os.getcwd()  # raises if it was deleted
        return _called(words)
    except Unprinted as error:
        # Not 0, since the output was not received; not 2, since the command was right.
        return _fail(f"the output is complete, but could not be printed ({error.strerror})", 1)
    except (Interrupted, KeyboardInterrupt) as stop:  # KeyboardInterrupt: before a command was reached
        if arguments is None:
            for number in stopping.SIGNALS:  # all is cleaned up: a further signal may end the process at once
                signal.signal(number, signal.SIG_DFL)
        cause = stop.__cause__ or stop
        number = cause.args[0] if cause.args else signal.SIGINT
        return _fail("; ".join(["stopped", *(notes_of(cause) or ["nothing was half-written"])]), 128 + number)
    except (Exception, SystemExit) as error:
        ended = getattr(error, "exit_code", None)
        if ended is not None:
            message = getattr(error, "format_message", lambda: "")()
            return _fail(f"{message.rstrip('.')}. {_advice(error)}", 2) if message else int(ended)
        message, code = _message(error)
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


def _message(error: BaseException) -> tuple[str, int]:
    """The message and the exit code."""
    if isinstance(error, UserError):
        return str(error), 2
    if isinstance(error, NumericalError):
        return f"training stopped: {error}", 1
    return _refused(error) if isinstance(error, OSError) else _internal(error)


def _internal(error: BaseException) -> tuple[str, int]:
    """Message and exit code of an unexpected error: lack of memory, user code, or a bug."""
    from hypogoal.core.own_code import users_own

    if os.strerror(errno.EMFILE) in str(error):  # torch's is not an OSError
        return _refused(OSError(errno.EMFILE, os.strerror(errno.EMFILE)))
    if isinstance(error, MemoryError) or any(text in str(error) for text in MEMORY_TEXTS):
        return f"there is not enough memory. Nothing was half-written. {NO_MEMORY}", 2
    if (user_error := users_own(error)) is not None:
        return str(user_error), 2
    first = next(iter(str(error).splitlines()), "")  # a printed tensor may follow
    return f"internal error: {type(error).__name__}: {first}. Run again with --debug for the traceback.", 1


@functools.cache
def _commands() -> Any:
    """Typer's commands, built once per process: building takes longer than many commands."""
    return typer.main.get_command(app)


def _called(words: list[str]) -> int:
    try:
        code: object = _commands()(args=words, standalone_mode=False, prog_name="hypogoal")
    except Complete as complete:
        say(complete, err=True)
        give(complete.path)
        return 0
    return code if isinstance(code, int) else 0


def _refused(error: OSError) -> tuple[str, int]:
    """Message and exit code if the system refuses to read or write a file."""
    remedies = {
        errno.EMFILE: "Allow more open files (ulimit -n).",
        errno.ENFILE: "Close some programs: the system has as many files open as it can.",
        errno.ENOMEM: NO_MEMORY,
        errno.EAGAIN: "Allow more processes (ulimit -u), or give --set workers=1.",
        errno.ENOSPC: "Free some disk space and run it again.",
        errno.EDQUOT: "Your quota is used up: remove something and run it again.",
        errno.EFBIG: "The file may not grow larger here (ulimit -f): allow more, or choose another --out.",
        errno.EROFS: "Choose another --out.",
        errno.EACCES: "Choose another --out, or ask for permission.",
        errno.EPERM: "Choose another --out, or ask for permission.",
        errno.ENAMETOOLONG: "Choose a shorter name.",
    }
    if not _homed():
        return "the current folder no longer exists. Change to another one.", 2
    # HDF5 has the number only in its text: "... errno = 28, error message = ..."
    match = re.search(r"errno = (\d+)", str(error))
    code = error.errno or (int(match[1]) if match else 0)
    where = f": {error.filename}" if error.filename else ""
    if code in (errno.EACCES, errno.EPERM) and error.filename and not _may_read(error.filename):
        return f"{os.strerror(code)}{where}. Ask for permission to read it.", 2
    if code in remedies:
        return f"{os.strerror(code)}{where}. Nothing was half-written. {remedies[code]}", 2
    return _internal(error)


def _homed() -> bool:
    try:
        return bool(os.getcwd())
    except OSError:
        return False


def _may_read(name: str | bytes) -> bool:
    """Whether the file can be read or does not exist, so that the system refused something else."""
    return os.access(name, os.R_OK) or not os.path.lexists(name)


def notes_of(error: BaseException) -> list[str]:
    """The notes that were added to an error, each once."""
    return list(dict.fromkeys(getattr(error, "__notes__", [])))


def _fail(message: str, code: int) -> int:
    say(f"hypogoal: {one_line(message)}", err=True)
    return code


if __name__ == "__main__":
    sys.exit(main())
