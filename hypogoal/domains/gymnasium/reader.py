"""How observations of a Gymnasium space become arrays, which are pictures, numbers, or mixed.

``hypogoal.domains.observations`` says what is a picture and what are numbers. Several of them by key are packed into
one array of a structured type, see ``hypogoal.observations``.
"""

from __future__ import annotations

import warnings
from collections.abc import Collection, Iterator, Mapping
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from gymnasium import spaces
from gymnasium.vector.utils import batch_space, iterate

from hypogoal.core.errors import UserError
from hypogoal.domains.observations import CLEARLY, reading_of
from hypogoal.observations import NUMBERS, PICTURE, DType, Shape, mixed_type

Space = spaces.Space[Any]
# After these numbers of observations, a reader checks that float32 does not make different numbers equal. float32 must
# keep the share KEPT of the distinct values, or change no value by more than NOTICED.
COMPARED = (16, 64, 256)
KEPT = 0.9
NOTICED = 1e-6


@dataclass(frozen=True)
class Reader:
    """A reader of observations of a space, as arrays of one shape and type.

    Attributes:
        features: the names of the numbers. The numbers of a ``Dict`` are named by its keys.
        key: the picture's key, for a ``Dict`` of nothing but a picture.
        parts: by key, the readers of a ``Dict`` of pictures and numbers.
        met: the first observations, if float32 does not hold all their numbers.
    """

    space: Space
    shape: Shape
    dtype: DType
    features: tuple[str, ...] = ()
    key: str = ""
    parts: Mapping[str, Reader] = field(default_factory=dict)
    met: list[Any] = field(default_factory=list)

    def read(self, observation: Any) -> Any:
        """Return a copy (*shape) of an observation.

        Raises ``UserError`` if the observation does not fit its space, or if its numbers do not fit float32.
        """
        if self.parts:
            mixed = np.empty((), self.dtype)
            for key, part in self.parts.items():
                mixed[key] = part.read(observation[key])
            return mixed
        if self.key:
            observation = observation[self.key]
        elif not isinstance(self.space, spaces.Box):
            observation = spaces.flatten(self.space, observation)
        values = exact = np.array(observation, order="C")
        received = f"{values.dtype} {values.shape}"
        if self.dtype == NUMBERS and values.dtype.kind in "iufb":
            with np.errstate(over="ignore", under="ignore"):
                values = values.astype(NUMBERS)
        shapes = (self.shape, self.space.shape)
        if values.dtype != self.dtype or values.shape not in shapes:
            raise UserError(
                "the environment gave an observation that does not fit its space",
                received,
                f"Make the observation space and the observations agree; the space says {self.dtype} {self.shape}.",
            )
        if self.dtype == NUMBERS:
            self._require_kept(exact.ravel(), values.ravel())
        return values.reshape(self.shape)

    def _require_kept(self, exact: Any, cast: Any) -> None:
        """Raise ``UserError`` if numbers (D,) are not finite, or if float32 makes different numbers equal."""
        fault, do = "an observation has numbers that are not finite in float32", "Clip or replace them in a wrapper."
        lost = ~np.isfinite(cast)
        if not lost.any() and not np.can_cast(exact.dtype, NUMBERS) and len(self.met) < COMPARED[-1]:
            self.met.append(exact)
            if len(self.met) in COMPARED:
                from pandas import DataFrame  # takes long to import

                fault = "observations have numbers that differ, and that float32 makes equal"
                do = "Subtract an offset, change the unit, or leave them out, in a wrapper."
                before = np.stack(self.met)
                after = before.astype(NUMBERS)
                few = DataFrame(after).nunique() < KEPT * DataFrame(before).nunique()
                changes = np.abs(before - after).max(axis=0)
                lost = few.to_numpy() & (changes > NOTICED)
        if lost.any():
            place = lost.argmax()
            raise UserError(fault, f"{self.features[place]}, such as {exact[place]}", do)


def reader_of(space: Space, key: str = "") -> Reader:
    """Return a reader of an observation space, or of the part of a ``Dict`` that is called ``key``.

    A ``Dict`` of pictures and numbers, each under a key of its own, is read by key. Its text is left out, and a warning
    names the keys of the text. Other spaces that Gymnasium's ``flatten`` accepts become float32 (D,), in the order of
    ``flatten``. Raises ``UserError`` if observations are neither pictures nor numbers.
    """
    space, texts = _split(space)
    if texts:
        warnings.warn(f"observations are read without their text: {', '.join(texts)}", stacklevel=2)
    if isinstance(space, spaces.Dict) and any(map(_is_picture, space.values())):
        return _by_key(space)
    if not isinstance(space, spaces.Box):
        return _numbers(space, key)
    reading = reading_of(space.shape, space.dtype)
    if reading.fault:
        where = f"{key} {space.dtype} {space.shape}".strip()
        raise UserError(f"observations {reading.fault}", where, CLEARLY)
    if reading.dtype == PICTURE:
        return Reader(space, reading.shape, PICTURE)
    return _numbers(space, key)


