"""The user's own code, named ``module:object``: when it is loaded, and where an error in it lies.

A name that the user typed, on the command line or in a call from Python, is loaded. A name in a file (a manifest, a
data file, a preset, an experiment in TOML) is loaded only with ``--trust``, or with ``HYPOGOAL_TRUST=1`` in the
environment. Installed packages with an entry point need neither of the two.
"""

import errno
import inspect
import os
import re
import shlex
import sys
import sysconfig
import traceback
from collections.abc import Iterable, Mapping
from importlib import metadata
from pathlib import Path
from pkgutil import resolve_name
from typing import Any, TypeVar

from hypogoal.core.errors import NotInstalled, NumericalError, UserError

TRUST = "--trust"
VARIABLE = "HYPOGOAL_TRUST"
TYPED = "HYPOGOAL_TYPED"  # an environment variable with the names that were typed in the parent process
NAMES = re.compile(r"--trust|[\w.]+:[^\W\d][\w.]*")
CALLED = re.compile(r"([\w.<>]+)\(\) (?:takes|missing|got)")  # the message of a call with wrong arguments
MOST_QUOTED = 200  # the largest number of characters that are quoted of an error
PACKAGE = str(Path(__file__).parents[1]) + os.sep
LIBRARIES = (*map(sysconfig.get_path, ("stdlib", "purelib", "platlib")), PACKAGE, "<")
NO_MEMORY = "there is not enough memory. Choose a smaller batch_size, fewer environments or --set workers=1."
REMEDIES = {
    errno.ENOSPC: "Free some disk space and run it again.",
    errno.EDQUOT: "Free some disk space and run it again.",
    errno.EACCES: "Ask for permission, or choose another path.",
    errno.EROFS: "Nothing can be written there: choose another path.",
}
Kind = TypeVar("Kind")
_allowed: set[str] = set()  # what the user typed in this process


def names_in(text: object) -> list[str]:
    """Return the names ``module:object`` in a word of a command, as in ``network=mine:net``, and ``--trust``."""
    return NAMES.findall(str(text))


def allow(texts: Iterable[object]) -> None:
    """Note what the user typed.

    Names in the texts may be loaded from now on, and any name may be loaded if ``--trust`` is among them.
    """
    for text in texts:
        _allowed.update(names_in(text))


def is_in_program() -> bool:
    """Return whether the user named code of the program itself, ``__main__:object``."""
    return any(name.startswith("__main__:") for name in _allowed)


def environment() -> dict[str, str]:
    """Return environment variables for child processes, which may load what the user typed here and nothing else."""
    return {TYPED: " ".join(sorted(_allowed))} if _allowed else {}


def command(*words: object) -> str:
    """Return the command ``hypogoal *words`` as the user would type it next.

    If this process uses code of the user's own, the command has ``--trust``.
    """
    trust = [TRUST] if _allowed else []
    return shlex.join(["hypogoal", *map(str, words), *trust])


def require_trust(name: str, role: str) -> None:
    """Raise ``UserError`` for a ``module:object`` that the user neither typed nor trusts. Other names pass."""
    typed = _allowed.union(os.environ.get(TYPED, "").split())
    trusted = name in typed or TRUST in typed or os.environ.get(VARIABLE) == "1"
    if ":" in name and not trusted:
        do = f"Do you trust it? Give {TRUST}, or in a program of your own {VARIABLE}=1 in the environment."
        raise UserError(f"a file names code of its own as its {role}", name, do)


