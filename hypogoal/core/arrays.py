"""Dataclasses of arrays, with a row for each of n things, such as decisions, transitions or lines of a table."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields
from functools import cache
from typing import TYPE_CHECKING, Any, Self, get_args, get_type_hints

import numpy as np
from numpy.typing import NDArray

from hypogoal.core.checkpoints import Resumable, State

if TYPE_CHECKING:
    import torch

Array = NDArray[Any]
Bools = NDArray[np.bool_]
Bytes = NDArray[np.uint8]  # pictures, and the console's memory
Ints = NDArray[np.int64]
Floats = NDArray[np.float32]
Doubles = NDArray[np.float64]


@dataclass(frozen=True)
class Columns(Resumable):
    """Arrays (n, ...), one for each field."""

    def __len__(self) -> int:
        first = next(iter(vars(self).values()))
        return len(first)

    @classmethod
    @cache
    def names(cls) -> tuple[str, ...]:
        """Return the names of the columns, in order."""
        return tuple(field.name for field in fields(cls))

    @classmethod
    @cache
    def types(cls) -> dict[str, type[np.generic]]:
        """Return the NumPy type that each field's annotation names, by the field's name."""
        hints = get_type_hints(cls)
        kinds = {}
        for name in cls.names():
            _shape, dtype = get_args(hints[name])
            kinds[name] = get_args(dtype)[0]
        return kinds

    @classmethod
    def zeros(cls, *shape: int) -> Self:
        """Return columns of zeros, all of shape ``shape``."""
        columns = [np.zeros(shape, dtype) for dtype in cls.types().values()]
        return cls(*columns)

    @classmethod
    def cast(cls, *columns: Any) -> Self:
        """Return columns from one sequence for each column. The sequences may be of any type."""
        types = cls.types().values()
        arrays = map(np.asarray, columns, types)
        return cls(*arrays)

    @classmethod
    def joined(cls, parts: Sequence[Self]) -> Self:
        """Return the rows of all parts, one part after another."""
        each = [vars(part).values() for part in parts]
        alike = zip(*each, strict=True)
        columns = map(np.concatenate, alike)
        return cls(*columns)

    def at(self, rows: Any) -> Self:
        """Return some of the rows. ``rows`` is whatever NumPy takes for an index."""
        columns = [column[rows] for column in vars(self).values()]
        return type(self)(*columns)

    def put(self, rows: Any, values: Self) -> None:
        """Write ``values`` into some of the rows, in place."""
        for name, column in vars(self).items():
            column[rows] = getattr(values, name)

    def snapshot(self) -> State:
        return {name: column.copy() for name, column in vars(self).items()}

    def restore(self, snapshot: Mapping[str, Any]) -> None:
        self.put(slice(None), type(self)(**snapshot))


def tensor(values: Array, device: torch.device) -> torch.Tensor:
    """Return an array as a tensor on a device. On the CPU, the tensor shares the array's memory."""
    import torch

    return torch.from_numpy(values).to(device)
