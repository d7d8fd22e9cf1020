"""Sheets of collected states by room and label, to check labels by eye (Spec A1, B5)."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from hypogoal.core.errors import UserError
from hypogoal.data import Collected, States, write_dataset
from hypogoal.tools.sheets import COLUMNS, GAP, MOST_STATES, sheet, sheets, write_sheets

SIDE = 20


def states(count: int, channels: int) -> np.ndarray:
    """Pictures of one grey level each; of stacks the last frame's is 50 above the others'."""
    pictures = np.zeros((count, SIDE, SIDE, channels), np.uint8)
    pictures[:] = np.arange(count, dtype=np.uint8)[:, None, None, None] + 60
    if channels == 4:
        pictures[..., -1] += 50
    return pictures


@pytest.mark.parametrize("channels", [1, 3, 4])
def test_a_sheet_shows_each_state(channels: int) -> None:
    """Spec B5: states in rows, the newest frame of a stack, black where there is none."""
    shown = sheet(states(COLUMNS + 3, channels))
    side = SIDE + 2 * GAP
    assert shown.shape == (2 * side, COLUMNS * side, 3)
    for index in range(2 * COLUMNS):
        top, left = index // COLUMNS * side + GAP, index % COLUMNS * side + GAP
        level = 60 + index + (50 if channels == 4 else 0) if index < COLUMNS + 3 else 0
        assert (shown[top : top + SIDE, left : left + SIDE] == level).all()


def test_sheets_are_by_room_and_label() -> None:
    """Spec B5: a sheet for each room and label that there is, with no more states than fit, spread over all."""
    count = 3 * MOST_STATES
    rooms = np.repeat([7, 7, 12], MOST_STATES)
    split = States(states(count, 1), np.arange(count) < MOST_STATES, {"room": rooms})
    drawn = dict(sheets(split))
    assert list(drawn) == ["room-07-positives", "room-07-negatives", "room-12-negatives"]
    assert len({shown.shape for shown in drawn.values()}) == 1, "each has as many as fit"
    everywhere = States(split.observations[:5], np.arange(5) < 5, {})
    assert [name for name, _ in sheets(everywhere)] == ["positives"]


def test_sheets_of_a_file(tmp_path: Path) -> None:
    """Spec A1: PNG files by split, sub-goal, room and label; one line for what is not a data file."""

    def some(count: int) -> States:
        labels = np.zeros((count, 2), np.bool_)
        labels[:2] = True
        return States(states(count, 3), labels, {"room": np.where(np.arange(count) < 3, 1, 2)})

    data = Collected((SIDE, SIDE, 3), ("one", "two"), some(5), some(1), some(6))
    write_dataset(tmp_path / "data.h5", data, domain="unknown", config={}, seed=0)
    files = write_sheets(tmp_path / "data.h5", tmp_path / "sheets")
    assert len(files) == 12
    assert files[3].relative_to(tmp_path) == Path("sheets/labelled/two/room-01-positives.png")
    assert np.array_equal(np.asarray(Image.open(files[0])), sheet(states(2, 3)))
    with pytest.raises(UserError, match="need a data file"):
        write_sheets(tmp_path, tmp_path / "sheets")
