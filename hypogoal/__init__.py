"""hypogoal: transferable sub-goals by hypothesising which features generalise.

If Gymnasium was imported before, hypogoal's environments are registered with it now, otherwise by :mod:`hypogoal.envs`.
Heavy parts (torch, the environments' modules) are imported on first use, so that ``import hypogoal`` and ``--help``
stay fast.
"""

import importlib
import sys
from typing import Any

__version__ = "1.1.0"

_HOMES = {  # where each name is imported from on first use; __init__.pyi has the signatures, for editors
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
    # Only then, because importing Gymnasium takes longer than the rest of this package.
    importlib.import_module("hypogoal.envs")
