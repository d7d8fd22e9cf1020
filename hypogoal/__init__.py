"""hypogoal: transferable sub-goals by hypothesising which features generalise.

Its environments are registered with Gymnasium. The heavy parts (torch, the environments' own modules) are imported on
first use, so that ``import hypogoal`` and the command line's ``--help`` stay fast.
"""

import importlib
from typing import TYPE_CHECKING, Any

import gymnasium

__version__ = "0.9.0"

if TYPE_CHECKING:
    from hypogoal.api import OptionEnv, load_ensemble, load_options
    from hypogoal.core.errors import UserError
    from hypogoal.domains.gymnasium_domain import GymnasiumDomain
    from hypogoal.hypotheses.wrappers import SubgoalReward, SubgoalTermination

_LAZY = {"GymnasiumDomain": "hypogoal.domains.gymnasium_domain", "UserError": "hypogoal.core.errors"}
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
    if name in __all__:
        return getattr(importlib.import_module(_LAZY.get(name, "hypogoal.api")), name)
    raise AttributeError(f"module 'hypogoal' has no attribute {name!r}")


def __dir__() -> list[str]:
    return __all__


# As packages with environments do: Gymnasium finds them once this one is imported. Their modules are loaded when one
# is made.
gymnasium.register(id="hypogoal/DoorKey-8x8-v0", entry_point="hypogoal.domains.doorkey_env:DoorKeyEnv")
gymnasium.register(id="hypogoal/MontezumaLadder-v0", entry_point="hypogoal.domains.montezuma_env:MontezumaLadder")
