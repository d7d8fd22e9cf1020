"""Spec A5, F7: draw an evaluated run as one self-contained HTML page, and its figures as files."""

from pathlib import Path
from typing import Annotated

from typer import Argument, Option

from hypogoal.core.artefacts import versions
from hypogoal.core.errors import UserError
from hypogoal.core.terminal import say
from hypogoal.stages import NO_SETTINGS, Call, Done, stage

MOST_BYTES = 2_000_000  # of a film on the page
FILMS = "Films of the policy over options, in the report's videos/*.gif; the page shows one. Default: one, if possible."


@stage(
    "report runs/mine --videos 3",
    leaves_out=NO_SETTINGS,
    into="report",
    page="index.html",
)
def report(
    call: Call,
    run: Annotated[Path, Argument(help="An evaluated run.")],
    *,
    figures: Annotated[Path | None, Option(help="Draw the paper's figures into this folder, not the page.")] = None,
    format: Annotated[str, Option(help="For --figures: svg, pdf or png.")] = "svg",
    videos: Annotated[int | None, Option(min=0, help=FILMS)] = None,
) -> Done:
    """Draw the report of an evaluated run: one HTML file.

    ``out`` gets the page ``index.html``, ``figures/*.svg``, ``figures/*.png`` and, of so many ``videos``, which the
    first agent of the run plays, ``videos/*.gif``. With ``figures``, a folder, only the paper's figures are drawn.
    """
    if figures is not None:
        from hypogoal.evaluation.figure_files import draw_figures

        written, missing = draw_figures(run, figures, format, force=call.force)
        for line in missing:
            say(line, err=True)
        return Done([str(path) for path in written], path=figures)
    if format != "svg":
        raise UserError("--format is for --figures", format, "Give --figures DIR too, or leave it out.")

    from hypogoal.evaluation import films
    from hypogoal.evaluation.page import Material, film
    from hypogoal.evaluation.plots import to_png
    from hypogoal.evaluation.questions import render
    from hypogoal.evaluation.run import evaluation_of, fitting, read_evaluation

    source = evaluation_of(run)
    agents = films.agents_to_play(run, videos)
    config = {"videos": len(agents) if videos is None else videos}
    inputs = [source.path]
    for agent in agents:
        inputs.append(agent.path)
    with call.draft("report", config, inputs) as draft:
        evaluation = read_evaluation(run)
        played, unplayed = films.films_of(agents, run, videos)
        shown = [film(each.gif, each.caption) for each in played[:1] if len(each.gif) <= MOST_BYTES]
        missing = [*evaluation.metrics["missing"], *unplayed]
        metrics = {**evaluation.metrics, "missing": missing}
        material = Material(metrics, evaluation.arrays, films=shown)
        with fitting(source.path):
            page = render(material, versions()["hypogoal"])
        (draft.files / "index.html").write_text(page, encoding="utf-8")
        drawn = draft.files / "figures"
        drawn.mkdir()
        for name, figure in material.figures.items():
            (drawn / f"{name}.svg").write_text(material.drawings[name], encoding="utf-8")
            (drawn / f"{name}.png").write_bytes(to_png(figure))
        for each in played:
            filmed = draft.files / "videos"
            filmed.mkdir(exist_ok=True)
            (filmed / each.name).write_bytes(each.gif)
    return Done()
