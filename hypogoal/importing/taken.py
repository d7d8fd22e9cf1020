"""What is taken for what: states as read become pictures or numbers, key by key (the table in docs/own-domain.md)."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from hypogoal.core.errors import UserError
from hypogoal.domains.observations import CLEARLY, Reading, reading_of, shrunk_picture
from hypogoal.importing.parts import Source
from hypogoal.observations import NUMBERS, PICTURE, packed, spread_rows, type_text

STACKED = "'import --stack' puts stacked frames among the channels."
MOST_COMPARED = 2_000  # rows of numbers that are compared before and after the cast to float32, spread evenly
NAMED = 4  # columns that a message names


def side_of(sides: Mapping[str, int], key: str, picture: bool) -> int:
    """The most pixels on the longer side of a key, 0: any. What is said of no key ("") is of all pictures."""
    return sides.get(key, sides.get("", 0) if picture else 0)


def taken_one(value: NDArray[Any], where: str, side: int, stack: bool) -> NDArray[Any]:
    """One state as read: a picture as uint8 (H, W, C), at most ``side`` pixels long if that is not 0; or numbers.

    ``stack``: axes of frames and colours become channels. What could be either is a ``UserError``.
    """
    value = np.asarray(value)
    reading = _readable(value.shape, value.dtype, where, stack)
    if reading.dtype != PICTURE:
        return value.reshape(reading.shape)
    picture = reading.arranged(value[None])[0]
    return shrunk_picture(picture, side) if side else picture


def _readable(shape: tuple[int, ...], dtype: np.dtype[Any], where: str, stack: bool) -> Reading:
    """How a state of this shape and type is read; a ``UserError`` if it cannot be, or only with ``--stack``."""
    actual = f"{dtype} {shape}"
    if dtype.kind not in "iufb" or 0 in shape:
        raise UserError(f"{where}: neither pictures nor numbers", actual, "Choose others, or leave them out.")
    reading = reading_of(shape, dtype)
    stackable = len(reading.axes) > 2
    if reading.fault and not (stack and stackable):
        raise UserError(f"{where} {reading.fault}", actual, f"{CLEARLY} {STACKED}" if stackable else CLEARLY)
    return reading


def stacked(states: Sequence[NDArray[Any]], names: Sequence[str]) -> NDArray[Any]:
    """States of one size as one array (N, ...); grey pictures as coloured ones, where some are coloured."""
    channels = {state.shape[2] for state in states if state.ndim == 3}
    if channels == {1, 3}:
        states = [state.repeat(3 // state.shape[2], axis=2) for state in states]
    for state, name in zip(states, names, strict=True):
        if state.shape != states[0].shape:
            text = f"{name} is {_text(state)}, {names[0]} is {_text(states[0])}"
            raise UserError("states differ in size", text, "Make them all one size; --resize makes large ones smaller.")
    return np.stack(states)


def _text(state: NDArray[Any]) -> str:
    return " x ".join(map(str, state.shape))


def observations_of(
    source: Source,
    subject: str,
    like: NDArray[Any] | None = None,
    *,
    sides: Mapping[str, int] | None = None,
    stack: bool = False,
) -> NDArray[Any]:
    """Pictures uint8 (N, H, W, C), numbers float32 (N, *shape), or mixed observations of arrays by key.

    ``sides``: see :func:`side_of`; ``stack``: see :func:`taken_one`. Values that are neither, an empty array, numbers
    that float32 cannot tell apart, and a shape or type that differs from ``like`` are a ``UserError``.
    """
    sides = sides or {}
    if isinstance(source, Mapping):
        parts = {}
        for key, values in source.items():
            parts[key.replace("/", ".")] = _of_one_kind(values, f"{subject} {key!r}", key, sides, stack)
        try:
            observations = packed(parts)
        except ValueError as error:
            do = "Give as many states of each key, and keys that can be file names."
            raise UserError(f"{subject} do not fit together", error, do) from None
    elif source.dtype.names:
        observations = source
    else:
        observations = _of_one_kind(source, subject, "", sides, stack)
    if like is not None and (observations.shape[1:], observations.dtype) != (like.shape[1:], like.dtype):
        kinds = [f"{type_text(states.dtype)} {states.shape[1:]}" for states in (observations, like)]
        raise UserError(f"{subject} differ in shape or type from the labelled ones", ", not ".join(kinds))
    return np.ascontiguousarray(observations)


def _of_one_kind(values: NDArray[Any], subject: str, key: str, sides: Mapping[str, int], stack: bool) -> NDArray[Any]:
    """Pictures or numbers, see :func:`observations_of`."""
    actual = f"{values.dtype} {values.shape}"
    if values.ndim < 2:
        do = "Give images (N, height, width, channels), or numbers (N, ...)."
        raise UserError(f"{subject} are not observations", actual, do)
    if not len(values):
        raise UserError(f"{subject} are empty", actual, "Give some; unlabelled ones from other contexts.")
    reading = _readable(values.shape[1:], values.dtype, subject, stack)
    side = side_of(sides, key, reading.dtype == PICTURE)
    if reading.dtype != PICTURE:
        if side:
            raise UserError("only pictures can be resized", actual, "Leave out --resize.")
        return as_numbers(values, subject)
    pictures = reading.arranged(values)
    if side and max(pictures.shape[1:3]) > side:
        return np.stack([shrunk_picture(picture, side) for picture in pictures])
    return pictures


def as_numbers(values: NDArray[Any], subject: str) -> NDArray[np.float32]:
    """Numbers (N, ...) as float32, compared before and after.

    Columns that are not finite, that float32 cannot hold, or whose values it cannot tell apart are a ``UserError``.
    """
    if not np.isfinite(values).all():
        raise UserError(
            f"{subject} have numbers that are not finite", _columns(~np.isfinite(values)), "Give finite ones."
        )
    with np.errstate(over="ignore", under="ignore"):
        cast = values.astype(NUMBERS)
    if np.can_cast(values.dtype, NUMBERS, "safe"):
        return cast
    lost = ~np.isfinite(cast) | (np.sign(cast) != np.sign(values))
    if lost.any():
        do = "Give them in another unit, so that all lie between 1e-38 and 3e38, or are 0."
        raise UserError(f"{subject} are too large or too small for float32", _columns(lost), do)
    rows = spread_rows(len(values), MOST_COMPARED)
    before, after = _distinct(values[rows]), _distinct(cast[rows])
    merged = after < 0.9 * before
    if merged.any():
        worst = np.argmin(after / before)
        text = f"{_columns(merged[None])}: {after[worst]} of {before[worst]} distinct values would be left"
        raise UserError(
            f"{subject} are {values.dtype}, which float32 cannot tell apart",
            text,
            "Subtract an offset first (the smallest value, a place near by), or leave these columns out.",
        )
    return cast


def _distinct(values: NDArray[Any]) -> NDArray[np.int64]:
    """How many distinct values each column of (N, ...) has, (D,)."""
    ordered = np.sort(values.reshape(len(values), -1), axis=0)
    return (ordered[1:] != ordered[:-1]).sum(axis=0) + 1


def _columns(faulty: NDArray[np.bool_]) -> str:
    """Which columns of (N, ...) have faults: ``columns 0, 3``."""
    numbers = np.flatnonzero(faulty.reshape(len(faulty), -1).any(axis=0)).tolist()
    more = "" if len(numbers) <= NAMED else f" and {len(numbers) - NAMED} more"
    return f"column{'s' * (len(numbers) > 1)} {', '.join(map(str, numbers[:NAMED]))}{more}"
