"""Films of a run's agents, played from their saved weights (Spec E1, F7)."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

from hypogoal.core.artefacts import Artefact
from hypogoal.core.errors import UserError
from hypogoal.evaluation.run import find_artefacts
from hypogoal.observations import PICTURE

if TYPE_CHECKING:
    from hypogoal.meta.episodes import Frame

MOST_FRAMES = 200  # played for the page's film, till an episode has members that differ


class Film(NamedTuple):
    """An episode of an agent."""

    agent: Artefact
    name: str  # of its file
    caption: str
    gif: bytes


def agents_to_play(run: Path, videos: int | None) -> list[Artefact]:
    """Those that films are made of: as many as ``videos``; where nobody asked, the first where there is one."""
    if videos == 0:
        return []
    try:
        return agents_of(run)[: videos or 1]
    except NoAgent:
        if videos:
            raise
        return []


def films_of(agents: Sequence[Artefact], run: Path, videos: int | None) -> tuple[list[Film], list[str]]:
    """Those that were asked for; where nobody asked, one where there can be one, and a line where it cannot be."""
    if not agents:
        return [], []
    try:
        return play_films(agents, run, videos), []
    except UserError as error:
        if videos:
            raise
        return [], [] if isinstance(error, NoAgent) else [f"no film of an episode: {error}"]


def agents_of(run: Path) -> list[Artefact]:
    """The run's agents that learned to choose among members' options; a ``UserError`` where there is none."""
    agents = [
        artefact
        for artefact in find_artefacts(run, "meta")
        if artefact.config["chooser"] != "random" and artefact.config["termination"] != "oracle"
    ]
    if not agents:
        needed = "Videos need a meta artefact with learned terminations: train-meta."
        raise NoAgent("no agent to make videos of", run, needed)
    return agents


class NoAgent(UserError):
    """A run has no agent that learned to choose among members' options."""


def play_films(agents: Sequence[Artefact], run: Path, count: int | None) -> list[Film]:
    """Spec E1: ``count`` episodes of the agents in turn, played from their saved weights.

    None: one of the first agent, the first that :func:`_tells` within ``MOST_FRAMES``, else the first of all.
    """
    from hypogoal.meta.episodes import agent_of, play_episode

    loops = [agent_of(artefact, seed=0) for artefact in agents[: count or 1]]
    for artefact, loop in zip(agents, loops, strict=False):
        if loop.engine.observation_dtype != PICTURE:
            raise NoAgent("videos need an agent that sees pictures", artefact.path, "Leave --videos out.")
    if count is None:
        members, played = agents[0].config["members"], [play_episode(loops[0], agents[0].config["members"])]
        while sum(map(len, played)) < MOST_FRAMES and not _tells(played[-1], members):
            played.append(play_episode(loops[0], members))
        number = len(played) - 1 if _tells(played[-1], members) else 0
        return [_film(agents[0], run, number, played[number])]
    films = []
    for index in range(count):
        number, which = divmod(index, len(agents))
        frames = play_episode(loops[which], agents[which].config["members"])
        films.append(_film(agents[which], run, number, frames))
    return films


def _tells(frames: Sequence[Frame], members: int) -> bool:
    """Whether the agent took the right one of members that differ: the last option's own ended a solved episode."""
    from hypogoal.meta.episodes import SOLVED

    last = frames[-1]
    right = last.ended == SOLVED and last.predictions[last.option % members]
    return right and any(len(set(frame.predictions)) > 1 for frame in frames)


def _film(artefact: Artefact, run: Path, number: int, frames: Sequence[Frame]) -> Film:
    """An agent's episode, the ``number``-th that it played."""
    from hypogoal.evaluation.pictures import episode_gif

    path, config = artefact.path.relative_to(run).as_posix(), artefact.config
    gif = episode_gif(frames, config["sub_goals"], config["members"], config["option_timeout"])
    steps, options = frames[-1].step, sum(bool(frame.ended) for frame in frames)
    caption = (
        f"Episode {number} of {path}, layout {config['layout_seed']}: {steps} step{'' if steps == 1 else 's'}, "
        f"{options} option{'' if options == 1 else 's'}. Below each state: the option that runs, the steps left to it "
        f"(the bar), and {_boxes(config['members'])}."
    )
    return Film(artefact, f"{path.replace('/', '-')}-episode-{number}.gif", caption, gif)


def _boxes(members: int) -> str:
    """What the boxes below a state of a film are."""
    if members == 1:
        return "what its classifier predicts; it ends at a positive prediction"
    return "what each member of its sub-goal predicts; it ends at a positive prediction of its member (framed)"
