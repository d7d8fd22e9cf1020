"""User code, named ``module:object``, and installed code, named by an entry point.

``module:object`` is code that will run. It is loaded if the user typed the name. If a data file, a manifest or a
preset, perhaps a stranger's, has the name, the user must allow it with the environment variable ``HYPOGOAL_TRUST``
(names separated by commas). Installed code needs no permission.

Only this module decides whether a name is the user's. The command of a sweep's cell comes from a file: its process is
marked so (:func:`environment_of_children`), and there only allowed names are the user's.

:class:`UsersCode` turns every error and wrong result of such code into one line that says where the code is.
"""

import contextlib
import functools
import importlib
import inspect
import operator
import os
import shlex
import sys
import sysconfig
import traceback
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextvars import ContextVar
from importlib import metadata
from pathlib import Path
from types import FrameType
from typing import Any, NoReturn, Self

from hypogoal.core.errors import Complete, NumericalError, UserError

TRUST = "HYPOGOAL_TRUST"
OF_FILE = "HYPOGOAL_COMMAND_OF_FILE"  # in the environment: this process runs a command that the user did not type
MAX_FLOAT32 = 3.4028234663852886e38  # rewards are stored as float32
MOST_QUOTED = 200  # characters of a value or an error of user code
_given: ContextVar[frozenset[str]] = ContextVar("_given", default=frozenset())
_before: set[str] = set()  # all names ever given in this process
_own: set[str] = set()  # top-level modules that were loaded by name and are not hypogoal's


def given(*names: str) -> contextlib.AbstractContextManager[None]:
    """Within the block these ``module:object`` may be loaded: the user typed them, unless a file did."""
    return vouched(*([] if os.environ.get(OF_FILE) else names))


@contextlib.contextmanager
def vouched(*names: str) -> Iterator[None]:
    """Within the block these names may be loaded: code that runs already names them, as a domain names its network."""
    token = _given.set(_given.get() | set(names))
    _before.update(names)
    try:
        yield
    finally:
        _given.reset(token)


def allowed() -> frozenset[str]:
    """The ``module:object`` that may be loaded now: typed by the user or in ``HYPOGOAL_TRUST``."""
    return frozenset(name.strip() for name in (*_given.get(), *in_environment()) if ":" in name)


def allowed_before() -> frozenset[str]:
    """Every ``module:object`` that the user has allowed in this process."""
    return frozenset({*_before, *in_environment()})


def in_environment() -> list[str]:
    """The names in ``HYPOGOAL_TRUST``."""
    return [name for text in os.environ.get(TRUST, "").split(",") if ":" in (name := text.strip())]


def permission(names: Iterable[str]) -> str:
    """``HYPOGOAL_TRUST=...`` as typed in a shell to allow these names."""
    return f"{TRUST}={shlex.quote(','.join(dict.fromkeys(names)))}"


def environment_of_children() -> dict[str, str]:
    """For a process that runs a file's command: it may load what is allowed here and nothing else."""
    return {TRUST: ",".join(sorted(allowed())), OF_FILE: "1"}


def require_trust(name: str, role: str) -> None:
    """Refuse (``UserError``) to load ``module:object`` that the user neither typed nor allowed; other names pass.

    The message names its ``role`` ("domain").
    """
    if ":" in name and name not in allowed():
        do = f"Do you trust it? Set {permission([name, *in_environment()])}"
        raise UserError(f"a file names code of its own as its {role}", name, do)


def load_own(name: str, role: str, group: str, built_in: Mapping[str, str]) -> Any:
    """The object called ``name``: one of ``built_in``, an installed entry point of ``group``, or ``module:object``.

    Modules in the current folder can be loaded too, however hypogoal was started; installed ones come first. An unknown
    name, one that cannot be loaded, and code that the user did not allow are a ``UserError``, whose message calls it by
    its ``role`` ("domain").
    """
    entries = {} if name in built_in else {entry.name: entry.value for entry in metadata.entry_points(group=group)}
    target = built_in.get(name) or entries.get(name)
    if target is None and ":" in name:
        require_trust(name, role)
        if "" not in sys.path and os.getcwd() not in sys.path:
            sys.path.append(os.getcwd())
        target = name
    if target is None:
        names = ", ".join(sorted({*built_in, *entries}))
        do = f"Choose one of {names}, or give module:object." if names else "Give module:object."
        raise UserError(f"unknown {role}", name, do)
    module, _, attribute = target.partition(":")
    if name not in built_in and not target.startswith("hypogoal."):
        _own.add(module.partition(".")[0])
    with UsersCode(f"the {role}", name, failed="cannot be loaded:"):
        loaded = importlib.import_module(module)
        return getattr(loaded, attribute) if attribute else loaded


