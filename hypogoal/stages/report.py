"""Spec A5, F7: draw an evaluated run as one self-contained HTML page, and its figures as files."""

from __future__ import annotations

from collections.abc import Sequence
from html import escape
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

from hypogoal.core.artefacts import Artefact, create, find_artefacts, versions
from hypogoal.core.errors import UserError
from hypogoal.core.files import replace_text, replacing
from hypogoal.evaluation.run import evaluation_of, fitting, read_evaluation
from hypogoal.observations import PICTURE

if TYPE_CHECKING:
    from hypogoal.meta.episodes import Frame

KINDS = ("svg", "pdf", "png")
MOST_BYTES = 2_000_000  # of a film on the page
MOST_FRAMES = 200  # played for the page's film, till an episode has members that differ


def report(run: Path, *, videos: int | None = None, force: bool = False, resume: bool = False) -> Path:
    """Draw an evaluated run, see ``evaluation.run.read_evaluation``, with so many ``videos``: :func:`play_films`.

    None: one, where the run has an agent that can be played. Returns the page, ``run/report/index.html``, which shows
    the first of them. Beside it are ``figures/*.svg``, ``figures/*.png`` and ``videos/*.gif``. A run that was not
    evaluated, a damaged evaluation, a report that exists, or videos where there is no agent are a ``UserError``.
    """
    from hypogoal.evaluation.page import Material, film
    from hypogoal.evaluation.plots import to_png
    from hypogoal.evaluation.questions import render

    out = run / "report"
    source = evaluation_of(run)
    agents = _agents(run, videos)
    inputs = [source.path, *(agent.path for agent in agents)]
    config = {"videos": len(agents) if videos is None else videos}
    with create(out, kind="report", config=config, seed=0, inputs=inputs, force=force, resume=resume) as draft:
        evaluation = read_evaluation(run)
        films, missing = _films(agents, run, videos)
        metrics = {**evaluation.metrics, "missing": [*evaluation.metrics["missing"], *missing]}
        shown = [film(episode.gif, episode.caption) for episode in films[:1] if len(episode.gif) <= MOST_BYTES]
        material = Material(metrics, evaluation.arrays, films=shown)
        with fitting(source.path):
            page = render(material, versions().get("hypogoal", "unknown"))
        (draft.files / "index.html").write_text(page, encoding="utf-8")
        figures = draft.files / "figures"
        figures.mkdir()
        for name, figure in material.figures.items():
            (figures / f"{name}.svg").write_text(material.drawings[name], encoding="utf-8")
            (figures / f"{name}.png").write_bytes(to_png(figure))
        for episode in films:
            (draft.files / "videos").mkdir(exist_ok=True)
            (draft.files / "videos" / episode.name).write_bytes(episode.gif)
    return out / "index.html"


class Film(NamedTuple):
    """An episode of an agent."""

    agent: Artefact
    name: str  # of its file
    caption: str
    gif: bytes


def _agents(run: Path, videos: int | None) -> list[Artefact]:
    """Those that films are made of: as many as ``videos``; where nobody asked, the first where there is one."""
    if videos == 0:
        return []
    try:
        return agents_of(run)[: videos or 1]
    except NoAgent:
        if videos:
            raise
        return []


def _films(agents: Sequence[Artefact], run: Path, videos: int | None) -> tuple[list[Film], list[str]]:
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


def draw_figures(run: Path, folder: Path, kind: str = "svg", *, force: bool = False) -> tuple[list[Path], list[str]]:
    """Draw the paper's figures, those that the run has artefacts for, as files of their own, and ``captions.md``.

    Returns the files written, and a line for each of Figures 2 to 9 that cannot be drawn, with what it needs. Another
    ``kind`` than those in ``KINDS``, a run that was not evaluated, or a file that is there is a ``UserError``.
    """
    from hypogoal.evaluation.page import Material
    from hypogoal.evaluation.plots import slug, to_file
    from hypogoal.evaluation.questions import paper_figures

    if kind not in KINDS:
        raise UserError("no such format of figures", kind, f"Choose one of {', '.join(KINDS)}.")
    evaluation = read_evaluation(run)
    with fitting(evaluation.source.path):
        drawn, missing = paper_figures(Material(evaluation.metrics, evaluation.arrays))
    files = {folder / f"{slug(figure.stem)}.{kind}": figure for figure in drawn}
    captions = folder / "captions.md"
    for path in (*files, captions):
        if path.exists() and not force:
            raise UserError("exists already", path, "Give --force to replace it, or choose another folder.")
    try:
        folder.mkdir(parents=True, exist_ok=True)
        for path, drawing in files.items():
            if drawing.figure is not None:
                with replacing(path) as fresh:
                    fresh.write_bytes(to_file(drawing.figure, drawing.stem, kind))
        captions_of = {path: " ".join(filter(None, (drawing.caption, drawing.runs))) for path, drawing in files.items()}
        text = [f"## {path.name}\n\n{escape(caption, quote=False)}\n" for path, caption in captions_of.items()]
        replace_text(captions, "\n".join([*text, *(f"{line}\n" for line in missing)]))
    except OSError as error:
        raise UserError(f"cannot be written ({error.strerror})", folder, "Choose another folder.") from None
    return [*files, captions], missing
