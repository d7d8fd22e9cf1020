"""Code of the user's own, named as ``module:object``, and code that others installed, named by an entry point.

``module:object`` is code that will run. It is loaded where the user gave that name, not because a data file, a manifest
or a preset, which may be a stranger's, has it in it: then the user allows it by the environment variable
``HYPOGOAL_TRUST`` (several names with commas between). What is installed needs no permission.

Here alone is it decided whose word a name is. The command of a sweep's cell comes from a file, however it is spelt: the
process that runs it is told so (:func:`environment_of_children`), and in it nothing is the user's but what is allowed.
"""

from __future__ import annotations

import contextlib
import importlib
import os
import sys
import traceback
from collections.abc import Iterator, Mapping
from contextvars import ContextVar
from importlib import metadata
from pathlib import Path
from types import TracebackType
from typing import Any

from hypogoal.core.errors import UserError

TRUST = "HYPOGOAL_TRUST"
OF_FILE = "HYPOGOAL_COMMAND_OF_FILE"  # in the environment: this process runs a command that the user did not type
_given: ContextVar[frozenset[str]] = ContextVar("_given", default=frozenset())


def given(*names: str) -> contextlib.AbstractContextManager[None]:
    """Within the block these names are the user's own words: ``module:object`` among them may be loaded.

    Without effect where the command is a file's.
    """
    return vouched(*([] if os.environ.get(OF_FILE) else names))


@contextlib.contextmanager
def vouched(*names: str) -> Iterator[None]:
    """Within the block these names may be loaded: code that runs already says them, such as a domain its network."""
    token = _given.set(_given.get() | set(names))
    try:
        yield
    finally:
        _given.reset(token)


def allowed() -> frozenset[str]:
    """The ``module:object`` that may be loaded here: what the user gave, and what ``HYPOGOAL_TRUST`` names."""
    names = {*_given.get(), *os.environ.get(TRUST, "").split(",")}
    return frozenset(name.strip() for name in names if ":" in name)


def environment_of_children() -> dict[str, str]:
    """For a process whose command is a file's: what is allowed here is allowed there, whatever its own words are."""
    return {TRUST: ",".join(sorted(allowed())), OF_FILE: "1"}


def require_trust(name: str, what: str) -> None:
    """Refuse to load ``module:object`` that the user neither gave nor allowed; other names pass.

    Args:
        name: what a file, or the user, calls it.
        what: what it is to be, for the message ("domain").

    Raises:
        UserError: see above.
    """
    if ":" in name and name not in allowed():
        raise UserError(f"a file names code of its own as its {what}", name, f"Do you trust it? Set {TRUST}={name}")


def load_own(name: str, what: str, group: str, built_in: Mapping[str, str]) -> Any:
    """What ``name`` stands for: one that comes with hypogoal, an installed entry point, or ``module:object``.

    Modules of the current folder can be loaded too, whichever way hypogoal was started; installed ones come first.

    Args:
        name: as given.
        what: what it is, for messages ("domain").
        group: of the entry points.
        built_in: those that come with hypogoal, name to ``module:object``.

    Raises:
        UserError: no such name, it cannot be loaded, or it is code that the user did not allow.
    """
    entries = {entry.name: entry.value for entry in metadata.entry_points(group=group)}
    target = built_in.get(name) or entries.get(name)
    if target is None and ":" in name:
        require_trust(name, what)
        if "" not in sys.path and os.getcwd() not in sys.path:
            sys.path.append(os.getcwd())
        target = name
    if target is None:
        known = ", ".join(sorted({*built_in, *entries}))
        raise UserError(f"unknown {what}", name, f"Choose one of {known}, or give module:object.")
    module, _, attribute = target.partition(":")
    try:
        found = importlib.import_module(module)
        return getattr(found, attribute) if attribute else found
    except UserError:
        raise
    except Exception as error:  # whatever a module does when it is loaded
        do = "Check the module and the object; --debug shows where."
        raise UserError(f"the {what} cannot be loaded ({type(error).__name__}: {error})", name, do) from error


class UsersCode:
    """A block in which code of the user's own runs: what it raises is told with its place, as the user's to mend.

    Args:
        what: whose code it is ("the label function of won").

    Raises:
        UserError: when leaving the block by another exception than a UserError.
    """

    __slots__ = ("what",)

    def __init__(self, what: str):
        self.what = what

    def __enter__(self) -> None:
        return None

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if isinstance(error, Exception) and not isinstance(error, UserError):
            place = traceback.extract_tb(trace)[-1]
            where = f"{Path(place.filename).name}, line {place.lineno}"
            do = "Mend it; --debug shows how it was called."
            raise UserError(f"{self.what} raised {type(error).__name__}: {error}", where, do) from error
