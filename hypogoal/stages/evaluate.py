"""The stage that computes every number of the report from the artefacts of a run, and names what is missing."""

from pathlib import Path
from typing import Annotated

from typer import Argument, Option

from hypogoal import cells
from hypogoal.command.call import NO_SETTINGS, Call, Done
from hypogoal.command.stage import stage
from hypogoal.core.artefacts import open_artefact
from hypogoal.core.errors import UserError
from hypogoal.core.progress import Progress

PLAYED = "Other layouts, such as 2000-2099 or 7,9, on which agents and single options are to play, without learning."


@stage(
    "evaluate runs/mine",
    leaves_out=NO_SETTINGS,
    then="report {source}",
    into="evaluation",
)
def evaluate(
    call: Call,
    run: Annotated[Path, Argument(help="A run: a folder with artefacts in it.")],
    *,
    layouts: Annotated[str | None, Option(help=PLAYED)] = None,
) -> Done:
    """Compute every number of a run, such as accuracies and choices.

    ``run`` is a folder with any ensemble, options, meta and baseline artefacts. ``out`` gets ``numbers.csv``, each
    question's ``tables/*.csv``, ``run.json`` (what is missing, provenance) and ``arrays.h5``. If an agent chooses among
    options and sees pictures, ``out`` also gets ``film.gif``, and if an experiment made the run, ``results.csv``.
    """
    from hypogoal.core.hdf5 import create_hdf5
    from hypogoal.core.processes import prepare
    from hypogoal.evaluation import questions
    from hypogoal.evaluation.judging import Work
    from hypogoal.evaluation.run import find
    from hypogoal.films import keep_film
    from hypogoal.meta.config import layout_seeds

    prepare()
    settings = {"layouts": layouts} if layouts else {}
    played = tuple(layout_seeds(layouts)) if layouts else ()
    contents = find(run)
    trained = [artefact.path for artefact in contents.everything()]
    with call.draft("evaluation", settings, [*contents.data(), *trained]) as draft:
        for path in trained:
            open_artefact(path)  # raises UserError if files were changed
        times = 1 + len(played)
        parts = len(contents.ladders) + times * len(contents.agents)
        for ensemble in contents.ensembles:
            parts += 1 + len(ensemble.config["sub_goals"])
        with (
            create_hdf5(draft.files / "arrays.h5") as arrays,
            Progress("evaluate", total=parts, quiet=call.quiet) as progress,
        ):
            work = Work(contents, arrays, progress, played)
            work.facts["film"] = None
            missing = []
            try:
                work.facts["film"] = keep_film(run, draft.files)
            except UserError as error:  # numbers need no film, for which code of the user's own may have to be loaded
                missing.append(f"no film of an episode: {str(error).rstrip('.')}")
            results = questions.answer(work, settings)
        if left := cells.unmade(run):
            missing.append(f"{len(left)} of the run's cells are not done; the first is {left[0]}")
        results.facts["missing"].extend(missing)
        lines = questions.write(draft.files, results, questions.answers(results))
        cells.write_results(run, draft.files)
    return Done(lines)