def _split(space: Space) -> tuple[Space, list[str]]:
    """Return a space without the text among its entries, and the keys of the text.

    If all entries are text, the whole space is returned, and no keys.
    """
    if not isinstance(space, spaces.Dict):
        return space, []
    texts = [key for key, part in space.items() if str(part.dtype).startswith("<U")]
    if not 0 < len(texts) < len(space):
        return space, []
    return spaces.Dict({key: part for key, part in space.items() if key not in texts}), texts


def _is_picture(space: Space) -> bool:
    """Return whether observations of a space are pictures, or are refused because they may be pictures."""
    if not isinstance(space, spaces.Box):
        return False
    reading = reading_of(space.shape, space.dtype)
    return reading.dtype == PICTURE or bool(reading.fault)


def _by_key(space: spaces.Dict) -> Reader:
    """Return a reader of a ``Dict`` with pictures. If the ``Dict`` has one key, the reader is that of the picture."""
    parts = {key: reader_of(part, str(key)) for key, part in space.items()}
    if len(parts) == 1:
        [(key, part)] = parts.items()
        return replace(part, key=key)
    fields = {key: (part.dtype, part.shape) for key, part in parts.items()}
    try:
        dtype = mixed_type(fields)
    except (ValueError, KeyError, TypeError):
        raise UserError(
            "the entries of the observations cannot be read by their keys",
            space,
            "Give a Dict of pictures and numbers, with keys that can be file names.",
        ) from None
    return Reader(space, (), dtype, parts=parts)


def _numbers(space: Space, key: str) -> Reader:
    """Return a reader of a space of numbers, which Gymnasium flattens. Raises ``UserError`` if there are pictures."""
    features = []
    for name, part in _leaves(space, key):
        if _is_picture(part):
            raise UserError(
                "observations mix pictures with other values",
                name,
                "Give a Dict with each picture under a key of its own, beside those of numbers.",
            )
        features += _names(name, part)
    shape: Shape = (len(features),)
    if isinstance(space, spaces.Box) and space.shape:
        shape = space.shape
    return Reader(space, shape, NUMBERS, tuple(features))


def _leaves(space: Any, name: str) -> Iterator[tuple[str, Any]]:
    """Yield the spaces in a ``Dict`` or ``Tuple`` by name, in the order of flattening, or any other space itself."""
    if not isinstance(space, spaces.Dict | spaces.Tuple):
        yield name, space
        return
    for key, part in _entries(space):
        inner_name = f"{name}.{key}" if name else str(key)
        yield from _leaves(part, inner_name)


def _names(name: str, space: Space) -> list[str]:
    """Return the names of a space's numbers. Raises ``UserError`` if Gymnasium cannot flatten the space."""
    try:
        if isinstance(space, spaces.Text):  # once a space was stored, Gymnasium numbers the letters of a text otherwise
            raise ValueError
        size = spaces.flatdim(space)
    except (NotImplementedError, ValueError):
        raise UserError(
            "observations must be images, uint8 (H, W, C) or (H, W), or numbers that Gymnasium can flatten",
            space,
            "Wrap it so that it gives those, for example in minigrid's ImgObsWrapper(RGBImgObsWrapper(env)).",
        ) from None
    if not name:
        return [f"x{place}" for place in range(size)]
    if size == 1:
        return [name]
    return [f"{name}[{place}]" for place in range(size)]


def recorded(space: Space, values: Any, keys: Collection[str] = (), place: str = "") -> dict[str, Any]:
    """Return recorded observations (T, ...) of a space by key, read as those of an environment are.

    Pictures are not arranged yet. If there are no pictures, numbers are flattened into one array. If there are
    ``keys``, the space that a key names is read on its own.
    """
    is_wanted = not keys or place in keys
    has_pictures = any(_is_picture(part) for _, part in _leaves(space, place))
    arrays = {}
    if is_wanted and not has_pictures and not isinstance(space, spaces.Box | spaces.Text):
        numbers, texts = _split(space)
        steps = iterate(batch_space(numbers), values)
        arrays[place] = np.array([spaces.flatten(numbers, step) for step in steps])
        parts = [(key, part) for key, part in _entries(space) if key in texts]
    elif isinstance(space, spaces.Dict | spaces.Tuple):
        parts = _entries(space)
    else:
        return {place: np.asarray(values)}
    for key, part in parts:
        inner = f"{place}/{key}".removeprefix("/")
        arrays |= recorded(part, values[key], () if is_wanted else keys, inner)
    return arrays


def _entries(space: Any) -> list[tuple[Any, Any]]:
    """Return the keys and spaces of a ``Dict`` or ``Tuple``."""
    return [*(space.items() if isinstance(space, spaces.Dict) else enumerate(space))]
