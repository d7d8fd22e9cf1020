"""Observations: their shapes and types, and how numbers are standardised.

An observation is a picture, numbers, or mixed. Pictures are uint8 (H, W, C). Numbers are float32 of any shape, and
networks see them in deviations from their mean. A mixed observation has several pictures and numbers by key. Its shape
is (), and its type is a structured type with a field for each key.
"""

import json
from collections.abc import Mapping
from hashlib import blake2b
from math import prod
from typing import Any

import numpy as np

from hypogoal.core.arrays import Array, Floats, Ints
from hypogoal.core.files import plain_names

PICTURE = np.dtype(np.uint8)
NUMBERS = np.dtype(np.float32)
DType = np.dtype[Any]
Shape = tuple[int, ...]
KINDS: dict[str, DType] = {
    "uint8": PICTURE,
    "float32": NUMBERS,
}
Observations = Array  # (N, *shape): pictures, numbers or mixed
Fields = dict[str, tuple[DType, Shape]]  # by key
Standard = tuple[Floats, Floats]  # mean and deviation of numbers
DIGEST = 16  # bytes of a digest
DEVIATIONS = 10.0  # standardised numbers are clipped to this many deviations, because nothing was learned beyond them
MOST_ROWS = 20_000  # the most states of a set from which mean and deviation are computed


def digest(observation: Observations, labels: bytes | bytearray = b"") -> bytes:
    """Return ``DIGEST`` bytes that identify an observation and its labels among observations of one shape and type."""
    content = observation.tobytes() + labels
    return blake2b(content, digest_size=DIGEST).digest()


def fields_of(shape: Shape, dtype: DType) -> Fields:
    """Return the type and shape of an observation's parts by key.

    An observation that is not mixed has one part, with the key "".
    """
    if not dtype.names:
        return {"": (dtype, shape)}
    fields = {}
    for key in dtype.names:
        part = dtype[key]
        fields[key] = (part.base, part.shape)
    return fields


def values_in(shape: Shape, dtype: DType) -> int:
    """Return how many values an observation has, where a value is a byte of a picture or a number."""
    sizes = 0
    for _, size in fields_of(shape, dtype).values():
        sizes += prod(size)
    return sizes


def mixed_type(fields: Fields) -> DType:
    """Return the type of mixed observations with the parts ``fields``, sorted by key.

    Raises ``ValueError`` if a key cannot be a file name, or if a part has no values.
    """
    sizes = [min(shape, default=0) for _, shape in fields.values()]
    are_plain = plain_names([*fields])
    if not are_plain or min(sizes) <= 0:
        raise ValueError(f"malformed observations: {fields}")
    parts = [(key, dtype.str, shape) for key, (dtype, shape) in sorted(fields.items())]
    return np.dtype(parts)


def type_text(dtype: DType) -> str:
    """Return an observation's type as files keep it: ``uint8``, ``float32``, or JSON of ``{key: [type, shape]}``."""
    if not dtype.names:
        return str(dtype)
    parts = {key: [str(kind), shape] for key, (kind, shape) in fields_of((), dtype).items()}
    return json.dumps(parts)


def type_of(text: str) -> DType:
    """Return the type that :func:`type_text` wrote. Raises ``ValueError`` for any other text."""
    if text in KINDS:
        return KINDS[text]
    fields = {}
    try:
        for key, (kind, shape) in json.loads(text).items():
            fields[key] = (KINDS[kind], tuple(shape))
        return mixed_type(fields)
    except (AttributeError, KeyError, TypeError, ValueError):
        raise ValueError(f"observations of type {text}") from None


def is_stored(dtype: DType) -> bool:
    """Return whether files can keep observations of this type, that is, whether :func:`type_of` gives it back."""
    try:
        return type_of(type_text(dtype)) == dtype
    except ValueError:
        return False


def packed(parts: Mapping[str, Any], dtype: DType | None = None) -> Observations:
    """Return mixed observations (N,) made of arrays (N, ...) by key.

    Raises ``ValueError`` if the arrays differ in N, or if they do not have the type ``dtype``, where it is given.
    """
    arrays = {}
    fields = {}
    for key, values in parts.items():
        array = np.asarray(values)
        kind = NUMBERS if array.dtype == float else array.dtype
        arrays[key] = array
        fields[key] = (kind, array.shape[1:])
    stored = mixed_type(fields)
    if dtype is not None and stored != dtype:
        raise ValueError(type_text(stored))
    lengths = {len(array) for array in arrays.values()}
    if len(lengths) > 1:
        raise ValueError(f"states of lengths {lengths}")
    states = np.empty(lengths.pop(), stored)
    for key, array in arrays.items():
        states[key] = array
    return states


def numbers_of(observations: Observations) -> Floats:
    """Return all numbers of observations (N, ...), without their pictures, float32 (N, D)."""
    count = len(observations)
    fields = fields_of(observations.shape[1:], observations.dtype)
    rows = [np.zeros((count, 0), NUMBERS)]
    for key, (dtype, shape) in fields.items():
        if dtype == NUMBERS:
            values = observations[key] if key else observations
            row = values.reshape(count, prod(shape))
            rows.append(row)
    return np.concatenate(rows, axis=1)


def standard_of(shape: Shape, *observations: Observations) -> Standard:
    """Return the mean and the deviation of numbers (N, *shape), float32 (*shape) each.

    The deviation is 1 where the numbers hardly vary. Without ``observations`` the mean is 0, and the deviation is 1.
    """
    rows = [states[:: 1 + len(states) // MOST_ROWS] for states in observations]
    nothing = np.zeros((1, *shape), NUMBERS)
    sample = np.concatenate(rows or [nothing])
    mean = sample.mean(0, dtype=float)
    deviation = sample.std(0, dtype=float)
    varies = deviation > 1e-6 * np.abs(mean)
    scale = np.where(varies, deviation, 1.0)
    return mean.astype(NUMBERS), scale.astype(NUMBERS)


def standardised(observations: Any, mean: Any, deviation: Any) -> Any:
    """Return numbers (N, *shape) in deviations (*shape) from their mean (*shape). All are arrays, or all tensors."""
    deviations = (observations - mean) / deviation
    return deviations.clip(-DEVIATIONS, DEVIATIONS)


def spread_rows(count: int, most: int) -> Ints:
    """Return the numbers of all ``count`` rows, or of ``most`` rows spread evenly over them, int64 (n,)."""
    wanted = min(count, most)
    return np.linspace(0, count - 1, wanted, dtype=int)
