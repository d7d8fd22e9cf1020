"""hypogoal: transferable sub-goals by hypothesising which features generalise.

The heavy parts (torch, the environments) are imported on first use, so that ``import hypogoal`` and the
command line's ``--help`` stay fast.
"""

from __future__ import annotations

import sys
from typing import TYPE_CHECKING, Any

__version__ = "0.2.0"

if TYPE_CHECKING:
    from hypogoal.api import OptionEnv, load_ensemble, load_options
    from hypogoal.domains.gymnasium_domain import GymnasiumDomain
    from hypogoal.hypotheses.wrappers import SubgoalReward, SubgoalTermination

_LAZY = {
    "GymnasiumDomain": "hypogoal.domains.gymnasium_domain",
    "load_ensemble": "hypogoal.api",
    "load_options": "hypogoal.api",
    "OptionEnv": "hypogoal.api",
    "SubgoalReward": "hypogoal.api",
    "SubgoalTermination": "hypogoal.api",
}
__all__ = [
    "GymnasiumDomain",
    "OptionEnv",
    "SubgoalReward",
    "SubgoalTermination",
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

    Done by ``import hypogoal`` where Gymnasium is imported already, else by the first use of hypogoal's interface.
    """
    from hypogoal.domains.doorkey_registration import register as register_doorkey
    from hypogoal.domains.montezuma_registration import register as register_montezuma

    register_doorkey()
    register_montezuma()


if "gymnasium" in sys.modules:
    register()
