"""Labelled states as sheets of pictures, to check labels by eye."""

from collections.abc import Iterator
from pathlib import Path

import numpy as np
from PIL import Image

from hypogoal.core.arrays import Bytes
from hypogoal.core.errors import UserError
from hypogoal.data import SPLITS, States, open_dataset
from hypogoal.evaluation.pictures import coloured
from hypogoal.observations import PICTURE, spread_rows

MOST_STATES = 60  # states on a sheet
COLUMNS = 10
GAP = 2  # pixels around each state
PLACES = ("room", "layout_seed")  # origins; each value of the first that states have gets its own sheets


def write_sheets(
    path: Path,
    folder: Path,
) -> list[Path]:
    """Draw a data file's labelled and held-out states, a picture for each room and label. Return the files written.

    The files are ``labelled/SUB_GOAL/room-01-positives.png`` and so on in ``folder``. Raises ``UserError`` if ``path``
    is no data file, or if the states are not pictures.
    """
    if not path.is_file():
        raise UserError(
            "sheets of states need a data file",
            path,
            "Give the .h5 file of the states.",
        )
    dataset = open_dataset(path)
    if dataset.observation_dtype != PICTURE:
        raise UserError(
            "the states are not pictures",
            path,
            "Read them with h5py, see docs/formats.md.",
        )
    written = []
    for split in SPLITS:
        for sub_goal in dataset.sub_goals:
            place = folder / split / sub_goal
            place.mkdir(parents=True, exist_ok=True)
            for name, shown in sheets(getattr(dataset, split)(sub_goal)):
                written.append(place / f"{name}.png")
                Image.fromarray(shown).save(written[-1])
    return written


def sheets(split: States) -> Iterator[tuple[str, Bytes]]:
    """Yield the name and the picture of a sheet for each room and label, such as ``room-01-positives``.

    If there are too many states, those that are shown are spread over all.
    """
    origin = next((name for name in PLACES if name in split.origins), "")
    places = split.origins.get(origin, np.zeros(len(split.labels)))
    for place in np.unique(places):
        for word, labels in (("positives", split.labels), ("negatives", ~split.labels)):
            alike = np.flatnonzero(labels & (places == place))
            if len(alike):
                few = alike[spread_rows(len(alike), MOST_STATES)]
                name = f"{origin.replace('_', '-')}-{place:02d}-{word}" if origin else word
                yield name, sheet(split.observations[few])


def sheet(observations: Bytes) -> Bytes:
    """Return observations, uint8 (n, H, W, C), in rows of ``COLUMNS``: uint8 (height, width, 3), padded with black."""
    shown = coloured(observations)
    missing = -len(shown) % COLUMNS
    padded = np.pad(shown, ((0, missing), (GAP, GAP), (GAP, GAP), (0, 0)))
    _, height, width, _ = padded.shape
    rows = padded.reshape(-1, COLUMNS, height, width, 3)
    return rows.swapaxes(1, 2).reshape(-1, COLUMNS * width, 3)
