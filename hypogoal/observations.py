"""What is a picture, what numbers: types of observations, several of both by key, numbers standardised."""

from __future__ import annotations

import json
from collections.abc import Mapping
from hashlib import blake2b
from math import prod
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import NDArray

from hypogoal.core.files import plain_names

MAX_SIDE = 1 << 16  # of an observation
# Observations are pictures, bytes (H, W, C), or numbers of any shape, which networks see standardised, or several of
# both by key: then of shape (), and of a structured type with a field for each key (:func:`mixed_type`).
PICTURE, NUMBERS = np.dtype(np.uint8), np.dtype(np.float32)
Observations: TypeAlias = NDArray[Any]  # of any of these types
Fields: TypeAlias = dict[str, tuple[np.dtype[Any], tuple[int, ...]]]  # type and shape, by key
Standard: TypeAlias = tuple[NDArray[np.float32], NDArray[np.float32]]  # mean and deviation of numbers
DEVIATIONS = 10.0  # numbers are clipped this far from their mean: beyond, nothing was learned
MOST_ROWS = 20_000  # states from which mean and deviation are computed


def digest(observation: Observations, labels: bytes | bytearray = b"") -> bytes:
    """16 bytes that identify an observation among those of its shape and type, together with its labels."""
    return blake2b(observation.tobytes() + labels, digest_size=16).digest()


def fields_of(shape: tuple[int, ...], dtype: np.dtype[Any]) -> Fields:
    """Type and shape of an observation's parts by key; of one that is not mixed, its only part's, without a key."""
    return {key: (dtype[key].base, dtype[key].shape) for key in dtype.names} if dtype.names else {"": (dtype, shape)}


def values_in(shape: tuple[int, ...], dtype: np.dtype[Any]) -> int:
    """How many values an observation has, bytes of pictures and numbers."""
    return sum(prod(size) for _, size in fields_of(shape, dtype).values())


def mixed_type(fields: Fields) -> np.dtype[Any]:
    """The type of observations with these parts, sorted by key; malformed ones are a ``ValueError``."""
    sizes = [size for _, shape in fields.values() for size in (len(shape), *shape)]
    if not plain_names(list(fields)) or not all(type(size) is int and 0 < size <= MAX_SIDE for size in sizes):
        raise ValueError(fields)
    return np.dtype([(key, dtype.str, shape) for key, (dtype, shape) in sorted(fields.items())])


def type_text(dtype: np.dtype[Any]) -> str:
    """An observation's type as files keep it: ``uint8``, ``float32``, or JSON of ``{key: [type, shape]}``."""
    parts = {key: [str(kind), list(shape)] for key, (kind, shape) in fields_of((), dtype).items()}
    return json.dumps(parts) if dtype.names else str(dtype)


def type_of(text: object) -> np.dtype[Any]:
    """The type that :func:`type_text` wrote; anything else is a ``ValueError``."""
    plain = {str(dtype): dtype for dtype in (PICTURE, NUMBERS)}
    if text in plain:
        return plain[str(text)]
    try:
        parts = json.loads(text) if isinstance(text, str) else {}
        return mixed_type({key: (plain[kind], tuple(shape)) for key, (kind, shape) in parts.items()})
    except (TypeError, KeyError, AttributeError, RecursionError):
        raise ValueError(text) from None


def packed(parts: Mapping[str, Any], dtype: np.dtype[Any] | None = None) -> Observations:
    """Mixed observations (N,) from arrays (N, ...) by key, all that ``dtype`` has if given; else a ``ValueError``."""
    arrays = {key: np.asarray(values) for key, values in parts.items()}
    arrays = {key: values.astype(NUMBERS) if values.dtype == np.float64 else values for key, values in arrays.items()}
    stored = mixed_type({key: (values.dtype, values.shape[1:]) for key, values in arrays.items()})
    lengths = {len(values) for values in arrays.values()}
    if len(lengths) > 1 or (dtype is not None and stored != dtype):
        raise ValueError(f"{type_text(stored)}, of lengths {lengths}")
    states = np.empty(lengths.pop(), stored)
    for key, values in arrays.items():
        states[key] = values
    return states


def numbers_of(observations: Observations) -> NDArray[np.float32]:
    """All numbers of observations (N, ...), in a row each, float32 (N, D)."""
    rows = [
        (observations[key] if key else observations).reshape(len(observations), prod(shape))
        for key, (dtype, shape) in fields_of(observations.shape[1:], observations.dtype).items()
        if dtype == NUMBERS
    ]
    return rows[0] if len(rows) == 1 else np.concatenate([np.zeros((len(observations), 0), NUMBERS), *rows], axis=1)


def standard_of(shape: tuple[int, ...], *observations: Observations) -> Standard:
    """Mean and deviation (*shape) of numbers (N, *shape); the deviation is 1 where they hardly vary, or without any."""
    rows = [states[:: 1 + len(states) // MOST_ROWS] for states in observations]
    sample = np.concatenate([np.zeros((int(not any(map(len, rows))), *shape), NUMBERS), *rows])
    mean, deviation = sample.mean(0, dtype=np.float64), sample.std(0, dtype=np.float64)
    deviation = np.where(deviation > 1e-6 * np.abs(mean), deviation, 1.0)
    return mean.astype(NUMBERS), deviation.astype(NUMBERS)


def standardised(observations: Any, mean: Any, deviation: Any) -> Any:
    """Numbers (N, *shape), arrays or tensors, in deviations from their mean (*shape)."""
    return ((observations - mean) / deviation).clip(-DEVIATIONS, DEVIATIONS)


def spread_rows(count: int, most: int) -> NDArray[np.int64]:
    """All rows of ``count``, or ``most`` spread evenly, int64 (n,)."""
    return np.linspace(0, count - 1, min(count, most)).astype(np.int64)
