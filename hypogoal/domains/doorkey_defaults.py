"""DoorKey's own defaults, by stage: apart from the domain, which takes time to load."""

from collections.abc import Mapping
from types import MappingProxyType
from typing import Any

# So that options behind other options learn in time.
LEARNING: Mapping[str, Any] = MappingProxyType({"epsilon_steps": 2_000, "update_interval": 8})
DEFAULTS = MappingProxyType({"train-options": LEARNING, "train-meta": LEARNING})
SOURCES = MappingProxyType(dict.fromkeys(DEFAULTS, "ours: docs/results/history.md"))
