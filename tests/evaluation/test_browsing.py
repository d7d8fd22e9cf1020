"""Spec F2, F6, F7: which states are browsed, and how they and their attributions become small pictures."""

import io

import numpy as np
from PIL import Image

from hypogoal.evaluation.pictures import attribution_image, brightness, coloured, flat, image_png, reduced, to_bytes
from hypogoal.evaluation.saliency import pick_for_gallery, take_turns


def test_groups_take_turns():
    """Spec F7: the first of each group in the order given, then the second of each; by hand."""
    order = np.array([4, 3, 2, 1, 0])
    assert take_turns(order, np.array([7, 7, 5, 5, 5])).tolist() == [4, 1, 3, 0, 2]


def test_states_on_which_members_disagree_or_err_come_first():
    """Spec F7: one such state in 1,000 is shown though only 12 are; alike each time; places come up evenly."""
    labels = np.arange(1000) % 2 == 0
    verdicts = np.repeat(labels[:, None], 3, axis=1)
    verdicts[500] = ~verdicts[500]  # all err
    verdicts[501, 1] = ~verdicts[501, 1]  # members disagree
    rooms = np.arange(1000) // 250
    pick = [pick_for_gallery(verdicts, labels, [rooms], np.random.default_rng(0))[:12] for _ in range(2)]
    np.testing.assert_array_equal(*pick)
    assert {500, 501} == set(pick[0][:2].tolist()) and len(set(pick[0].tolist())) == 12
    assert np.bincount(rooms[pick[0]], minlength=4).min() >= 2


def test_attributions_as_bytes():
    """Spec F2: the sign stays, each picture has a scale of its own, and one without attributions stays empty."""
    values = np.zeros((3, 10, 10))
    values[0, 0] = [4, -4, 2, 0, 0, 0, 0, 0, 0, 0]
    values[1] = 100 * values[0]
    stored = to_bytes(values)
    assert stored.dtype == np.int8
    assert stored[0, 0, :4].tolist() == [127, -127, 64, 0]
    np.testing.assert_array_equal(stored[0], stored[1])
    assert not stored[2].any()


def test_what_is_drawn_of_a_state():
    """Spec F2: of colours their sum and mean, of stacked frames the last, of stacked colour frames the last three."""
    assert flat(np.array([[9.0, 9, 9, 1, 2, 3]]), 3).tolist() == [6]
    assert coloured(np.arange(6, dtype=np.uint8)[None], 3).tolist() == [[3, 4, 5]]
    colours, frames = np.array([[1.0, 2.0, 3.0]]), np.array([[1.0, 2.0, 3.0, 4.0]])
    assert flat(colours).tolist() == [6]
    assert flat(frames).tolist() == [4]
    assert brightness(np.array([[10, 20, 30]], np.uint8)).tolist() == [20]
    assert brightness(np.array([[10, 20, 30, 40]], np.uint8)).tolist() == [40]


def test_pictures_are_the_same_pixels_and_small():
    """Spec F7: with few colours a palette, with many none; either way pixel for pixel."""
    rng = np.random.default_rng(0)
    few = rng.integers(0, 5, (64, 64, 1), dtype=np.uint8).repeat(3, axis=2) * 50
    many = rng.integers(0, 256, (64, 64, 3), dtype=np.uint8)
    for image, mode in ((few, "P"), (many, "RGB"), (many[..., 0], "L")):
        read = Image.open(io.BytesIO(image_png(image)))
        assert read.mode == mode
        np.testing.assert_array_equal(np.asarray(read.convert("RGB" if image.ndim == 3 else "L")), image)
    noise = image_png(attribution_image(rng.normal(size=(84, 84)), rng.random((84, 84))))
    assert Image.open(io.BytesIO(noise)).mode == "P"


def test_large_pictures_are_reduced() -> None:
    """Spec F7: a page of own photographs stays one that can be opened; small pictures are shown pixel for pixel."""
    image = np.random.default_rng(0).integers(256, size=(300, 257, 3), dtype=np.uint8)
    small = reduced(image)
    assert small.shape == (100, 85, 3) and small.dtype == np.uint8
    np.testing.assert_array_equal(small[1, 2], image[3:6, 6:9].mean((0, 1)).astype(np.uint8))
    assert reduced(image[..., 0] / 255).shape == (100, 85)
    assert reduced(image[:128, :128]) is not None and np.shares_memory(reduced(image[:128, :128]), image)