class UsersCode:
    """A block in which user code runs; its methods check the values that the code returns.

    Every exception (``SystemExit`` too, but not Ctrl-C) and every wrong value becomes a ``UserError`` of one line with
    the code's place. The block is around every step of an environment: keep it cheap.

    ``title`` names the code ("the label function of won"); ``target`` is the function, or the object that has
    ``method``, or a text, the user's name for it. ``failed`` is the verb between ``title`` and the exception.
    """

    __slots__ = ("failed", "method", "target", "title")

    def __init__(self, title: str, target: object = None, method: str = "", *, failed: str = "raised"):
        self.title, self.target, self.method, self.failed = title, target, method, failed

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: object, error: BaseException | None, trace: object) -> None:
        if error is None or isinstance(error, KeyboardInterrupt):
            return
        if not isinstance(error, UserError) or isinstance(error, Complete):  # which would exit with 0
            raise self.error_for(error) from error

    def error_for(self, error: BaseException) -> UserError:
        """An exception of the code as a ``UserError`` with its place."""
        do = "Mend it; --debug shows how it was called."
        if isinstance(self.target, str):
            do = "Check the module and the object; --debug shows where."
        text = f"{type(error).__name__}: {_quoted(str, error)}"
        if isinstance(error, SystemExit):
            text, do = f"{_quoted(repr, error)}, to end the program", "Have it raise an error that says what is wrong."
        frames = traceback.extract_tb(error.__traceback__)
        theirs = [frame for frame in frames if not frame.filename.startswith(_libraries())]
        if inspect.isclass(self.target) and not any(self._in_it(frame) for frame in theirs):
            theirs = []  # the caller raised: the class cannot be called so, or returned a wrong value
        place = _place(theirs[-1].filename, theirs[-1].lineno) if theirs else ""
        if isinstance(self.target, str):
            place = f"{self.target} ({place})" if place else self.target
        return UserError(f"{self.title} {self.failed} {text}", place or self._place() or None, do)

    def refuse(self, gave: str, do: str) -> NoReturn:
        """Raise a ``UserError``: the code ``gave`` a wrong value; with the place where the code begins."""
        raise UserError(f"{self.title} {gave}", self._place() or None, do)

    def _place(self) -> str:
        """Where the code begins; for an environment the user's layers, the outermost first, else the innermost."""
        spans = [span for layer in layers(self.target) if (span := self._span(layer))]
        theirs = [span for span in spans if not span[0].startswith(_libraries())]
        return ", around ".join(dict.fromkeys(_place(*span[:2]) for span in theirs or spans[-1:]))

    def _span(self, target: Any) -> tuple[str, int, int] | None:
        """File, first line and number of lines of the method, function or class; None if Python does not know."""
        try:
            target = inspect.unwrap(getattr(target, self.method) if self.method else getattr(target, "func", target))
            target = target if inspect.isroutine(target) or inspect.isclass(target) else type(target)
            source, first = inspect.getsourcelines(target)
            return inspect.getsourcefile(target) or "", first, len(source)
        except Exception:  # noqa: BLE001 - user objects may raise anything
            return None

    def _in_it(self, frame: traceback.FrameSummary) -> bool:
        """Whether a frame is one of the method, function or class."""
        file, first, count = self._span(self.target) or ("", 0, 0)
        return frame.filename == file and first <= (frame.lineno or 0) < first + count

    def truth(self, value: Any, name: str) -> bool:
        """A truth value, or 0 or 1, from Python or any array library."""
        if value is True or value is False:
            return value
        plain = _plain(value)
        if not isinstance(plain, bool | int | float) or plain not in (0, 1):
            self.refuse(f"gave {name} {_quoted(repr, value)}", "Give True or False.")
        return bool(plain)

    def number(self, value: Any, name: str) -> float:
        """A finite number within float32's range, from Python or any array library."""
        plain = value if type(value) is float else _plain(value)
        if not isinstance(plain, float | int) or not -MAX_FLOAT32 <= plain <= MAX_FLOAT32:
            self.refuse(f"gave {name} {_quoted(repr, value)}", "Give a finite number.")
        return float(plain)

    def choice(self, value: Any, name: str, count: int) -> int:
        """One of the numbers 0 .. count - 1."""
        number = as_number(value)
        if number is None or not 0 <= number < count:
            self.refuse(f"gave {name} {_quoted(repr, value)}", f"Give an integer, 0 to {count - 1}.")
        return number


def users_own(error: BaseException) -> UserError | None:
    """An error raised in or through user code outside all blocks, as a ``UserError``; None for other errors."""
    if isinstance(error, UserError | NumericalError):
        return None
    passed = [_module(frame) for frame, _ in traceback.walk_tb(error.__traceback__)]
    culprit = next((module for module in passed if module in _own), None)
    return UsersCode(f"user code in {culprit}").error_for(error) if culprit else None


def as_number(value: Any) -> int | None:
    """An integer from Python or any array library; None for anything else, also for a truth value.

    An array of one integer counts: agents of one environment return such.
    """
    if getattr(value, "size", None) == 1:
        value = value.item()
    if isinstance(value, bool):
        return None
    try:
        return operator.index(value)
    except TypeError:
        return None


def _plain(value: Any) -> Any:
    """A scalar of any array library as Python's number; anything else unchanged."""
    return value.item() if getattr(value, "shape", None) == () else value


def layers(env: Any) -> list[Any]:
    """An environment's wrappers and itself, the outermost first; for any other object a list of it alone."""
    wrappers = [env]
    while hasattr(type(env), "unwrapped") and (env := getattr(env, "__dict__", {}).get("env")) is not None:
        wrappers.append(env)
    return wrappers


@functools.cache
def _libraries() -> tuple[str, ...]:
    """Prefixes of the files that are not user code: Python's, installed packages' and hypogoal's."""
    folders = (*(sysconfig.get_path(kind) for kind in ("stdlib", "purelib", "platlib")), Path(__file__).parents[1])
    return (*(f"{folder}{os.sep}" for folder in folders), "<")


def _module(frame: FrameType) -> str:
    return str(frame.f_globals.get("__name__")).partition(".")[0]


def _place(file: str, line: int | None) -> str:
    return f"{Path(file).name}, line {line}"


def _quoted(how: Callable[[object], str], value: object) -> str:
    """The text of a value or an error of user code, shortened; its type's name if the text itself raises."""
    try:
        text = " ".join(how(value).split())
    except Exception:  # noqa: BLE001 - see above
        text = f"a {type(value).__name__}"
    return text if len(text) <= MOST_QUOTED else f"{text[:MOST_QUOTED]}..."
