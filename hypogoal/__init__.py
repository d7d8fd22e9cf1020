"""hypogoal: transferable sub-goals by hypothesising which features generalise.

Its environments are registered with Gymnasium. The heavy parts (torch, the environments' modules) are imported on first
use, so that ``import hypogoal`` and the command line's ``--help`` stay fast.
"""

import contextlib
import importlib
import sys
from collections.abc import Iterator
from typing import TYPE_CHECKING, Any

from hypogoal.core.surroundings import Around, close_library_path

__version__ = "0.24.0"

if TYPE_CHECKING:
    from hypogoal.api import Made, OptionEnv, collect, compare, evaluate, load_ensemble, load_options
    from hypogoal.api import train_ensemble, train_meta, train_options  # isort: skip
    from hypogoal.core.errors import UserError
    from hypogoal.domains.gymnasium_domain import GymnasiumDomain
    from hypogoal.hypotheses.wrappers import SubgoalReward

_LAZY = {
    "GymnasiumDomain": "hypogoal.domains.gymnasium_domain",
    "UserError": "hypogoal.core.errors",
}
__all__ = [
    "GymnasiumDomain", "Made", "OptionEnv", "SubgoalReward", "UserError", "__version__", "collect",
    "compare", "evaluate", "load_ensemble", "load_options", "train_ensemble", "train_meta", "train_options",
]  # fmt: skip


def __getattr__(name: str) -> Any:
    if name in __all__:
        return getattr(importlib.import_module(_LAZY.get(name, "hypogoal.api")), name)
    raise AttributeError(f"module 'hypogoal' has no attribute {name!r}")


def __dir__() -> list[str]:
    return __all__


@contextlib.contextmanager
def _registered(_gymnasium: object = None) -> Iterator[None]:
    """Register the environments once Gymnasium is loaded; their modules are loaded when one is made."""
    yield
    from gymnasium import register

    register(id="hypogoal/DoorKey-8x8-v0", entry_point="hypogoal.domains.doorkey_env:DoorKeyEnv")
    register(id="hypogoal/MontezumaLadder-v0", entry_point="hypogoal.domains.montezuma_env:MontezumaLadder")


if "gymnasium" in sys.modules:
    with _registered():
        pass
else:
    # Importing Gymnasium here would take longer than the rest of this package. An entry point ``gymnasium.envs`` would
    # need an installed package and load hypogoal in every program that uses Gymnasium.
    sys.meta_path.insert(0, Around("gymnasium", _registered))
close_library_path()
