"""Names that keep apart what differs: nothing is averaged over runs that were not made alike."""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Mapping, Sequence
from typing import Any

# Settings that may differ between two runs that are averaged, or that follow from others.
NOT_A_VARIANT = frozenset(
    {"layout_seed", "sub_goals", "observation_shape", "setting", "random_episodes", "workers", "hyperparameters"}
)


def name_apart(bases: Sequence[str], configs: Sequence[Mapping[str, Any]]) -> list[str]:
    """A name for each of n things: its base name, and where settings differ within that, those settings.

    What more than half of the things of one base name have in common goes unsaid.

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
        usual = {key: _usual([_text(other.get(key)) for other in same]) for key in varied}
        said = ((key, _text(own.get(key))) for key in varied)
        suffix = ", ".join(f"{key}={text}" for key, text in said if text != usual[key])
        names.append(f"{base}, {suffix}" if suffix else base)
    return names


def _usual(texts: Sequence[str]) -> str | None:
    """What more than half of them are, None where there is no such thing."""
    text, count = Counter(texts).most_common(1)[0]
    return text if 2 * count > len(texts) else None


def _flat(config: Mapping[str, Any]) -> dict[str, Any]:
    inner = config.get("domain_config") or {}
    return {**inner, **{key: value for key, value in config.items() if key != "domain_config"}}


def _text(value: Any) -> str:
    if value is None:
        return "unset"
    return value if isinstance(value, str) else json.dumps(value, sort_keys=True)
