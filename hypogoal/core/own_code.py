"""Code of the user's own, named as ``module:object``, and code that others installed, named by an entry point.

``module:object`` is code that will run. It is loaded where the user gave that name, not because a data file, a manifest
or a preset, which may be a stranger's, has it in it: then the user allows it by the environment variable
``HYPOGOAL_TRUST`` (several names with commas between). What is installed needs no permission.

Here alone is it decided whose word a name is. The command of a sweep's cell comes from a file, however it is spelt: the
process that runs it is told so (:func:`environment_of_children`), and in it nothing is the user's but what is allowed.

Whatever such code does, raises or gives back ends as one line that says where it is: :class:`UsersCode`.
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
import threading
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
MOST = 3.4028234663852886e38  # float32's: rewards are kept as such
LONGEST = 200  # signs of what own code says that are quoted
_given: ContextVar[frozenset[str]] = ContextVar("_given", default=frozenset())
_before: set[str] = set()  # all that were ever given in this process
_own: set[str] = set()  # top-level modules that were loaded by name and are not hypogoal's


def given(*names: str) -> contextlib.AbstractContextManager[None]:
    """Within the block ``module:object`` among these names may be loaded: the user's own words, if no file's."""
    return vouched(*([] if os.environ.get(OF_FILE) else names))


@contextlib.contextmanager
def vouched(*names: str) -> Iterator[None]:
    """Within the block these names may be loaded: code that runs already says them, such as a domain its network."""
    token = _given.set(_given.get() | set(names))
    _before.update(names)
    try:
        yield
    finally:
        _given.reset(token)


def allowed() -> frozenset[str]:
    """The ``module:object`` that may be loaded here: what the user gave, and what ``HYPOGOAL_TRUST`` names."""
    return frozenset(name.strip() for name in (*_given.get(), *in_environment()) if ":" in name)


def allowed_before() -> frozenset[str]:
    """The ``module:object`` that the user allowed at some time in this process."""
    return frozenset({*_before, *in_environment()})


def in_environment() -> list[str]:
    """What ``HYPOGOAL_TRUST`` names."""
    return [name for text in os.environ.get(TRUST, "").split(",") if ":" in (name := text.strip())]


def permission(names: Iterable[str]) -> str:
    """``HYPOGOAL_TRUST`` as one sets it in a shell to allow these names."""
    return f"{TRUST}={shlex.quote(','.join(dict.fromkeys(names)))}"


def environment_of_children() -> dict[str, str]:
    """For a process whose command is a file's: what is allowed here is allowed there, whatever its own words are."""
    return {TRUST: ",".join(sorted(allowed())), OF_FILE: "1"}


def require_trust(name: str, what: str) -> None:
    """Refuse (``UserError``) to load ``module:object`` that the user neither gave nor allowed; other names pass.

    ``what`` it is to be ("domain") stands in the message.
    """
    if ":" in name and name not in allowed():
        do = f"Do you trust it? Set {permission([name, *in_environment()])}"
        raise UserError(f"a file names code of its own as its {what}", name, do)


def load_own(name: str, what: str, group: str, built_in: Mapping[str, str]) -> Any:
    """What ``name`` stands for: one of ``built_in``, an installed entry point of ``group``, or ``module:object``.

    Modules of the current folder can be loaded too, whichever way hypogoal was started; installed ones come first. No
    such name, one that cannot be loaded, or code that the user did not allow is a ``UserError``; ``what`` it is
    ("domain") stands in the message.
    """
    entries = {entry.name: entry.value for entry in metadata.entry_points(group=group)}
    target = built_in.get(name) or entries.get(name)
    if target is None and ":" in name:
        require_trust(name, what)
        if "" not in sys.path and os.getcwd() not in sys.path:
            sys.path.append(os.getcwd())
        target = name
    if target is None:
        names = ", ".join(sorted({*built_in, *entries}))
        raise UserError(f"unknown {what}", name, f"Choose one of {names}, or give module:object.")
    module, _, attribute = target.partition(":")
    if name not in built_in and not target.startswith("hypogoal."):
        _own.add(module.partition(".")[0])
    with UsersCode(f"the {what}", name, failed="cannot be loaded:"):
        loaded = importlib.import_module(module)
        return getattr(loaded, attribute) if attribute else loaded


class _Running(threading.local):
    blocks = 0  # of UsersCode that this thread is in


_running = _Running()
_exit = os._exit


def _stay(status: int) -> NoReturn:
    """``os._exit``, which as a call of own code would end a stage without a word and, with 0, as a success.

    Nothing can be told after it, so it is replaced while own code may call it; multiprocessing, our own workers and a
    child that own code forked end by the real one. C code that ends the process is beyond this.
    """
    if _running.blocks or _module(sys._getframe(1)) in _own:
        raise SystemExit(status)
    _exit(status)


os._exit = _stay
if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=lambda: setattr(os, "_exit", _exit))


