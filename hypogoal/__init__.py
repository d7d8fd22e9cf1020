"""hypogoal: transferable sub-goals by hypothesising which features generalise.

The heavy parts (torch, the environments) are imported on first use, so that ``import hypogoal`` and the
command line's ``--help`` stay fast.
"""

from __future__ import annotations

import sys
from typing import TYPE_CHECKING, Any

__version__ = "0.2.0"

if TYPE_CHECKING:
    from importlib.machinery import ModuleSpec
    from types import ModuleType

    from hypogoal.api import OptionEnv, load_ensemble, load_options
    from hypogoal.core.errors import UserError
    from hypogoal.domains.gymnasium_domain import GymnasiumDomain
    from hypogoal.hypotheses.wrappers import SubgoalReward, SubgoalTermination

_LAZY = {
    "GymnasiumDomain": "hypogoal.domains.gymnasium_domain",
    "load_ensemble": "hypogoal.api",
    "load_options": "hypogoal.api",
    "OptionEnv": "hypogoal.api",
    "SubgoalReward": "hypogoal.api",
    "SubgoalTermination": "hypogoal.api",
    "UserError": "hypogoal.core.errors",
}
__all__ = [
    "GymnasiumDomain",
    "OptionEnv",
    "SubgoalReward",
    "SubgoalTermination",
    "UserError",
    "__version__",
    "load_ensemble",
    "load_options",
]


def __getattr__(name: str) -> Any:
    if name in _LAZY:
        import importlib

        return getattr(importlib.import_module(_LAZY[name]), name)
    raise AttributeError(f"module 'hypogoal' has no attribute {name!r}")


def register() -> None:
    """Register hypogoal's environments with Gymnasium; calling it again does nothing.

    Done by ``import hypogoal`` where Gymnasium is imported already, else as soon as it is.
    """
    from hypogoal.domains.doorkey_registration import register as register_doorkey
    from hypogoal.domains.montezuma_registration import register as register_montezuma

    register_doorkey()
    register_montezuma()


class _AfterGymnasium:
    """Registers the environments when Gymnasium is imported.

    A finder of modules, since Gymnasium (1.0 and later) looks for no entry points of packages that have environments,
    and is too slow to be imported by ``import hypogoal``.
    """

    def __init__(self) -> None:
        self._passed = False  # while it asks the others, and once it is done

    def find_spec(self, name: str, path: object = None, target: object = None) -> ModuleSpec | None:
        """Gymnasium as the other finders find it; once it is loaded, the environments are registered."""
        if name != "gymnasium" or self._passed:
            return None
        import importlib.util

        self._passed = True
        try:
            spec = importlib.util.find_spec(name)
        finally:
            self._passed = False  # who asks may only look whether it is there
        if spec is not None and spec.loader is not None:
            load = spec.loader.exec_module

            def load_and_register(module: ModuleType) -> None:
                load(module)
                self._passed = True
                register()

            spec.loader.exec_module = load_and_register  # type: ignore[method-assign]
        return spec


if "gymnasium" in sys.modules:
    register()
else:
    sys.meta_path.insert(0, _AfterGymnasium())
