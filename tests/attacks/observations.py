"""Spec B6: observations of any shape, turned pictures, contradictory labels, at random (``tests.attacks.fuzz``)."""

from __future__ import annotations

import random
import struct
from collections import defaultdict
from collections.abc import Callable
from itertools import pairwise
from math import prod
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
from gymnasium import spaces

from hypogoal.core.errors import UserError
from hypogoal.domains.gymnasium_engine import reader_of
from hypogoal.observations import PICTURE
from hypogoal.own_data.images import read_image
from hypogoal.own_data.parts import Parts, as_observations, collected_of

DTYPES = ("uint8", "int64", "uint16", "bool", "float16", "float32", "float64")
LENGTHS = (1, 3, 4, 7, 16, 17, 24, 64)  # of axes: of colours, frames and pictures
MOST = 200_000  # numbers in an observation


class Constant(gymnasium.Env[Any, Any]):
    """Shows the same observation, of ones, all the time."""

    action_space = spaces.Discrete(2)

    def __init__(self, shape: tuple[int, ...], dtype: str):
        self.observation_space = spaces.Box(0, 1, shape, np.dtype(dtype).type)
        self.observation = np.ones(shape, dtype)

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        return self.observation, {}


def drawn_observation(rng: random.Random) -> tuple[tuple[int, ...], str]:
    """A shape and a type; bytes are drawn more often."""
    shape = tuple(rng.choice(LENGTHS) for _ in range(rng.choice((1, 2, 2, 3, 3, 3, 4, 4))))
    return (shape if prod(shape) < MOST else shape[:2]), rng.choice(("uint8", *DTYPES))


def outcome_of(shape: tuple[int, ...], dtype: str) -> str:
    """What such an observation is taken for: ``picture``, ``numbers``, ``doubtful`` numbers, or ``refused``.

    An ``AssertionError`` where environment and array differ, or it was guessed.
    """
    env, states = Constant(shape, dtype), np.ones((2, *shape), dtype)
    wide = any(min(pair) > 16 for pair in pairwise(shape))  # the shape of a picture
    of_env, of_array = _refusal(lambda: reader_of(env)), _refusal(lambda: as_observations(states, "the states"))
    assert bool(of_env) == bool(of_array), (of_env, of_array)
    if of_env:
        assert dtype == "uint8" or (wide and "float" not in dtype), of_env
        return "refused"
    look, taken = reader_of(env), as_observations(states, "the states")[0]
    assert (taken.shape, taken.dtype) == (look.shape, look.dtype)
    np.testing.assert_array_equal(look.read(env.reset()[0]), taken)
    if look.dtype == PICTURE:
        assert dtype == "uint8" and len(shape) in (2, 3)
        return "picture"
    assert bool(look.doubt) == wide and ("float" in dtype or not wide)
    return "doubtful" if look.doubt else "numbers"


def _refusal(call: Callable[[], object]) -> str:
    """The line with which a call refuses; empty where it does not."""
    try:
        call()
    except UserError as error:
        return str(error)
    return ""


def check_upright(folder: Path, rng: random.Random) -> None:
    """An image of any format, mode and EXIF orientation is read as Pillow turns it; refused only if it is damaged."""
    from PIL import Image, ImageOps

    size = rng.randrange(1, 40), rng.randrange(1, 40)
    drawn = Image.frombytes("RGB", size, rng.randbytes(3 * prod(size))).convert(rng.choice(("RGB", "L", "P", "1")))
    kind, order, value = rng.choice(("PNG", "JPEG", "WEBP")), rng.choice("<>"), rng.choice((*range(10), 65_535))
    exif = {"<": b"II", ">": b"MM"}[order] + struct.pack(f"{order}HIHHHIHHI", 42, 8, 1, 0x0112, 3, 1, value, 0, 0)
    damaged = rng.random() < 0.3
    if damaged:
        exif = bytes(byte if rng.random() < 0.9 else rng.randrange(256) for byte in exif[: rng.randrange(len(exif))])
    file = folder / f"x.{kind.lower()}"
    (drawn if kind == "PNG" else drawn.convert("RGB")).save(file, kind, exif=b"Exif\0\0" + exif)
    seen = read_image(file)
    if not damaged:
        with Image.open(file) as stored:
            shown = ImageOps.exif_transpose(stored).convert("L" if seen.shape[2] == 1 else "RGB")
        np.testing.assert_array_equal(seen, np.asarray(shown).reshape(seen.shape))


def check_labels(rng: random.Random) -> bool:
    """Copies with other labels are counted, and a class refused that has nothing else; whether it was accepted."""
    count, looks = rng.randrange(4, 30), rng.randrange(2, 30)
    look = np.array([rng.randrange(looks) for _ in range(count)])
    labels = np.array([rng.random() < 0.5 if rng.random() < 0.3 else value % 2 > 0 for value in look])
    pictures = np.random.default_rng(0).integers(0, 255, (looks + 9, 20, 20), dtype=np.uint8)
    kinds = defaultdict(set)
    for value, label in zip(look.tolist(), labels.tolist(), strict=True):
        kinds[value].add(label)
    both = sum(len(kind) == 2 for kind in kinds.values())
    own = [sum(kind == {label} for kind in kinds.values()) for label in (True, False)]
    lines: list[str] = []
    parts = Parts(pictures[look], labels, pictures[looks : looks + 3], pictures[looks + 3 :], np.arange(6) % 2)
    refusal = _refusal(lambda: lines.extend(collected_of(parts, ())[1]))
    assert bool(refusal) == (not all(own)), (refusal, own)
    found = [int(line.split()[0]) for line in lines if "both labels" in line]
    assert refusal or found == ([both] if both else []), (lines, both)
    return not refusal
