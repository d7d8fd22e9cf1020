"""Sheets of collected states, to check their labels by eye (Spec A1, B5)."""

from collections.abc import Iterator
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from hypogoal.core.errors import UserError
from hypogoal.data import SPLITS, States, open_dataset
from hypogoal.evaluation.pictures import coloured
from hypogoal.observations import PICTURE, spread_rows, type_text

MOST_STATES = 60  # on a sheet
COLUMNS = 10
GAP = 2  # pixels around each state
PLACES = ("room", "layout_seed")  # origins of which each value gets sheets of its own: the first that there is


def write_sheets(path: Path, folder: Path) -> list[Path]:
    """Draw a data file's labelled and held-out states, a picture for each room and label.

    The files are ``labelled/SUB_GOAL/room-01-positives.png`` and so on in ``folder``. A path that is no data file and
    states that are not pictures are a ``UserError``.
    """
    if not path.is_file():
        raise UserError("sheets of states need a data file", path, "Give the .h5 file of the states.")
    dataset = open_dataset(path)
    if dataset.observation_dtype != PICTURE or len(dataset.observation_shape) != 3:
        actual = f"{type_text(dataset.observation_dtype)} {dataset.observation_shape}"
        raise UserError("the states are not pictures", actual, "Read them with h5py, see docs/formats.md.")
    written = []
    for split in SPLITS:
        for sub_goal in dataset.sub_goals:
            place = folder / split / sub_goal
            place.mkdir(parents=True, exist_ok=True)
            for name, shown in sheets(getattr(dataset, split)(sub_goal)):
                written.append(place / f"{name}.png")
                Image.fromarray(shown).save(written[-1])
    return written


def sheets(split: States) -> Iterator[tuple[str, NDArray[np.uint8]]]:
    """A sheet of each room and label, with its name, such as ``room-01-positives``; states are spread over them."""
    place = next((name for name in PLACES if name in split.origins), None)
    places = split.origins[place] if place else np.zeros(len(split.labels), np.int64)
    for value in np.unique(places).tolist():
        for label, word in ((True, "positives"), (False, "negatives")):
            inside = np.flatnonzero((places == value) & (split.labels == label))
            if len(inside):
                few = inside[spread_rows(len(inside), MOST_STATES)]
                name = f"{place.replace('_', '-')}-{value:02d}-{word}" if place else word
                yield name, sheet(split.observations[few])


def sheet(observations: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Observations uint8 (n, H, W, C) in rows of ``COLUMNS``, uint8 (height, width, 3); black where there is none."""
    shown = coloured(observations)
    missing = -len(shown) % COLUMNS
    padded = np.pad(shown, ((0, missing), (GAP, GAP), (GAP, GAP), (0, 0)))
    _, height, width, _ = padded.shape
    rows = padded.reshape(-1, COLUMNS, height, width, 3)
    return rows.swapaxes(1, 2).reshape(-1, COLUMNS * width, 3)
