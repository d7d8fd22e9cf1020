"""Dataclasses of arrays: a row for each of n things, such as decisions, transitions, lines of a table."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields
from functools import cache
from typing import Any, Self, get_args, get_type_hints

import numpy as np

from hypogoal.core.checkpoints import Resumable, State


@dataclass(frozen=True)
class Columns(Resumable):
    """Arrays (n, ...), one for each field."""

    def __len__(self) -> int:
        return len(getattr(self, self.names()[0]))

    @classmethod
    def names(cls) -> tuple[str, ...]:
        """Of the columns, in order."""
        return tuple(field.name for field in fields(cls))

    @classmethod
    @cache
    def types(cls) -> dict[str, type[np.generic]]:
        """The NumPy type that each field's annotation says."""
        hints = get_type_hints(cls)
        return {name: get_args(get_args(hints[name])[1])[0] for name in cls.names()}

    @classmethod
    def zeros(cls, *shape: int) -> Self:
        """So many rows of zeros, for all columns alike."""
        return cls(*(np.zeros(shape, kind) for kind in cls.types().values()))

    @classmethod
    def cast(cls, *columns: Any) -> Self:
        """From a sequence for each column, of whatever type."""
        return cls(*(np.asarray(values, kind) for values, kind in zip(columns, cls.types().values(), strict=True)))

    @classmethod
    def joined(cls, parts: Sequence[Self]) -> Self:
        """The rows of all parts, one part after another."""
        return cls(*(np.concatenate([getattr(part, name) for part in parts]) for name in cls.names()))

    def at(self, rows: Any) -> Self:
        """Some rows, by whatever NumPy takes for an index."""
        return type(self)(*(getattr(self, name)[rows] for name in self.names()))

    def snapshot(self) -> State:
        return {name: getattr(self, name).copy() for name in self.names()}

    def restore(self, snapshot: Mapping[str, Any]) -> None:
        self.put(slice(None), type(self)(**snapshot))

    def put(self, rows: Any, values: Self) -> None:
        """Write other values into some rows, in place."""
        for name in self.names():
            getattr(self, name)[rows] = getattr(values, name)
