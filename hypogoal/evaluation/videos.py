"""An agent's episode as a moving picture: the state, and below it the option, its member, its verdict and its time."""

from __future__ import annotations

import io
from collections.abc import Sequence
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from hypogoal.evaluation.plots import PALETTE

SIDE = 336  # pixels that the state is enlarged to, or a little less
LINE, MARGIN, BAR = 18, 8, 8  # pixels
FONT = 13
PAPER, INK, SOFT = (255, 255, 255), (36, 39, 43), (212, 215, 220)
STEP, END, LAST = 140, 600, 1_500  # milliseconds of a step, of an option's end, of the last frame


class Shown(Protocol):
    """What is drawn of a frame, see ``meta.watched.Frame``."""

    @property
    def observation(self) -> NDArray[np.uint8]: ...
    @property
    def step(self) -> int: ...
    @property
    def option(self) -> int: ...
    @property
    def says_yes(self) -> bool: ...
    @property
    def left(self) -> int: ...
    @property
    def ended(self) -> str: ...


def frame_lines(frame: Shown, sub_goals: Sequence[str], members: int) -> list[str]:
    """What is written below a frame: option and member; verdict and time left; why it ended."""
    sub_goal, member = sub_goals[frame.option // members], frame.option % members
    verdict = "yes" if frame.says_yes else "no"
    return [
        f"{sub_goal}, member {member}",
        f"step {frame.step}   reached? {verdict}   {frame.left} left",
        f"ends: {frame.ended}" if frame.ended else "",
    ]


def draw_frame(frame: Shown, sub_goals: Sequence[str], members: int, timeout: int) -> NDArray[np.uint8]:
    """A frame as a picture, uint8 (H, W, 3); a bar shows the time left, in the sub-goal's colour.

    Args:
        frame: see :class:`Shown`.
        sub_goals, members: G names and K; option g*K + k is member k of sub-goal g.
        timeout: an option's steps at most.
    """
    from PIL import Image, ImageDraw, ImageFont

    state = frame.observation if frame.observation.shape[-1] == 3 else frame.observation[..., -1:].repeat(3, axis=-1)
    times = max(1, SIDE // max(state.shape[:2]))
    large = np.ascontiguousarray(state.repeat(times, axis=0).repeat(times, axis=1))
    height, width = large.shape[:2]
    lines = frame_lines(frame, sub_goals, members)
    picture = Image.new("RGB", (width, height + BAR + 2 * MARGIN + LINE * len(lines)), PAPER)
    picture.paste(Image.fromarray(large))
    draw = ImageDraw.Draw(picture)
    colour = PALETTE[frame.option // members % len(PALETTE)]
    draw.rectangle((0, height, width, height + BAR), fill=SOFT)
    draw.rectangle((0, height, width * frame.left / timeout, height + BAR), fill=colour)
    font = ImageFont.load_default(FONT)
    for index, line in enumerate(lines):
        draw.text((MARGIN, height + BAR + MARGIN + index * LINE), line, fill=INK, font=font)
    return np.asarray(picture)


def episode_gif(frames: Sequence[Shown], sub_goals: Sequence[str], members: int, timeout: int) -> bytes:
    """An episode as an animated GIF that plays over and over; frames (n,), n at least 1."""
    from PIL import Image

    pictures = [Image.fromarray(draw_frame(frame, sub_goals, members, timeout)) for frame in frames]
    pictures = [picture.quantize(64, dither=Image.Dither.NONE) for picture in pictures]
    times = [END if frame.ended else STEP for frame in frames]
    times[-1] = LAST
    buffer = io.BytesIO()
    pictures[0].save(buffer, "GIF", save_all=True, append_images=pictures[1:], duration=times, loop=0, optimize=False)
    return buffer.getvalue()
