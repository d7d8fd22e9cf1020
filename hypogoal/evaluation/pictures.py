"""States as pictures (Spec F2, F7): small ones, with attributions, many on a sheet, and an episode that moves."""

from __future__ import annotations

import io
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from hypogoal.core.errors import UserError
from hypogoal.data import SPLITS, States, open_dataset
from hypogoal.domains.base import installed_domain
from hypogoal.evaluation.plots import PALETTE
from hypogoal.observations import PICTURE, spread_rows, type_text

if TYPE_CHECKING:
    from hypogoal.meta.episodes import Frame

FULL = 127  # what the strongest attribution of a picture is stored as
MOST_SIDE = 128  # pixels of a picture on the page
COLOURS = 256  # that a PNG's palette holds
LEVELS, SHADES = 12, 6  # steps of an attribution's strength and of the state behind it, so that a palette holds all
AGAINST, FOR = (0, 114, 178), (213, 94, 0)  # Okabe and Ito's blue and vermillion: a pair that all readers tell apart
STATES = "termination-states"  # in an evaluation's arrays: of how many states each option's overlay is
FEW = 200  # states whose median is taken for what is usual
MOST_STATES = 60  # on a sheet
COLUMNS = 10
SCALE = 2
CAPTION_HEIGHT, GAP = 14, 4  # pixels
BACKGROUND, INK = 40, 230  # grey levels
SIDE = 336  # pixels that a moving state is enlarged to, or a little less
LINE, MARGIN, BAR = 18, 8, 8  # pixels below it
BOX, BOXES = 2 * 18 + 8, 4  # pixels of a member's box, and how many stand in a row
FONT = 13
# Below the state it is dark on pages of either scheme.
STRIP, PALE, FAINT, EMPTY = (31, 34, 38), (228, 230, 233), (162, 169, 178), (84, 90, 98)
STEP, PAUSE, END, LAST = 140, 500, 600, 1_500  # milliseconds: a step, members differ, an option's end, the last frame
PLACES = ("room", "layout_seed")  # origins of which each value gets sheets of its own: the first that there is
WHERE = (("x", "y"), ("agent_x", "agent_y"))  # origins that say where the agent is


def image_png(image: NDArray[np.uint8]) -> bytes:
    """An observation uint8 (H, W, 3) or (H, W), pixel for pixel; with a palette where its colours fit in one."""
    from PIL import Image

    picture = Image.fromarray(np.ascontiguousarray(image))
    if image.ndim == 3:
        colours, index = np.unique(image.reshape(-1, 3), axis=0, return_inverse=True)
        if len(colours) <= COLOURS:
            picture = Image.fromarray(index.reshape(image.shape[:2]).astype(np.uint8))
            picture.putpalette(colours.astype(np.uint8).tobytes())
    buffer = io.BytesIO()
    picture.save(buffer, format="PNG", optimize=True)
    return buffer.getvalue()


