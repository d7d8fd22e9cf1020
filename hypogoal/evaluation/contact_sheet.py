"""Contact sheets: many collected states in one picture, a line under each, so that labels are checked by eye."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from hypogoal.dataset import Split

MOST_STATES = 60  # on a sheet
COLUMNS = 10
SCALE = 2
CAPTION_HEIGHT, GAP = 14, 4  # pixels
BACKGROUND, INK = 40, 230  # grey levels
PLACES = ("room", "layout_seed")  # origins of which each value gets sheets of its own: the first that there is
WHERE = (("x", "y"), ("agent_x", "agent_y"))  # origins that say where the agent is


def contact_sheets(split: Split, kinds: Sequence[str] = ()) -> dict[str, NDArray[np.uint8]]:
    """Sheets of a split's states, for each room and label one: name -> uint8 (height, width, 3).

    Each shows ``MOST_STATES`` states at most, spread evenly over those of the room and label in the order of their
    kinds, with kind and position under each.

    Args:
        split: N states of one sub-goal.
        kinds: the names of the values of the origin ``kind``.

    Returns:
        Named like ``room-01-positives``.
    """
    place = next((name for name in PLACES if name in split.origins), None)
    places = np.zeros(len(split.labels), np.int64) if place is None else split.origins[place]
    kind = split.origins.get("kind", np.zeros(len(split.labels), np.int64))
    sheets = {}
    for value in np.unique(places).tolist():
        for label, word in ((True, "positives"), (False, "negatives")):
            here = np.flatnonzero((places == value) & (split.labels == label))
            here = here[np.argsort(kind[here], kind="stable")]
            if len(here):
                here = here[np.linspace(0, len(here) - 1, min(len(here), MOST_STATES)).astype(np.int64)]
                name = word if place is None else f"{place.replace('_', '-')}-{value:02d}-{word}"
                captions = [_caption(split.origins, index, kinds) for index in here.tolist()]
                sheets[name] = contact_sheet(split.observations[here], captions)
    return sheets


def contact_sheet(observations: NDArray[np.uint8], captions: Sequence[str]) -> NDArray[np.uint8]:
    """Observations uint8 (n, H, W, C) in rows of ``COLUMNS``, a caption under each: uint8 (height, width, 3).

    Of three channels all are shown, as colours; else the last one, which is the newest of stacked frames, as grey.
    """
    from PIL import Image, ImageDraw

    count, height, width, channels = observations.shape
    shown = observations if channels == 3 else np.repeat(observations[..., -1:], 3, axis=3)
    shown = shown.repeat(SCALE, axis=1).repeat(SCALE, axis=2)
    high, wide = height * SCALE + CAPTION_HEIGHT + GAP, width * SCALE + GAP
    columns = min(COLUMNS, count)
    sheet = np.full((-(-count // columns) * high + GAP, columns * wide + GAP, 3), BACKGROUND, np.uint8)
    corners = [(GAP + index // columns * high, GAP + index % columns * wide) for index in range(count)]
    for image, (top, left) in zip(shown, corners, strict=True):
        sheet[top : top + height * SCALE, left : left + width * SCALE] = image
    picture = Image.fromarray(sheet)
    draw = ImageDraw.Draw(picture)
    for caption, (top, left) in zip(captions, corners, strict=True):
        draw.text((left, top + height * SCALE), caption, fill=(INK, INK, INK))
    return np.asarray(picture)


def _caption(origins: Mapping[str, NDArray[np.int64]], index: int, kinds: Sequence[str]) -> str:
    words = []
    if "kind" in origins:
        kind = int(origins["kind"][index])
        words.append(kinds[kind] if 0 <= kind < len(kinds) else f"kind {kind}")
    for x, y in WHERE:
        if x in origins and y in origins:
            words.append(f"{origins[x][index]},{origins[y][index]}")
    return " ".join(words)
