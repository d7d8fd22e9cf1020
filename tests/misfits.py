"""States of checkpoints with one thing in them that is not what a stage keeps."""

from collections.abc import Iterator
from typing import Any

import numpy as np
import torch


def misfits(state: dict[str, Any], free: tuple[str, ...] = ()) -> Iterator[str]:
    """Change each place in turn, yield what was done, undo it: no key, another key, another type, dtype or shape.

    Of a list only the first item is changed; dicts at the places ``free`` may have any keys.
    """

    def changed(owner: Any, key: Any, value: Any, what: str) -> Iterator[str]:
        before, owner[key] = owner[key], value
        yield what
        owner[key] = before

    def walk(value: Any, place: str) -> Iterator[str]:
        if isinstance(value, dict) and place not in free:
            value["odd"] = 1
            yield f"another key in {place}"
            del value["odd"]
        for key in [*value] if isinstance(value, dict) else range(min(1, len(value))):
            item, where = value[key], f"{place}/{key}"
            if isinstance(value, dict) and place not in free:
                del value[key]
                yield f"no {where}"
                value[key] = item
            yield from changed(value, key, "odd", f"a text at {where}")
            if hasattr(item, "dtype"):
                array = np.asarray(item)
                other = np.zeros(array.shape, np.int16 if array.dtype != np.int16 else np.int32)
                for what, odd in (("dtype", other), ("axis", array[None])):
                    odd = torch.from_numpy(odd.copy()) if isinstance(item, torch.Tensor) else odd
                    yield from changed(value, key, odd, f"another {what} at {where}")
            elif isinstance(item, dict | list):
                yield from walk(item, where)

    yield from walk(state, "")
