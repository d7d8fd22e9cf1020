"""Films of a run's agents, played from their saved weights (Spec E1, F7)."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

from hypogoal.core.artefacts import Artefact
from hypogoal.core.errors import UserError
from hypogoal.evaluation.page import source
from hypogoal.evaluation.run import find_artefacts
from hypogoal.observations import PICTURE

if TYPE_CHECKING:
    from hypogoal.meta.episodes import Frame
    from hypogoal.options.loop import OptionLoop

MOST_FRAMES = 200  # played for the page's film, till an episode has members that differ
NEEDED = "Videos need a meta artefact with learned terminations: train-meta."


class Film(NamedTuple):
    """An episode of an agent, the ``number``-th that it played."""

    agent: Artefact
    path: str  # the agent's, within the run
    number: int
    gif: bytes
    steps: int
    options: int  # executions

    @property
    def name(self) -> str:
        """Its file."""
        return f"{self.path.replace('/', '-')}-episode-{self.number}.gif"

    def told(self) -> dict[str, Any]:
        """What the page says of it, and the film itself."""
        facts = {"path": self.path, "number": self.number, "steps": self.steps, "options": self.options}
        config = self.agent.config
        return {
            **facts,
            "layout": config["layout_seed"],
            "members": config["members"],
            "source": source(self.gif, "gif"),
        }


def agents_of(run: Path) -> list[Artefact]:
    """The run's agents that learned to choose among members' options."""
    return [
        artefact
        for artefact in find_artefacts(run, "meta")
        if artefact.config["chooser"] != "random" and artefact.config["termination"] != "oracle"
    ]


def films_of(agents: Sequence[Artefact], run: Path, videos: int | None) -> tuple[list[Film], list[str]]:
    """So many ``videos`` of the agents in turn; None: one where there can be one, and a line where it cannot be.

    A ``UserError`` where films were asked for and there is no agent that sees pictures.
    """
    if videos == 0 or (videos is None and not agents):
        return [], []
    if not agents:
        raise UserError("no agent to make videos of", run, NEEDED)
    try:
        return [*play_films(agents, run, videos)], []
    except UserError as error:
        if videos:
            raise
        return [], [f"no film of an episode: {error}"]


def play_films(agents: Sequence[Artefact], run: Path, count: int | None) -> Iterator[Film]:
    """Spec E1: ``count`` episodes of the agents in turn, played from their saved weights.

    None: one of the first agent, the first that :func:`_tells` within ``MOST_FRAMES``, else the first of all.
    """
    from hypogoal.meta.episodes import agent_of, play_episode

    loops = [agent_of(artefact, seed=0) for artefact in agents[: count or 1]]
    for artefact, loop in zip(agents, loops, strict=False):
        if loop.engine.observation_dtype != PICTURE:
            raise UserError("videos need an agent that sees pictures", artefact.path, "Leave --videos out.")
    if count is None:
        yield _telling(agents[0], run, loops[0])
        return
    for index in range(count):
        number, which = divmod(index, len(agents))
        frames = play_episode(loops[which], agents[which].config["members"])
        yield _film(agents[which], run, number, frames)


def _telling(agent: Artefact, run: Path, loop: OptionLoop) -> Film:
    from hypogoal.meta.episodes import play_episode

    members = agent.config["members"]
    played: list[Sequence[Frame]] = []
    while sum(map(len, played)) < MOST_FRAMES:
        played.append(play_episode(loop, members))
        if _tells(played[-1], members):
            return _film(agent, run, len(played) - 1, played[-1])
    return _film(agent, run, 0, played[0])


def _tells(frames: Sequence[Frame], members: int) -> bool:
    """Whether the agent took the right one of members that differ: the last option's own ended a solved episode."""
    from hypogoal.meta.episodes import SOLVED

    last = frames[-1]
    right = last.ended == SOLVED and last.predictions[last.option % members]
    return right and any(len(set(frame.predictions)) > 1 for frame in frames)


def _film(artefact: Artefact, run: Path, number: int, frames: Sequence[Frame]) -> Film:
    from hypogoal.evaluation.pictures import episode_gif

    path, config = artefact.path.relative_to(run).as_posix(), artefact.config
    gif = episode_gif(frames, config["sub_goals"], config["members"], config["option_timeout"])
    options = sum(bool(frame.ended) for frame in frames)
    return Film(artefact, path, number, gif, frames[-1].step, options)
