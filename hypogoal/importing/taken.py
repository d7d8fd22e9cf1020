"""What is taken for what: states as read become pictures or numbers, key by key (the table in docs/own-domain.md)."""

from collections.abc import Sequence

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from hypogoal.core.errors import UserError
from hypogoal.domains.observations import CLEARLY, reading_of, shrunk_picture
from hypogoal.importing.episodes import Array
from hypogoal.observations import NUMBERS, PICTURE, spread_rows

STACKED = "Give pictures as uint8 (H, W, C); 'import --stack' puts stacked frames among the channels."
MOST_COMPARED = 2_000  # rows of numbers that are compared before and after the cast to float32, spread evenly
LEFT = 0.9  # the share of a column's distinct values that float32 must keep
NAMED = 4  # columns that a message names
IN_FLOAT32 = "have values that float32 makes infinite, 0 or equal, or that are not finite"


def take(
    state: Array,
    where: str,
    side: int = 0,
    stack: bool = False,
) -> tuple[Array, tuple[int, int] | None]:
    """A state as read: a picture as uint8 (H, W, C), or numbers. What could be either is a ``UserError``.

    And how many frames, and colours of each, a picture's channels are; None if nobody stacked them.

    Args:
        side: most pixels on a picture's longer side, 0: as many as it has.
        stack: axes of frames and colours become channels.
    """
    reading = reading_of(state.shape, state.dtype)
    fault = reading.fault
    is_stack = bool(fault) and len(reading.axes) > 2
    are_numbers = state.dtype.kind in "iufb"
    if not are_numbers or not state.size:
        fault = "are neither pictures nor numbers"
    if fault and not (is_stack and stack):
        do = STACKED if is_stack else CLEARLY
        raise UserError(f"{where} {fault}", f"{state.dtype} {state.shape}", do)
    if reading.dtype != PICTURE:
        return state.reshape(reading.shape), None
    picture = reading.arranged(state)
    small = shrunk_picture(picture, side)
    if not is_stack:
        return small, None
    last = state.shape[reading.axes[-1]]
    colours = last if last in (1, 3) else 1
    return small, (small.shape[2] // colours, colours)


def together(states: Sequence[Array], names: Sequence[str], subject: str) -> Array:
    """States of one size (N, ...): pictures, where some are coloured all so, or numbers as float32."""
    if {state.shape[2:] for state in states} == {(1,), (3,)}:
        states = [state.repeat(3 // state.shape[2], axis=2) for state in states]
    first = states[0]
    for state, name in zip(states, names, strict=True):
        are_alike = (state.dtype == PICTURE) == (first.dtype == PICTURE)
        if state.shape != first.shape or not are_alike:
            do = "Make them all pictures, or numbers, of one size; --resize makes large pictures smaller."
            sizes = f"{name} is {state.shape}, {names[0]} is {first.shape}"
            raise UserError("states differ in size or type", sizes, do)
    values = np.stack(states)
    if values.ndim == 4 and values.dtype == PICTURE:
        return values
    return as_numbers(values, subject)


def as_numbers(values: Array, subject: str) -> NDArray[np.float32]:
    """Numbers (N, ...) as float32, compared before and after.

    Columns that are not finite, that float32 cannot hold, or whose values it cannot tell apart are a ``UserError``.
    """
    with np.errstate(over="ignore", under="ignore"):
        cast = values.astype(NUMBERS)
    count = len(values)
    before, after = values.reshape(count, -1), cast.reshape(count, -1)
    lost = ~np.isfinite(after) | ((after == 0) != (before == 0))
    rows = spread_rows(count, MOST_COMPARED)
    distinct = pd.DataFrame(before[rows]).nunique()
    merged = pd.DataFrame(after[rows]).nunique() < LEFT * distinct
    columns = np.flatnonzero(lost.any(axis=0) | merged)
    if len(columns):
        named = ", ".join(map(str, columns[:NAMED]))
        where = f"{len(columns)} columns, such as {named}"
        do = "Give finite ones; subtract an offset, change the unit, or leave these columns out."
        raise UserError(f"{subject} {IN_FLOAT32}", where, do)
    return cast
