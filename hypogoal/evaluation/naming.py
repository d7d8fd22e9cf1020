"""Names that keep apart what differs: nothing is averaged over runs that were not made alike."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from typing import Any

# Settings that may differ between two runs that are averaged, or that follow from others.
NOT_A_VARIANT = frozenset(
    {"layout_seed", "sub_goals", "observation_shape", "setting", "random_episodes", "workers", "hyperparameters"}
)


def name_apart(bases: Sequence[str], configs: Sequence[Mapping[str, Any]]) -> list[str]:
    """A name for each of n things: its base name, and where settings differ within that, those settings.

    Args:
        bases: n names.
        configs: n resolved settings; ``domain_config`` inside is looked into.
    """
    flat = [_flat(config) for config in configs]
    names = []
    for base, own in zip(bases, flat, strict=True):
        same = [other for other, name in zip(flat, bases, strict=True) if name == base]
        keys = sorted({key for other in same for key in other} - NOT_A_VARIANT)
        varied = [key for key in keys if len({_text(other.get(key)) for other in same}) > 1]
        suffix = ", ".join(f"{key}={_text(own.get(key))}" for key in varied)
        names.append(f"{base}, {suffix}" if suffix else base)
    return names


def _flat(config: Mapping[str, Any]) -> dict[str, Any]:
    inner = config.get("domain_config") or {}
    return {**inner, **{key: value for key, value in config.items() if key != "domain_config"}}


def _text(value: Any) -> str:
    if value is None:
        return "unset"
    return value if isinstance(value, str) else json.dumps(value, sort_keys=True)