class UsersCode:
    """A block in which own code runs, and the one place where what it gives back becomes what hypogoal needs.

    Whatever it raises (``SystemExit`` too, but not Ctrl-C) and whatever it gives that is not as promised is told as one
    line with its place, as the user's to mend. The block is around every step of an environment: keep it cheap.

    ``what`` says whose code it is ("the label function of won"), ``of`` is the function, or the object that has
    ``method``, or a text, what the user calls it; ``failed`` stands between ``what`` and the exception.
    """

    __slots__ = ("failed", "method", "target", "title")

    def __init__(self, title: str, target: object = None, method: str = "", *, failed: str = "raised"):
        self.title, self.target, self.method, self.failed = title, target, method, failed

    def __enter__(self) -> Self:
        _running.blocks += 1
        return self

    def __exit__(self, kind: object, error: BaseException | None, trace: object) -> None:
        _running.blocks -= 1
        if error is None or isinstance(error, KeyboardInterrupt):
            return
        if not isinstance(error, UserError) or isinstance(error, Complete):  # which would say that all is well
            raise self._told(error) from error

    def _told(self, error: BaseException) -> UserError:
        do = "Mend it; --debug shows how it was called."
        if isinstance(self.target, str):
            do = "Check the module and the object; --debug shows where."
        text = f"{type(error).__name__}: {_quoted(str, error)}"
        if isinstance(error, SystemExit):
            text, do = f"{_quoted(repr, error)}, to end the program", "Have it raise an error that says what is wrong."
        frames = traceback.extract_tb(error.__traceback__)
        theirs = [frame for frame in frames if not frame.filename.startswith(_libraries())]
        if inspect.isclass(self.target) and not any(self._in_it(frame) for frame in theirs):
            theirs = []  # it raised in what called it, since it cannot be called so, or gave what it should not
        place = _place(theirs[-1].filename, theirs[-1].lineno) if theirs else ""
        if isinstance(self.target, str):
            place = f"{self.target} ({place})" if place else self.target
        return UserError(f"{self.title} {self.failed} {text}", place or self._place() or None, do)

    def refuse(self, gave: str, do: str) -> NoReturn:
        """Tell (``UserError``) that what it gave is not what it promised to, with the place where the code begins."""
        raise UserError(f"{self.title} {gave}", self._place() or None, do)

    def _place(self) -> str:
        """Where the code begins; of an environment the user's own layers, the outermost first, else the innermost."""
        spans = [span for layer in layers(self.target) if (span := self._span(layer))]
        theirs = [span for span in spans if not span[0].startswith(_libraries())]
        return ", around ".join(dict.fromkeys(_place(*span[:2]) for span in theirs or spans[-1:]))

    def _span(self, target: Any) -> tuple[str, int, int] | None:
        """File, first line and number of lines of the method, function or class; None where Python does not know."""
        try:
            target = inspect.unwrap(getattr(target, self.method) if self.method else getattr(target, "func", target))
            target = target if inspect.isroutine(target) or inspect.isclass(target) else type(target)
            source, first = inspect.getsourcelines(target)
            return inspect.getsourcefile(target) or "", first, len(source)
        except Exception:  # noqa: BLE001 - whatever own objects do when they are asked
            return None

    def _in_it(self, frame: traceback.FrameSummary) -> bool:
        """Whether a frame is one of the method, function or class."""
        file, first, count = self._span(self.target) or ("", 0, 0)
        return frame.filename == file and first <= (frame.lineno or 0) < first + count

    def truth(self, value: Any, name: str) -> bool:
        """A truth value, or a number that is 0 or 1, of Python's or of any array library's."""
        if value is True or value is False:
            return value
        plain = _plain(value)
        if not isinstance(plain, bool | int | float) or plain not in (0, 1):
            self.refuse(f"gave {name} {_quoted(repr, value)}", "Give True or False.")
        return bool(plain)

    def number(self, value: Any, name: str) -> float:
        """A finite number that float32 holds, of Python's or of any array library's."""
        plain = value if type(value) is float else _plain(value)
        if not isinstance(plain, float | int) or not -MOST <= plain <= MOST:
            self.refuse(f"gave {name} {_quoted(repr, value)}", "Give a finite number.")
        return float(plain)

    def choice(self, value: Any, name: str, count: int) -> int:
        """One of the numbers 0 .. count - 1."""
        number = as_number(value)
        if number is None or not 0 <= number < count:
            self.refuse(f"gave {name} {_quoted(repr, value)}", f"Give an integer, 0 to {count - 1}.")
        return number


def users_own(error: BaseException) -> UserError | None:
    """An error that came from or through own code outside all blocks, told as the user's; None where it did not."""
    if isinstance(error, UserError | NumericalError):
        return None
    passed = [_module(frame) for frame, _ in traceback.walk_tb(error.__traceback__)]
    culprit = next((module for module in passed if module in _own), None)
    return UsersCode(f"own code of {culprit}")._told(error) if culprit else None


def as_number(value: Any) -> int | None:
    """An integer of Python's or of any array library's; None where it is something else, a truth value among it.

    An array of one integer is that integer: agents of one environment give such.
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
    """Python's number of a scalar of any array library's; anything else as it is."""
    return value.item() if getattr(value, "shape", None) == () else value


def layers(env: Any) -> list[Any]:
    """An environment's wrappers and itself, the outermost first; anything else alone."""
    wrappers = [env]
    while hasattr(type(env), "unwrapped") and (env := getattr(env, "__dict__", {}).get("env")) is not None:
        wrappers.append(env)
    return wrappers


@functools.cache
def _libraries() -> tuple[str, ...]:
    """What the names of files begin with that are nobody's own code: Python's, installed packages' and ours."""
    folders = (*(sysconfig.get_path(kind) for kind in ("stdlib", "purelib", "platlib")), Path(__file__).parents[1])
    return (*(f"{folder}{os.sep}" for folder in folders), "<")


def _module(frame: FrameType) -> str:
    return str(frame.f_globals.get("__name__")).partition(".")[0]


def _place(file: str, line: int | None) -> str:
    return f"{Path(file).name}, line {line}"


def _quoted(how: Callable[[object], str], value: object) -> str:
    """What a value or an error of own code says of itself, which may be long, or may fail as well."""
    try:
        text = " ".join(how(value).split())
    except Exception:  # noqa: BLE001 - see above
        text = f"a {type(value).__name__}"
    return text if len(text) <= LONGEST else f"{text[:LONGEST]}..."
