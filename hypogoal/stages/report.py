"""Spec A5, F7: draw an evaluated run as one self-contained HTML page, and its figures as files."""

from __future__ import annotations

from collections.abc import Sequence
from html import escape
from pathlib import Path
from typing import Any

from hypogoal.core.artefacts import Artefact, claim, create_artefact, find_artefacts, versions
from hypogoal.core.errors import UserError
from hypogoal.dataset import PICTURE
from hypogoal.evaluation.run import fitting, read_evaluation

KINDS = ("svg", "pdf", "png")


def report(run: Path, *, videos: int = 0, force: bool = False, resume: bool = False) -> Path:
    """Draw an evaluated run, see ``evaluation.run.read_evaluation``, with so many ``videos``: :func:`draw_videos`.

    Returns the page, ``run/report/index.html``. Beside it are ``figures/*.svg``, ``figures/*.png`` and
    ``videos/*.gif``. A run that was not evaluated, a damaged evaluation, a report that exists, or videos where there is
    no agent are a ``UserError``.
    """
    from hypogoal.evaluation.page import Material
    from hypogoal.evaluation.plots import to_png
    from hypogoal.evaluation.questions import render

    out = run / "report"
    found = read_evaluation(run)
    claim(out, kind="report", force=force, resume=resume)
    agents = agents_of(run) if videos else []
    inputs = [found.source.path, *(agent.path for agent in agents[:videos])]
    about: dict[str, Any] = {"kind": "report", "config": {"videos": videos}, "seed": 0, "inputs": inputs}
    with create_artefact(out, **about, force=force, resume=resume) as folder:
        material = Material(found.metrics, found.arrays)
        with fitting(found.source.path):
            page = render(material, versions().get("hypogoal", "unknown"))
        (folder / "index.html").write_text(page, encoding="utf-8")
        (folder / "figures").mkdir()
        for name, figure in material.figures.items():
            (folder / "figures" / f"{name}.svg").write_text(material.drawings[name], encoding="utf-8")
            (folder / "figures" / f"{name}.png").write_bytes(to_png(figure))
        if videos:
            draw_videos(agents, run, folder / "videos", videos)
    return out / "index.html"


def agents_of(run: Path) -> list[Artefact]:
    """The run's agents that learned to choose among members' options; a ``UserError`` where there is none."""
    found = [
        artefact
        for artefact in find_artefacts(run, "meta")
        if artefact.config["chooser"] != "random" and artefact.config["termination"] != "oracle"
    ]
    if not found:
        needed = "Videos need a meta artefact with learned terminations: train-meta."
        raise UserError("no agent to make videos of", run, needed)
    return found


def draw_videos(agents: Sequence[Artefact], run: Path, folder: Path, count: int) -> None:
    """Spec E1: episodes of the agents in turn, played from their saved weights, one GIF each."""
    from hypogoal.evaluation.pictures import episode_gif
    from hypogoal.meta.episodes import agent_of, play_episode

    folder.mkdir()
    for index in range(count):
        artefact, episode = agents[index % len(agents)], index // len(agents)
        config, loop = artefact.config, agent_of(artefact, seed=episode)
        if loop.engine.observation_dtype != PICTURE:
            raise UserError("videos need an agent that sees pictures", artefact.path, "Leave --videos out.")
        frames = play_episode(loop)
        name = artefact.path.relative_to(run).as_posix().replace("/", "-")
        gif = episode_gif(frames, config["sub_goals"], config["members"], config["option_timeout"])
        (folder / f"{name}-episode-{episode}.gif").write_bytes(gif)


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
    found = read_evaluation(run)
    with fitting(found.source.path):
        drawn, missing = paper_figures(Material(found.metrics, found.arrays))
    files = {folder / f"{slug(figure.stem)}.{kind}": figure for figure in drawn}
    captions = folder / "captions.md"
    for path in (*files, captions):
        if path.exists() and not force:
            raise UserError("exists already", path, "Give --force to replace it, or choose another folder.")
    try:
        folder.mkdir(parents=True, exist_ok=True)
        for path, drawing in files.items():
            if drawing.figure is not None:
                path.write_bytes(to_file(drawing.figure, drawing.stem, kind))
        text = [f"## {path.name}\n\n{escape(of.caption, quote=False)}\n" for path, of in files.items()]
        captions.write_text("\n".join([*text, *(f"{line}\n" for line in missing)]), encoding="utf-8")
    except OSError as error:
        raise UserError(f"cannot be written ({error.strerror})", folder, "Choose another folder.") from None
    return [*files, captions], missing
