"""hypogoal: transferable sub-goals by hypothesising which features generalise.

Its environments are registered with Gymnasium if that was imported before, else by :mod:`hypogoal.envs`. Heavy parts
(torch, the environments' modules) are imported on first use, so that ``import hypogoal`` and ``--help`` stay fast.
"""

import importlib
import sys
from typing import TYPE_CHECKING, Any

__version__ = "1.1.0"

if TYPE_CHECKING:
    from hypogoal.api import compare, load_ensemble, load_options
    from hypogoal.core.errors import UserError
    from hypogoal.domains.gymnasium.domain import GymnasiumDomain
    from hypogoal.look import Made
    from hypogoal.options.env import OptionEnv
    from hypogoal.options.reward import SubgoalReward
    from hypogoal.stages.collect import collect
    from hypogoal.stages.evaluate import evaluate
    from hypogoal.stages.report import report
    from hypogoal.stages.train_baseline import train_baseline
    from hypogoal.stages.train_ensemble import train_ensemble
    from hypogoal.stages.train_meta import train_meta
    from hypogoal.stages.train_options import train_options

_HOMES = {  # where each name is imported from on first use
    "GymnasiumDomain": "domains.gymnasium.domain",
    "Made": "look",
    "OptionEnv": "options.env",
    "SubgoalReward": "options.reward",
    "UserError": "core.errors",
    "collect": "stages.collect",
    "compare": "api",
    "evaluate": "stages.evaluate",
    "load_ensemble": "api",
    "load_options": "api",
    "report": "stages.report",
    "train_baseline": "stages.train_baseline",
    "train_ensemble": "stages.train_ensemble",
    "train_meta": "stages.train_meta",
    "train_options": "stages.train_options",
}
__all__ = [
    "GymnasiumDomain", "Made", "OptionEnv", "SubgoalReward", "UserError", "__version__", "collect", "compare",
    "evaluate", "load_ensemble", "load_options", "report", "train_baseline", "train_ensemble", "train_meta",
    "train_options",
]  # fmt: skip


def __getattr__(name: str) -> Any:
    if name not in _HOMES:
        raise AttributeError(f"module 'hypogoal' has no attribute {name!r}")
    importlib.import_module("hypogoal.envs")
    return getattr(importlib.import_module(f"hypogoal.{_HOMES[name]}"), name)


def __dir__() -> list[str]:
    return __all__


if "gymnasium" in sys.modules:
    # Not otherwise: importing Gymnasium takes longer than the rest of this package.
    importlib.import_module("hypogoal.envs")
