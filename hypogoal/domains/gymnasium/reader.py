"""How observations of a Gymnasium space become arrays: a picture, numbers, or several of both by key.

What is a picture and what numbers, ``hypogoal.domains.observations`` says; several by key are packed into one array of
a structured type, see ``hypogoal.observations``.
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
COMPARED = (16, 64, 256)  # after so many observations it is asked which of their numbers float32 makes equal:
KEPT = 0.9  # it must keep this share of the distinct values,
NOTICED = 1e-6  # or change none by more than this


@dataclass(frozen=True)
class Reader:
    """Reads observations of a space as arrays of one shape and type.

    Attributes:
        features: the names of numbers, those of a ``Dict`` by its keys.
        key: of a ``Dict`` that holds nothing but a picture, the picture's.
        parts: by key, the readers of a ``Dict`` of pictures and numbers.
        met: the first observations, where float32 does not hold all their numbers.
    """

    space: Space
    shape: Shape
    dtype: DType
    features: tuple[str, ...] = ()
    key: str = ""
    parts: Mapping[str, Reader] = field(default_factory=dict)
    met: list[Any] = field(default_factory=list)

    def read(self, observation: Any) -> Any:
        """A copy (*shape) of an observation; ``UserError`` if it does not fit its space, or its numbers not float32."""
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
        """Refuse (``UserError``) numbers (D,) that are not finite, or that float32 makes equal."""
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
    """A reader of an observation space, or of what a ``Dict`` has under ``key``.

    A ``Dict`` of pictures and others, each under a key of its own, is read by key, without its text, which a warning
    names. Other spaces that Gymnasium's ``flatten`` accepts become float32 (D,) in its order. Observations that are
    neither pictures nor numbers are a ``UserError``.
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
    """A space without the text among its entries, and the keys of this; all of it if there is nothing else."""
    if not isinstance(space, spaces.Dict):
        return space, []
    texts = [key for key, part in space.items() if str(part.dtype).startswith("<U")]
    if not 0 < len(texts) < len(space):
        return space, []
    return spaces.Dict({key: part for key, part in space.items() if key not in texts}), texts


def _is_picture(space: Space) -> bool:
    """Whether this is a picture, or refused because it may be."""
    if not isinstance(space, spaces.Box):
        return False
    reading = reading_of(space.shape, space.dtype)
    return reading.dtype == PICTURE or bool(reading.fault)


def _by_key(space: spaces.Dict) -> Reader:
    """A reader of a ``Dict`` with pictures; of one alone it is that picture."""
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
    """A reader of a space without pictures, which Gymnasium flattens."""
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
    """By name, the spaces in a ``Dict`` or ``Tuple`` in the order of flattening; any other space itself."""
    if not isinstance(space, spaces.Dict | spaces.Tuple):
        yield name, space
        return
    for key, part in _entries(space):
        inner_name = f"{name}.{key}" if name else str(key)
        yield from _leaves(part, inner_name)


def _names(name: str, space: Space) -> list[str]:
    """The names of a space's numbers."""
    try:
        if isinstance(space, spaces.Text):  # Gymnasium numbers its letters otherwise after a space was stored
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
    """Observations (T, ...) of a space by key, as those of an environment are read; pictures are not yet arranged.

    Where there are no pictures, numbers are flattened into one array. Each of ``keys``, if any, is a space of its own.
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
    """What a ``Dict`` or ``Tuple`` has, with keys."""
    return [*(space.items() if isinstance(space, spaces.Dict) else enumerate(space))]
