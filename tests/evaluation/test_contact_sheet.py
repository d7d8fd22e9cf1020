"""Contact sheets: pictures of collected states by room and label, to check labels by eye (Spec A1, B5)."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from hypogoal.core.errors import UserError
from hypogoal.data import Collected, States, write_dataset
from hypogoal.evaluation.pictures import (
    BACKGROUND,
    CAPTION_HEIGHT,
    COLUMNS,
    GAP,
    INK,
    MOST_STATES,
    SCALE,
    contact_sheet,
    contact_sheets,
    write_contact_sheets,
)

SIDE = 20


def states(count: int, channels: int) -> np.ndarray:
    """Pictures of one grey level each; of stacks the last frame's is 50 above the others'."""
    pictures = np.zeros((count, SIDE, SIDE, channels), np.uint8)
    pictures[:] = np.arange(count, dtype=np.uint8)[:, None, None, None] + 60
    if channels == 4:
        pictures[..., -1] += 50
    return pictures


def written(path: Path, sub_goals: tuple[str, ...], channels: int = 3) -> Path:
    """A data file of rooms 1 and 2, of which only room 1 has positives."""

    def some(count: int) -> States:
        labels = np.zeros((count, len(sub_goals)), np.bool_)
        labels[:2] = True
        rooms = np.where(np.arange(count) < 3, 1, 2)
        return States(states(count, channels), labels, {"room": rooms, "x": rooms, "y": rooms})

    data = Collected((SIDE, SIDE, channels), sub_goals, some(5), some(1), some(6))
    write_dataset(path, data, domain="unknown", config={}, seed=0)
    return path


@pytest.mark.parametrize("channels", [1, 3, 4])
def test_a_sheet_shows_each_state_and_its_caption(channels: int) -> None:
    """Spec B5: states enlarged in rows, the newest frame of a stack, a line of text under each and nothing else."""
    count = COLUMNS + 3
    sheet = contact_sheet(states(count, channels), ["x"] * (count - 1) + [""])
    high, wide = SIDE * SCALE + CAPTION_HEIGHT + GAP, SIDE * SCALE + GAP
    assert sheet.shape == (2 * high + GAP, COLUMNS * wide + GAP, 3)
    for index in range(count):
        top, left = GAP + index // COLUMNS * high, GAP + index % COLUMNS * wide
        state = sheet[top : top + SIDE * SCALE, left : left + SIDE * SCALE]
        assert (state == 60 + index + (50 if channels == 4 else 0)).all()
        caption = sheet[top + SIDE * SCALE : top + SIDE * SCALE + CAPTION_HEIGHT, left : left + SIDE * SCALE]
        assert ((caption > BACKGROUND).any() and caption.max() <= INK) == (index < count - 1)
    assert (sheet[high + GAP :, 4 * wide :] == BACKGROUND).all()


def test_sheets_are_by_room_and_label() -> None:
    """Spec B5: a sheet for each room and label that there is, with no more states than fit, of every kind."""
    count = 3 * MOST_STATES
    kind = np.repeat([0, 1, 2], MOST_STATES)
    split = States(states(count, 1), np.arange(count) < MOST_STATES, {"room": np.where(kind < 2, 7, 12), "kind": kind})
    sheets = contact_sheets(split, ("first", "second"))
    assert list(sheets) == ["room-07-positives", "room-07-negatives", "room-12-negatives"]
    assert len({sheet.shape for sheet in sheets.values()}) == 1, "each has as many as fit"
    everywhere = States(split.observations[:5], np.arange(5) < 5, {})
    assert list(contact_sheets(everywhere)) == ["positives"]


def test_sheets_of_a_file(tmp_path: Path) -> None:
    """Spec A1: PNG files by split, room and label; by sub-goal too, where there are several."""
    path = written(tmp_path / "data.h5", ("one",))
    files = write_contact_sheets(path, tmp_path / "sheets")
    names = ["room-01-positives", "room-01-negatives", "room-02-negatives"]
    assert files == [tmp_path / f"sheets/{split}/{name}.png" for split in ("labelled", "heldout") for name in names]
    split = States(states(5, 3), np.arange(5) < 2, {name: np.array([1, 1, 1, 2, 2]) for name in ("room", "x", "y")})
    assert np.array_equal(np.asarray(Image.open(files[0])), contact_sheets(split)["room-01-positives"])
    several = write_contact_sheets(written(tmp_path / "two.h5", ("one", "two")), tmp_path / "two")
    assert len(several) == 12
    assert several[3].relative_to(tmp_path) == Path("two/labelled/two/room-01-positives.png")


def test_what_has_no_sheets(tmp_path: Path) -> None:
    """Spec G2: one line for what is not a data file."""
    with pytest.raises(UserError, match="contact sheets need a data file"):
        write_contact_sheets(tmp_path, tmp_path / "sheets")