def reduced(values: NDArray[Any]) -> NDArray[Any]:
    """A picture (H, W) or (H, W, C) of at most ``MOST_SIDE`` pixels a side: means of squares, for the page's sake.

    One that is no larger is as it was; what no whole square fills at the right and below is cut.
    """
    step = -(-max(values.shape[:2]) // MOST_SIDE)
    if step == 1:
        return values
    height, width = (size // step for size in values.shape[:2])
    squares = values[: height * step, : width * step].reshape(height, step, width, step, *values.shape[2:])
    return np.asarray(squares.mean((1, 3)).astype(values.dtype))


def attribution_image(values: NDArray[np.floating], grey: NDArray[np.floating]) -> NDArray[np.uint8]:
    """Figures 2 and 9: signed attributions (H, W) as a picture, uint8 (H, W, 3).

    Orange where positive, blue where negative, white where none; full colour at the 99.5th percentile of the absolute
    values. The state shows through, by its brightness ``grey`` (H, W) in 0..1, as a light shade. In steps, which keeps
    the file small.
    """
    size = float(np.quantile(np.abs(values), 0.995)) or 1.0
    strength = (LEVELS * np.clip(np.abs(values) / size, 0, 1)).round()[..., None] / LEVELS
    shade = (SHADES * grey[..., None]).round() / SHADES
    ends = np.array([AGAINST, FOR]) / 255
    paper = np.repeat(1 - 0.28 * shade, 3, axis=-1)
    image = (1 - strength) * paper + strength * ends[(values > 0).astype(np.int64)]
    return np.asarray((255 * image).round().astype(np.uint8))


def last_frame(values: NDArray[Any], colours: int | None = None) -> NDArray[Any]:
    """Of pictures (..., C) the last frame's channels, so many ``colours``: by default 3 where C is 3, else 1."""
    return values[..., -(colours or (3 if values.shape[-1] == 3 else 1)) :]


def flat(values: NDArray[np.floating], colours: int | None = None) -> NDArray[np.floating]:
    """Attributions (..., C) to be drawn, (...): of the last frame the sum over its colours."""
    return last_frame(values, colours).sum(-1)


def brightness(observations: NDArray[np.uint8], colours: int | None = None) -> NDArray[np.uint8]:
    """Observations (..., C) in grey, (...): of the last frame."""
    return last_frame(observations, colours).mean(-1).astype(np.uint8)


def coloured(observations: NDArray[np.uint8], colours: int | None = None) -> NDArray[np.uint8]:
    """Observations (..., C) as they are shown, (..., 3): of the last frame."""
    shown = last_frame(observations, colours)
    return shown if shown.shape[-1] == 3 else shown.repeat(3, axis=-1)


def to_bytes(values: NDArray[np.floating]) -> NDArray[np.int8]:
    """Signed attributions (..., H, W) of pictures as int8, each picture's strongest at 127.

    Strongest: the 99.5th percentile of the absolute values; what is beyond is cut.
    """
    size = np.quantile(np.abs(values), 0.995, axis=(-2, -1), keepdims=True)
    scaled = np.divide(values, size, out=np.zeros_like(values, dtype=np.float64), where=size > 0)
    return np.asarray((FULL * np.clip(scaled, -1, 1)).round().astype(np.int8))


def overlay(states: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Figures 7 and 8: termination states uint8 (n, H, W, C), n at least 1, laid over each other.

    The state with the fewest unusual pixels is drawn whole. Over it, half transparent, is what the others show that is
    unusual: agents in other cells, say. A pixel is usual that is as in the median state.
    """
    few = states[:: max(1, len(states) // FEW)]
    usual = np.partition(few, len(few) // 2, axis=0)[len(few) // 2]
    unusual = states != usual
    if states.shape[-1] == 3:  # a colour is one thing, a stack's frames are several
        unusual = np.repeat(unusual.any(-1, keepdims=True), 3, axis=-1)
    whole = unusual.reshape(len(states), -1).sum(1).argmin()
    shown, count = states[whole], unusual.sum(0)
    others = np.where(unusual, states, 0).sum(0, dtype=np.float64) / np.maximum(count, 1)
    return np.where((count > 0) & ~unusual[whole], (shown + others) / 2, shown).round().astype(np.uint8)


def write_contact_sheets(path: Path, folder: Path) -> list[Path]:
    """Draw a data file's labelled and held-out states, one picture per room and label, to check labels by eye.

    The files are ``labelled/room-01-positives.png`` and so on in ``folder``, in a folder per sub-goal if there are
    several. A path that is no data file and states that are not pictures are a ``UserError``.
    """
    from PIL import Image

    if not path.is_file():
        raise UserError("contact sheets need a data file", path, "Give the .h5 file of the states.")
    dataset = open_dataset(path)
    if dataset.observation_dtype != PICTURE or len(dataset.observation_shape) != 3:
        actual = f"{type_text(dataset.observation_dtype)} {dataset.observation_shape}"
        raise UserError("the states are not pictures", actual, "Read them with h5py, see docs/formats.md.")
    domain = installed_domain(dataset.domain)
    kinds = domain.kinds if domain else ()
    written = []
    for split in SPLITS:
        for sub_goal in dataset.sub_goals:
            place = folder / split / (sub_goal if len(dataset.sub_goals) > 1 else "")
            sheets = contact_sheets(getattr(dataset, split)(sub_goal), kinds)
            for name, sheet in sheets.items():
                place.mkdir(parents=True, exist_ok=True)
                written.append(place / f"{name}.png")
                Image.fromarray(sheet).save(written[-1])
    return written


def contact_sheets(split: States, kinds: Sequence[str] = ()) -> dict[str, NDArray[np.uint8]]:
    """Sheets of a split's states, one for each room and label, by names like ``room-01-positives``.

    Each, uint8 (height, width, 3), shows ``MOST_STATES`` states at most, spread evenly over those of the room and label
    in the order of their kinds (``kinds`` names the values of that origin), with kind and position under each.
    """
    place = next((name for name in PLACES if name in split.origins), None)
    places = np.zeros(len(split.labels), np.int64) if place is None else split.origins[place]
    kind = split.origins.get("kind", np.zeros(len(split.labels), np.int64))
    sheets = {}
    for value in np.unique(places).tolist():
        for label, word in ((True, "positives"), (False, "negatives")):
            inside = np.flatnonzero((places == value) & (split.labels == label))
            inside = inside[np.argsort(kind[inside], kind="stable")]
            if len(inside):
                inside = inside[spread_rows(len(inside), MOST_STATES)]
                name = word if place is None else f"{place.replace('_', '-')}-{value:02d}-{word}"
                captions = [_caption(split.origins, index, kinds) for index in inside.tolist()]
                sheets[name] = contact_sheet(split.observations[inside], captions)
    return sheets


def contact_sheet(observations: NDArray[np.uint8], captions: Sequence[str]) -> NDArray[np.uint8]:
    """Observations uint8 (n, H, W, C), see :func:`coloured`, in rows of ``COLUMNS``, a caption under each.

    Returns uint8 (height, width, 3).
    """
    from PIL import Image, ImageDraw

    count, height, width, _ = observations.shape
    shown = coloured(observations).repeat(SCALE, axis=1).repeat(SCALE, axis=2)
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


def frame_lines(frame: Frame, sub_goals: Sequence[str], members: int, timeout: int) -> list[str]:
    """What is written below a frame: the option, with its member of several; the steps left; why it ended."""
    sub_goal, member = sub_goals[frame.option // members], frame.option % members
    return [
        f"option: {sub_goal}, member {member}" if members > 1 else f"option: {sub_goal}",
        f"{frame.left} of {timeout} steps left",
        f"step {frame.step}, ends: {frame.ended}" if frame.ended else f"step {frame.step}",
    ]


def draw_frame(frame: Frame, sub_goals: Sequence[str], members: int, timeout: int) -> NDArray[np.uint8]:
    """A frame as a picture, uint8 (H, W, 3); a bar shows the steps left, a box each member's prediction.

    Option g*K + k is member k of sub-goal g, whose box has a frame in the sub-goal's colour; ``timeout`` is an option's
    steps at most.
    """
    from PIL import Image, ImageDraw, ImageFont

    state = coloured(frame.observation)
    times = max(1, SIDE // max(state.shape[:2]))
    large = np.ascontiguousarray(state.repeat(times, axis=0).repeat(times, axis=1))
    height, width = large.shape[:2]
    option, left, last = frame_lines(frame, sub_goals, members, timeout)
    rows = -(-members // BOXES)
    picture = Image.new("RGB", (width, height + 3 * MARGIN + 3 * LINE + rows * (BOX + MARGIN)), STRIP)
    picture.paste(Image.fromarray(large))
    draw, font = ImageDraw.Draw(picture), ImageFont.load_default(FONT)
    colour = PALETTE[frame.option // members % len(PALETTE)]
    top = height + MARGIN
    draw.text((MARGIN, top), option, fill=PALE, font=font)
    top += LINE + BAR // 2
    middle = width // 2
    draw.rectangle((MARGIN, top, middle, top + BAR), fill=EMPTY)
    if frame.left:
        draw.rectangle((MARGIN, top, MARGIN + (middle - MARGIN) * frame.left / timeout, top + BAR), fill=colour)
    draw.text((middle + MARGIN, top - BAR // 2), left, fill=PALE, font=font)
    top += LINE
    wide = (width - MARGIN) // min(members, BOXES)
    for member, positive in enumerate(frame.predictions):
        corner = (MARGIN + member % BOXES * wide, top + member // BOXES * (BOX + MARGIN))
        runs = member == frame.option % members
        end = (corner[0] + wide - MARGIN, corner[1] + BOX)
        draw.rectangle((*corner, *end), EMPTY if positive else STRIP, colour if runs else EMPTY, width=3 if runs else 1)
        texts = (f"member {member}" if members > 1 else "its classifier", "positive" if positive else "negative")
        for line, (text, ink) in enumerate(zip(texts, (PALE, PALE if positive else FAINT), strict=True)):
            draw.text((corner[0] + MARGIN, corner[1] + 4 + line * LINE), text, fill=ink, font=font)
    draw.text((MARGIN, top + rows * (BOX + MARGIN)), last, fill=PALE, font=font)
    return np.asarray(picture)


def episode_gif(frames: Sequence[Frame], sub_goals: Sequence[str], members: int, timeout: int) -> bytes:
    """An episode as an animated GIF that plays over and over, 80 kB for 15 steps; frames (n,), n at least 1.

    It pauses where an option ends, and where its member comes to differ from others of its sub-goal.
    """
    from PIL import Image

    pictures = [Image.fromarray(draw_frame(frame, sub_goals, members, timeout)) for frame in frames]
    pictures = [picture.quantize(64, dither=Image.Dither.NONE) for picture in pictures]
    times = []
    for before, frame in zip([None, *frames], frames, strict=False):
        differ = len(set(frame.predictions)) > 1 and (before is None or before.predictions != frame.predictions)
        times.append(END if frame.ended else PAUSE if differ else STEP)
    times[-1] = LAST
    buffer = io.BytesIO()
    pictures[0].save(buffer, "GIF", save_all=True, append_images=pictures[1:], duration=times, loop=0, optimize=False)
    return buffer.getvalue()
