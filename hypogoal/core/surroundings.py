"""Isolation from the current folder and home: libraries load the same wherever a command is started.

matplotlib obeys a ``matplotlibrc`` in the current folder, which may make it start LaTeX; OpenCV puts the current folder
on the path where the system looks for libraries of child processes, so that code there would run.
"""

import contextlib
import os
import sys
from collections.abc import Callable, Iterator
from types import ModuleType
from typing import Any

LIBRARIES = "LD_LIBRARY_PATH"
Context = Callable[[ModuleType], contextlib.AbstractContextManager[object]]


class Around:
    """A finder for ``sys.meta_path``: a module is loaded within a context, whoever imports it first."""

    def __init__(self, name: str, context: Context):
        self.name, self.context = name, context

    def find_spec(self, name: str, *place: Any) -> Any:
        """The module's spec; None for any other module."""
        if name != self.name:
            return None
        specs = (finder.find_spec(name, *place) for finder in sys.meta_path if finder is not self)
        spec: Any = next(filter(None, specs), None)
        if loader := getattr(spec, "loader", None):
            load = loader.exec_module

            def load_within(module: ModuleType) -> None:
                with self.context(module):
                    load(module)

            loader.exec_module = load_within
        return spec


def close_library_path() -> None:
    """Keep the current folder off the path of libraries, where an empty part means that folder.

    OpenCV adds the variable, or an empty part in its place, to its own: so it must not be empty.
    """
    os.environ[LIBRARIES] = ":".join(filter(None, os.environ.get(LIBRARIES, "").split(":"))) or os.devnull


def shield() -> None:
    """Isolate a process of hypogoal, before it loads libraries.

    Not for hypogoal as a library: there matplotlib is also the user's, with the user's settings.
    """
    if not any(isinstance(finder, Around) and finder.name == "matplotlib" for finder in sys.meta_path):
        sys.meta_path.insert(0, Around("matplotlib", _plain_matplotlib))


@contextlib.contextmanager
def environment(**values: str) -> Iterator[None]:
    """Set environment variables within the block."""
    before = {name: os.environ.get(name) for name in values}
    os.environ.update(values)
    try:
        yield
    finally:
        for name, value in before.items():
            os.environ.pop(name, None)
            os.environ.update({} if value is None else {name: value})


@contextlib.contextmanager
def _plain_matplotlib(module: ModuleType) -> Iterator[None]:
    """Load matplotlib in its own folder, since it looks for settings and styles in the current one first."""
    folder = os.path.dirname(str(module.__file__))
    with contextlib.chdir(folder), environment(MATPLOTLIBRC=os.devnull, MPLBACKEND="agg"):
        yield
    module.get_configdir = lambda: folder  # type: ignore[attr-defined]
