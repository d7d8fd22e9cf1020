"""The stage that draws an evaluated run as one self-contained HTML page, and its figures as files."""

from itertools import chain
from pathlib import Path
from typing import Annotated

from typer import Argument, Option

from hypogoal.command.call import NO_SETTINGS, Call, Done
from hypogoal.command.stage import stage
from hypogoal.core.errors import UserError
from hypogoal.core.progress import say

MOST_BYTES = 2_000_000  # a larger film is not shown on the page
FILMS = (
    "How many episodes of the agent to play and write as films, videos/*.gif. The page shows the first. Default: only "
    "the film that evaluate kept."
)


@stage("report runs/mine --videos 3", leaves_out=NO_SETTINGS, into="report")
def report(
    call: Call,
    run: Annotated[Path, Argument(help="An evaluated run.")],
    *,
    figures: Annotated[Path | None, Option(help="Draw only the paper's figures, into this folder.")] = None,
    format: Annotated[str, Option(help="The format of --figures: svg, pdf or png.")] = "svg",
    videos: Annotated[int | None, Option(min=0, help=FILMS)] = None,
) -> Done:
    """Draw the report of an evaluated run as one HTML file.

    ``out`` gets the page ``index.html`` and ``figures/*.svg``. ``videos`` is how many episodes of the run's first agent
    are played and filmed into ``videos/*.gif``. By default there is only the film that ``evaluate`` kept. With
    ``figures``, a folder, only the paper's figures are drawn.
    """
    if figures is not None:
        from hypogoal.evaluation.figure_files import draw_figures

        written, missing = draw_figures(run, figures, format, force=call.force)
        for line in missing:
            say(line, err=True)
        return Done([str(path) for path in written], path=figures)
    if format != "svg":
        raise UserError("--format is for --figures", format, "Give --figures DIR too, or leave it out.")

    from hypogoal.evaluation.page import source, write
    from hypogoal.evaluation.questions import answers, render
    from hypogoal.evaluation.run import evaluation_of, read_evaluation
    from hypogoal.films import NEEDED, agent_to_film, films_of, kept_films

    evaluation = evaluation_of(run)
    agent = None if videos == 0 else agent_to_film(run)
    if agent is None and videos:
        raise UserError("no agent to make videos of", run, NEEDED)
    inputs = [evaluation.path] if agent is None else [evaluation.path, agent.path]
    with call.draft("report", {"videos": "kept" if videos is None else videos}, inputs) as draft:
        results = read_evaluation(run)
        films = kept_films(evaluation.path, results.facts["film"]) if videos is None else []
        if agent and videos:
            films = films_of(agent, agent.path.relative_to(run).as_posix(), videos)
        every = answers(results)
        small = [film for film in films[:1] if len(film.gif) <= MOST_BYTES]
        shown = [film.facts | {"source": source(film.gif, "gif")} for film in small]
        page = render(results, every, shown)
        drawn = chain.from_iterable(each["figures"] for each in every)
        write(draft.files, page, drawn)
        moving = draft.files / "videos"
        for film in films:
            moving.mkdir(exist_ok=True)
            path = moving / film.name
            path.write_bytes(film.gif)
    return Done()