def load(name: str, role: str, group: str, built_in: Mapping[str, str]) -> Any:
    """Return the object called ``name``.

    ``name`` is one of ``built_in``, an installed entry point of ``group``, or ``module:object``. Modules in the current
    folder can be loaded, too, but installed modules come first. Raises ``UserError`` if the name is unknown, if the
    object cannot be loaded, or if the user did not allow the code. The message calls the object by its ``role``.
    """
    places = dict(built_in)
    if name not in places:
        places |= {entry.name: entry.value for entry in metadata.entry_points(group=group)}
    if name not in places:
        if ":" not in name:
            choices = ", ".join(sorted(places))
            do = f"Choose one of {choices}, or give module:object." if places else "Give module:object."
            raise NotInstalled(f"unknown {role}", name, do)
        require_trust(name, role)
        if os.getcwd() not in sys.path:
            sys.path.append(os.getcwd())
    try:
        return resolve_name(places.get(name, name))
    except (Exception, SystemExit) as error:
        where = f"{name} {place_of(error)}".strip()
        raise UserError(f"the {role} cannot be loaded: {_line(error)}", where, "--debug shows more.") from error


def load_class(name: str, role: str, base: type[Kind], built_in: Mapping[str, str], group: str = "") -> type[Kind]:
    """Return the subclass of ``base`` called ``name``, see :func:`load`. Raises ``UserError`` for anything else."""
    kind = load(name, role, group, built_in)
    do = f"Give a subclass of {base.__module__}.{base.__name__}."
    if not (inspect.isclass(kind) and issubclass(kind, base)):
        raise UserError(f"this is no {role}", name, do)
    if missing := sorted(getattr(kind, "__abstractmethods__", ())):
        raise UserError(f"this {role} lacks {', '.join(missing)}", name, do)
    return kind


def place_of(error: BaseException) -> str:
    """Return the innermost user code in an error's traceback, as ``file.py, line 3``.

    The text is empty if there is no user code.
    """
    for frame in reversed(traceback.extract_tb(error.__traceback__)):
        if not frame.filename.startswith(LIBRARIES):
            return f"{Path(frame.filename).name}, line {frame.lineno}"
    return ""


def culprit_of(error: BaseException) -> str:
    """Return the user's function that takes other arguments, or the user's class that lacks an attribute.

    The text is empty if there is no such function or class.
    """
    if isinstance(error, TypeError) and (called := CALLED.match(str(error))):
        return called[1]
    kind = type(getattr(error, "obj", None))
    file = getattr(sys.modules.get(kind.__module__), "__file__", None) or "<"
    return "" if file.startswith(LIBRARIES) else f"{Path(file).name}, class {kind.__name__}"


def of_user(error: BaseException) -> UserError | None:
    """Return an error that was raised in or through the user's code as a ``UserError``.

    Returns None for any other error.
    """
    place = place_of(error) or (culprit_of(error) if _allowed else "")
    if not place or isinstance(error, UserError | NumericalError):
        return None
    return UserError(f"your code raised {_line(error)}", place, "--debug shows how it was called.")


def message(error: BaseException) -> tuple[str, int]:
    """Return the line and the exit code for an error that ends a command.

    The code is 2 for the user's mistakes and 1 for other errors.
    """
    if isinstance(error, UserError):
        return str(error), 2
    if isinstance(error, NumericalError):
        return f"training stopped: {error}", 1
    if isinstance(error, MemoryError) or re.search("allocate memory|not enough memory|out of memory", str(error)):
        return NO_MEMORY, 2
    if user_error := of_user(error):
        return str(user_error), 2
    if isinstance(error, UnicodeEncodeError):
        do = "Give PYTHONUTF8=1 in the environment."
        return str(UserError("the locale does not know these letters", error.object, do)), 2
    if isinstance(error, ModuleNotFoundError):
        return f"the package {error.name} is needed. Install it: pip install {error.name}", 2
    if isinstance(error, OSError) and error.errno:
        where = f": {error.filename}" if error.filename else ""
        return f"{error.strerror}{where}. {REMEDIES.get(error.errno, '--debug shows more.')}", 2
    own = " Code of your own is in use: 'hypogoal check' looks at it." if _allowed else ""
    return f"internal error: {_line(error)}.{own} Run again with --debug for the traceback.", 1


def _line(error: BaseException) -> str:
    """Return the kind and the first line of an error: ``KeyError: 'key'``."""
    first, *_ = str(error).splitlines() or [""]
    return f"{type(error).__name__}: {first[:MOST_QUOTED]}"
