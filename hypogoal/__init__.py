"""hypogoal: transferable sub-goals by hypothesising which features generalise.

Its environments are registered with Gymnasium if that was imported before, else by :mod:`hypogoal.envs`. Heavy parts
(torch, the environments' modules) are imported on first use, so that ``import hypogoal`` and ``--help`` stay fast.
"""

import importlib
import sys
from typing import TYPE_CHECKING, Any

__version__ = "0.25.0"

if TYPE_CHECKING:
    from hypogoal.api import Made, OptionEnv, collect, compare, evaluate, load_ensemble, load_options, report
    from hypogoal.api import train_baseline, train_ensemble, train_meta, train_options  # isort: skip
    from hypogoal.core.errors import UserError
    from hypogoal.domains.gymnasium.domain import GymnasiumDomain
    from hypogoal.hypotheses.wrappers import SubgoalReward

_LAZY = {
    "GymnasiumDomain": "hypogoal.domains.gymnasium.domain",
    "UserError": "hypogoal.core.errors",
}
__all__ = [
    "GymnasiumDomain", "Made", "OptionEnv", "SubgoalReward", "UserError", "__version__", "collect", "compare",
    "evaluate", "load_ensemble", "load_options", "report", "train_baseline", "train_ensemble", "train_meta",
    "train_options",
]  # fmt: skip


def __getattr__(name: str) -> Any:
    if name in __all__:
        importlib.import_module("hypogoal.envs")
        return getattr(importlib.import_module(_LAZY.get(name, "hypogoal.api")), name)
    raise AttributeError(f"module 'hypogoal' has no attribute {name!r}")


def __dir__() -> list[str]:
    return __all__


if "gymnasium" in sys.modules:
    # Not otherwise: importing Gymnasium takes longer than the rest of this package.
    importlib.import_module("hypogoal.envs")
