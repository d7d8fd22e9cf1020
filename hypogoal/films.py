"""Films of a run's agent, played from its saved weights."""

from __future__ import annotations

import io
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from PIL import Image, ImageDraw, ImageFont, ImageOps

from hypogoal.core.artefacts import Artefact
from hypogoal.core.errors import UserError
from hypogoal.evaluation.pictures import coloured
from hypogoal.evaluation.plots import INK, PALETTE
from hypogoal.evaluation.run import choice_of, find_artefacts
from hypogoal.observations import PICTURE

if TYPE_CHECKING:
    from hypogoal.meta.episodes import Frame
    from hypogoal.options.loop import OptionLoop

NEEDED = "Videos need a meta artefact with learned terminations: train-meta."
KEPT = "film.gif"  # the film in an evaluation
MOST_FRAMES = 200  # frames that are played at most to find an episode whose members differ
SIDE = 336  # pixels to which a state is enlarged, or a little less
LINE, MARGIN, BAR, FONT = 18, 8, 8, 13  # pixels below the state
STEP, PAUSE, END, LAST = 140, 500, 600, 1_500  # milliseconds: a step, members differ, an option's end, the last frame
SHADES = 48  # colours of a film
FAINT = "#a2a9b2"  # readable on the ink of a film


@dataclass(frozen=True)
class Film:
    """A film of an agent's episode."""

    gif: bytes
    facts: dict[str, Any]  # what the page says of the film

    @property
    def name(self) -> str:
        """The name of the film's file."""
        return f"{self.facts['path'].replace('/', '-')}-episode-{self.facts['number']}.gif"


def agent_to_film(run: Path) -> Artefact | None:
    """Return the run's first agent that learned to choose among members' options, or None."""
    agents = [artefact for artefact in find_artefacts(run, "meta") if choice_of(artefact) == "learned"]
    return agents[0] if agents else None


def keep_film(run: Path, folder: Path) -> dict[str, Any] | None:
    """Write into an evaluation's folder the film for the run's page, and return what the page says of the film.

    The film is of the episode that :func:`_telling` finds. If the run has no agent to film, or one that does not see
    pictures, there is no film and None is returned. Raises ``UserError`` if the agent cannot be loaded.
    """
    from hypogoal.meta.episodes import agent_of

    agent = agent_to_film(run)
    if agent is None:
        return None
    loop = agent_of(agent, seed=0)
    if loop.engine.observation_dtype != PICTURE:
        return None
    number, frames = _telling(loop, agent.config["members"])
    film = _film_of(agent, agent.path.relative_to(run).as_posix(), number, frames)
    (folder / KEPT).write_bytes(film.gif)
    return film.facts


def kept_films(evaluation: Path, facts: dict[str, Any] | None) -> list[Film]:
    """Return the film that :func:`keep_film` wrote into an evaluation's folder, if there is one."""
    return [] if facts is None else [Film((evaluation / KEPT).read_bytes(), facts)]


def films_of(agent: Artefact, path: str, count: int) -> list[Film]:
    """Play the first ``count`` episodes of an agent, whose path in the run is ``path``, and return a film of each.

    Raises ``UserError`` if the agent does not see pictures.
    """
    from hypogoal.meta.episodes import agent_of, play_episode

    loop = agent_of(agent, seed=0)
    if loop.engine.observation_dtype != PICTURE:
        raise UserError("videos need an agent that sees pictures", agent.path, "Leave --videos out.")
    return [_film_of(agent, path, number, play_episode(loop, agent.config["members"])) for number in range(count)]


def _film_of(agent: Artefact, path: str, number: int, frames: Sequence[Frame]) -> Film:
    config = agent.config
    gif = episode_gif(frames, config["sub_goals"], config["members"], config["option_timeout"])
    facts = {
        "path": path,
        "number": number,
        "steps": frames[-1].step,
        "options": sum(bool(frame.ended) for frame in frames),
        "layout": config["layout_seed"],
        "members": config["members"],
    }
    return Film(gif, facts)


def _telling(loop: OptionLoop, members: int) -> tuple[int, list[Frame]]:
    """Return the number and frames of the first episode in which members differed and the agent took the right one.

    It took the right one if the episode was solved, and the last option's own member ended that option. If no such
    episode begins within ``MOST_FRAMES``, it is the first episode.
    """
    from hypogoal.meta.episodes import SOLVED, play_episode

    played: list[list[Frame]] = []
    while sum(map(len, played)) < MOST_FRAMES:
        frames = play_episode(loop, members)
        last = frames[-1]
        is_right = last.ended == SOLVED and last.predictions[last.option % members]
        if is_right and any(len({*frame.predictions}) > 1 for frame in frames):
            return len(played), frames
        played.append(frames)
    return 0, played[0]


def frame_lines(frame: Frame, sub_goals: Sequence[str], members: int) -> list[str]:
    """Return the lines below a frame: the option that runs, each member's prediction, and why the option ended."""
    goal, running = divmod(frame.option, members)
    lines = [f"option: {sub_goals[goal]}"]
    for member, positive in enumerate(frame.predictions):
        name = f"member {member}" if members > 1 else "its classifier"
        mark = ">" if member == running else " "
        says = "reached" if positive else "not reached"
        lines.append(f"{mark} {name}: {says}")
    end = f", ends: {frame.ended}" if frame.ended else ""
    return [*lines, f"step {frame.step}{end}"]


def draw_frame(frame: Frame, sub_goals: Sequence[str], members: int, timeout: int) -> Image.Image:
    """Draw a frame, enlarged, with a bar and lines below.

    The bar is as long as the steps that are left to the option, of ``timeout``. Option g*K + k is member k of sub-goal
    g, and the bar has the colour of the sub-goal. Members that say 'reached' are written in white.
    """
    state = Image.fromarray(coloured(frame.observation))
    state = ImageOps.scale(state, max(1, SIDE // max(state.size)), Image.Resampling.NEAREST)
    width, height = state.size
    lines = frame_lines(frame, sub_goals, members)
    below = BAR + 2 * MARGIN + LINE * len(lines)
    picture = ImageOps.expand(state, (0, 0, 0, below), INK)
    draw = ImageDraw.Draw(picture)
    colour = PALETTE[frame.option // members % len(PALETTE)]
    draw.rectangle((0, height, width * frame.left / timeout, height + BAR), colour)
    font = ImageFont.load_default(FONT)
    top = height + BAR + MARGIN
    for line in lines:
        draw.text((MARGIN, top), line, FAINT if line.endswith("not reached") else "white", font)
        top += LINE
    return picture


def episode_gif(
    frames: Sequence[Frame],
    sub_goals: Sequence[str],
    members: int,
    timeout: int,
) -> bytes:
    """Return an episode, frames (n,) with n at least 1, as an animated GIF that plays over and over.

    The film pauses where an option ends, and where members of its sub-goal come to differ. 15 steps take 80 kB.
    """
    pictures, times = [], []
    before: tuple[bool, ...] = ()
    for frame in frames:
        picture = draw_frame(frame, sub_goals, members, timeout)
        pictures.append(picture.quantize(SHADES, dither=Image.Dither.NONE))
        differ = len({*frame.predictions}) > 1 and before != frame.predictions
        time = PAUSE if differ else STEP
        times.append(END if frame.ended else time)
        before = frame.predictions
    times[-1] = LAST
    buffer = io.BytesIO()
    first, *others = pictures
    first.save(buffer, "GIF", save_all=True, append_images=others, duration=times, loop=0, optimize=False)
    return buffer.getvalue()
