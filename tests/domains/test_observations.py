"""What is taken for what: the table of docs/own-domain.md, for environments and imported arrays alike (Spec B6)."""

import re
from collections.abc import Callable
from itertools import pairwise
from pathlib import Path

import gymnasium
import numpy as np
import pytest
from gymnasium import spaces
from test_numbers import Says

from hypogoal.core.errors import UserError
from hypogoal.domains.gymnasium.reader import reader_of
from hypogoal.importing.states import take
from hypogoal.observations import PICTURE

PAGE = Path(__file__).parents[2] / "docs" / "own-domain.md"
TABLE = re.search(r"^\| one observation .*?(?=\n\n)", PAGE.read_text(encoding="utf-8"), re.M | re.S)
assert TABLE
ROWS = [[cell.strip() for cell in line.strip("|").split("|")] for line in TABLE[0].splitlines()[2:]]
CASES = [
    pytest.param(dtype, tuple(map(int, filter(None, shape.split(",")))), outcome, id=f"{dtype}({shape})")
    for _, examples, outcome in ROWS
    for dtype, shape in re.findall(r"`(\w+) \(([\d, ]+)\)`", examples)
]


DTYPES = ("uint8", "int64", "uint16", "bool", "float16", "float32", "float64")


def outcome_of(shape: tuple[int, ...], dtype: str) -> str:
    """What such an observation is taken for: ``picture``, ``numbers``, or ``refused``.

    An ``AssertionError`` where environment and array differ, or it was guessed.
    """
    state = np.ones(shape, dtype)
    env = Says(spaces.Box(0, 1, shape, state.dtype.type), state)
    wide = any(min(pair) > 16 for pair in pairwise(shape))  # the shape of a picture
    of_env, of_array = _refusal(lambda: reader_of(env.observation_space)), _refusal(lambda: take(state, "the state"))
    assert bool(of_env) == bool(of_array), (of_env, of_array)
    if of_env:
        assert dtype == "uint8" or wide, of_env
        return "refused"
    look, (taken, _) = reader_of(env.observation_space), take(state, "the state")
    assert taken.shape == look.shape and (taken.dtype == look.dtype or look.dtype != PICTURE)
    np.testing.assert_array_equal(look.read(env.reset()[0]), taken)
    if look.dtype == PICTURE:
        assert dtype == "uint8" and len(shape) in (2, 3)
        return "picture"
    assert not wide
    return "numbers"


def _refusal(call: Callable[[], object]) -> str:
    """The line with which a call refuses; empty where it does not."""
    try:
        call()
    except UserError as error:
        return str(error)
    return ""


@pytest.mark.parametrize(("dtype", "shape", "outcome"), CASES)
def test_the_table_of_the_page_is_true(dtype: str, shape: tuple[int, ...], outcome: str) -> None:
    """Spec B6: each of its examples, in an environment and in an array."""
    words = {"picture": "a picture"}
    found = outcome_of(shape, dtype)
    assert words.get(found, found) == outcome.removesuffix(", `(H, W, 1)`")
    if outcome.endswith("`(H, W, 1)`"):
        assert take(np.ones(shape, dtype), "the state")[0].shape == (*shape, 1)


def test_the_table_has_all_types_and_every_outcome() -> None:
    assert {case.values[0] for case in CASES} >= set(DTYPES)
    assert {case.values[2] for case in CASES} == {
        "a picture", "a picture, `(H, W, 1)`", "numbers", "refused",
    }  # fmt: skip


def test_frames_and_colours_are_stacked_in_their_order() -> None:
    """Spec B6: wherever they stood, by --stack."""
    whole = np.random.default_rng(0).integers(0, 255, (2, 40, 48, 4, 3), dtype=np.uint8)  # frames, then colours
    wanted = whole.reshape(2, 40, 48, 12)
    for axes in ((2, 0, 1, 3), (2, 3, 0, 1), (0, 1, 3, 2), (3, 0, 1, 2), (3, 2, 0, 1), (0, 1, 2, 3)):
        states = whole.transpose(0, *(axis + 1 for axis in axes))
        with pytest.raises(UserError, match=r"stacks of pictures: .*Give pictures as uint8 .* 'import --stack' puts"):
            take(states[0], "the state")
        np.testing.assert_array_equal([take(state, "the state", stack=True)[0] for state in states], wanted)


def test_minigrids_dictionary_is_read_without_its_text() -> None:
    """Spec B6: a picture and a number by key; a line says so."""
    env = gymnasium.make("minigrid:MiniGrid-Empty-8x8-v0")
    with pytest.warns(UserWarning, match="observations are read without their text: mission"):
        reader = reader_of(env.observation_space)
    seen, _ = env.reset(seed=0)
    read = reader.read(seen)
    assert read.dtype.names == ("direction", "image")
    np.testing.assert_array_equal(read["image"], seen["image"])
    assert read["direction"].tolist() == [1.0, 0.0, 0.0, 0.0]
    nothing_else = spaces.Dict(mission=env.observation_space["mission"])
    with pytest.raises(UserError, match="observations must be images"):
        reader_of(nothing_else)


def test_a_dictionary_hides_no_picture() -> None:
    """Spec B6: stacks, floats and integers in the shape of pictures are no more guessed in there than alone."""
    speed = spaces.Box(0, 1, (2,))
    for shape, dtype in (((4, 48, 48, 3), np.uint8), ((48, 48), np.int64), ((48, 48, 3), np.float32)):
        space = spaces.Dict(a=speed, b=spaces.Box(0, 1, shape, dtype))
        with pytest.raises(UserError, match=r"observations .*: b (u?int|float).* Give pictures as uint8 \(H"):
            reader_of(Says(space, None).observation_space)
        alone = Says(spaces.Dict(b=space["b"]), {"b": np.ones(shape, dtype)})
        with pytest.raises(UserError, match=r"observations .*: b (u?int|float)"):
            reader_of(alone.observation_space)
