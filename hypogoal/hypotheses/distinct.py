"""Numbers for distinct values, so that what occurs often is computed once."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from hypogoal.core.arrays import Bytes, Ints

Ids = NDArray[np.int32]  # numbers of distinct values, such as patches, rows of pixels or colours
LOOKUP_PER_VALUE = 4  # sorting is faster than a table with more than this number of entries per value to rank


def join(pieces: Sequence[Ids], bound: int) -> tuple[Ids, Ids]:
    """Join arrays of ids below ``bound``, place by place, into tuples.

    Returns the distinct tuples' ids in the shape of the arrays, and the distinct tuples.
    """
    ids = pieces[0]
    tuples = np.arange(bound, dtype=np.int32)[:, None]
    for piece in pieces[1:]:
        pairs = ids.astype(int) * bound + piece
        ids, distinct = rank(pairs, len(tuples) * bound)
        before, last = np.divmod(distinct, bound)
        joined = last.astype(np.int32)
        tuples = np.column_stack([tuples[before], joined])
    return ids, tuples


def rank(values: Ids | Ints, bound: int) -> tuple[Ids, Ints]:
    """Return the ranks of values in 0..bound-1 among the distinct values, and the distinct values in order."""
    if bound > LOOKUP_PER_VALUE * values.size:
        ordered, inverse = np.unique(values, return_inverse=True)
        whole = inverse.reshape(values.shape)
        return whole.astype(np.int32), ordered.astype(int)
    occurs = np.zeros(bound, bool)
    occurs[values] = True
    ranks = np.cumsum(occurs, dtype=np.int32) - 1
    return ranks[values], np.flatnonzero(occurs)


def distinct_items(items: Bytes) -> tuple[Ids, Bytes]:
    """Return the indices of distinct items (N,) and the distinct items, in order of appearance.

    ``items`` are bytes (N, size).
    """
    size = items.shape[1]
    together = np.ascontiguousarray(items).view(f"V{size}")
    whole = together.ravel().tolist()
    index_of = {item: index for index, item in enumerate(dict.fromkeys(whole))}
    index = np.fromiter(
        map(index_of.__getitem__, whole),
        np.int32,
        len(whole),
    )
    joined = b"".join(index_of)
    distinct = np.frombuffer(joined, np.uint8)
    return index, distinct.reshape(-1, size)


def positions(values: Ids, among: Ints) -> Ints:
    """Return the index of each value in the sorted array ``among``, which contains all of the values."""
    size = int(among[-1]) + 1
    position = np.empty(size, int)
    position[among] = np.arange(len(among))
    return position[values]
