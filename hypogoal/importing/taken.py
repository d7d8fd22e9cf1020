"""What is taken for what: states as read become pictures or numbers, key by key (the table in docs/own-domain.md)."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from hypogoal.core.errors import UserError
from hypogoal.data import Dataset, Labels
from hypogoal.domains.observations import CLEARLY, Reading, reading_of, shrunk_picture
from hypogoal.importing.parts import Array
from hypogoal.observations import (
    NUMBERS,
    PICTURE,
    DType,
    Observations,
    Shape,
    fields_of,
    packed,
    spread_rows,
    type_text,
)

STACKED = "'import --stack' puts stacked frames among the channels."
MOST_COMPARED = 2_000  # rows of numbers that are compared before and after the cast to float32, spread evenly
LEFT = 0.9  # the share of a column's distinct values that float32 must keep
LARGE = 160  # pixels of a side; larger pictures get the advice to shrink them. At 160 training fits in 2 GB
NAMED = 4  # columns that a message names


@dataclass(frozen=True)
class Taking:
    """How states are taken.

    Attributes:
        sides: most pixels on the longer side of pictures, by key; "" is of all that have none of their own.
        stack: axes of frames and colours become channels.
    """

    sides: Mapping[str, int] = field(default_factory=dict)
    stack: bool = False

    def one(self, value: Array, key: str, where: str) -> Array:
        """A state as read: a picture as uint8 (H, W, C), made smaller, or numbers. What could be either is refused."""
        value = np.asarray(value)
        reading = self._reading(value.shape, value.dtype, where)
        if reading.dtype != PICTURE:
            return value.reshape(reading.shape)
        return shrunk_picture(reading.arranged(value[None])[0], self._side(key))

    def all(self, values: Array, key: str, subject: str) -> Array:
        """States (N, ...): pictures uint8 (N, H, W, C), made smaller, or numbers float32 (N, *shape)."""
        actual = f"{values.dtype} {values.shape}"
        if values.ndim < 2:
            raise UserError(
                f"{subject} are not observations", actual, "Give pictures (N, H, W, C), or numbers (N, ...)."
            )
        if not len(values):
            raise UserError(f"{subject} are empty", actual, "Give some; unlabelled ones from other contexts.")
        reading = self._reading(values.shape[1:], values.dtype, subject)
        if reading.dtype == PICTURE:
            pictures = reading.arranged(values)
            side = self._side(key)
            return np.stack([shrunk_picture(picture, side) for picture in pictures]) if side else pictures
        if self.sides.get(key) or (key == "" and self.sides):
            raise UserError("only pictures can be resized", actual, "Leave out --resize.")
        return as_numbers(values, subject)

    def observations(self, arrays: Mapping[str, Array], subject: str, like: Observations | None = None) -> Observations:
        """Observations (N, *shape) from arrays by key; of the shape and type of ``like``, if that is given."""
        parts = {}
        for key, values in arrays.items():
            parts[key.replace("/", ".")] = self.all(values, key, f"{subject} {key!r}" if key else subject)
        try:
            observations = parts[""] if "" in parts else packed(parts)
        except ValueError as error:
            do = "Give as many states of each key, and keys that can be file names."
            raise UserError(f"{subject} do not fit together", error, do) from None
        if like is not None and (observations.shape[1:], observations.dtype) != (like.shape[1:], like.dtype):
            kinds = [f"{type_text(states.dtype)} {states.shape[1:]}" for states in (observations, like)]
            raise UserError(f"{subject} differ in shape or type from the labelled ones", ", not ".join(kinds))
        return np.ascontiguousarray(observations)

    def _side(self, key: str) -> int:
        return self.sides.get(key, self.sides.get("", 0))

    def _reading(self, shape: Shape, dtype: DType, where: str) -> Reading:
        """How a state of this shape and type is read; a ``UserError`` if it cannot be, or only with ``stack``."""
        actual = f"{dtype} {shape}"
        if dtype.kind not in "iufb" or 0 in shape:
            raise UserError(f"{where}: neither pictures nor numbers", actual, "Choose others, or leave them out.")
        reading = reading_of(shape, dtype)
        stackable = len(reading.axes) > 2
        if reading.fault and not (self.stack and stackable):
            raise UserError(f"{where} {reading.fault}", actual, f"{CLEARLY} {STACKED}" if stackable else CLEARLY)
        return reading


def describe(dataset: Dataset, *, resized: bool) -> Iterator[str]:
    """How the states of a data file were read, a line a key; of large pictures, how to import them smaller."""
    fields = fields_of(dataset.observation_shape, dataset.observation_dtype)
    for key, (dtype, shape) in fields.items():
        sizes = " x ".join(map(str, shape))
        kind = "pictures" if dtype == PICTURE else "numbers"
        yield f"{key or 'states'}: taken for {kind}, {sizes} {dtype}"
        if dtype == PICTURE and max(shape[:2]) > LARGE and not resized:
            yield f"pictures of {sizes} need much memory and time; add --resize {LARGE} --force"


def channels_of(value: Array, key: str) -> dict[str, tuple[int, int]]:
    """How many frames, and colours of each, are the channels of a stack of pictures, by its key; empty for all else."""
    value = np.asarray(value)
    reading = reading_of(value.shape, value.dtype)
    if not reading.fault or len(reading.axes) < 3:
        return {}
    last = value.shape[reading.axes[-1]]
    colours = last if last in (1, 3) else 1
    return {key: (reading.shape[2] // colours, colours)}


def stacked(states: Sequence[Array], names: Sequence[str]) -> Array:
    """States of one size as one array (N, ...); grey pictures as coloured ones, where some are coloured."""
    channels = {state.shape[2] for state in states if state.ndim == 3}
    if channels == {1, 3}:
        states = [state.repeat(3 // state.shape[2], axis=2) for state in states]
    for state, name in zip(states, names, strict=True):
        if state.shape != states[0].shape:
            text = f"{name} is {state.shape}, {names[0]} is {states[0].shape}"
            raise UserError("states differ in size", text, "Make them all one size; --resize makes large ones smaller.")
    return np.stack(states)


def as_numbers(values: Array, subject: str) -> NDArray[np.float32]:
    """Numbers (N, ...) as float32, compared before and after.

    Columns that are not finite, that float32 cannot hold, or whose values it cannot tell apart are a ``UserError``.
    """
    with np.errstate(over="ignore", under="ignore"):
        cast = values.astype(NUMBERS)
    lost = ~np.isfinite(cast) | ((cast > 0) != (values > 0)) | ((cast < 0) != (values < 0))
    if lost.any():
        fault = f"{subject} have numbers that are not finite, or become so or 0 as float32"
        raise UserError(fault, _columns(lost), "Give finite ones, in a unit in which they lie between 1e-38 and 3e38.")
    rows = spread_rows(len(values), MOST_COMPARED)
    before, after = _distinct(values[rows]), _distinct(cast[rows])
    merged = after < LEFT * before
    if merged.any():
        worst = np.argmin(after / before)
        text = f"{_columns(merged[None])}: {after[worst]} of {before[worst]} distinct values would be left"
        do = "Subtract an offset first (the smallest value, a place near by), or leave these columns out."
        raise UserError(f"{subject} are {values.dtype}, which float32 cannot tell apart", text, do)
    return cast


def _distinct(values: Array) -> Array:
    """How many distinct values each column of (N, ...) has, (D,)."""
    ordered = np.sort(values.reshape(len(values), -1), axis=0)
    return (ordered[1:] != ordered[:-1]).sum(axis=0) + 1


def _columns(faulty: Labels) -> str:
    """Which columns of (N, ...) have faults: ``columns 0, 3``."""
    numbers = np.flatnonzero(faulty.reshape(len(faulty), -1).any(axis=0)).tolist()
    more = "" if len(numbers) <= NAMED else f" and {len(numbers) - NAMED} more"
    return f"columns {', '.join(map(str, numbers[:NAMED]))}{more}"
