"""Spec A5, F: every number of the report, from whatever artefacts a run has; what is missing is named."""

from pathlib import Path
from typing import Annotated, Any

from typer import Argument, Option

from hypogoal.core.artefacts import open_artefact
from hypogoal.core.progress import Progress
from hypogoal.core.terminal import drawn
from hypogoal.stages import NO_SETTINGS, WIDTH, Call, Done, stage

PLAYED = "Agents, and each option alone, also play these without learning: 2000-2099 or 7,9."


@stage("evaluate runs/mine", leaves_out=NO_SETTINGS, into="evaluation")
def evaluate(
    call: Call,
    run: Annotated[Path, Argument(help="A run: a folder with artefacts in it.")],
    *,
    layouts: Annotated[str | None, Option(help=PLAYED)] = None,
) -> Done:
    """Compute every number of a run: accuracy, curves, choices.

    ``run`` is a folder with ensemble, options, meta and baseline artefacts, any of them. ``out`` gets ``metrics.json``,
    ``numbers.csv`` and ``arrays.h5``.
    """
    from hypogoal.core.processes import prepare
    from hypogoal.data import create_hdf5
    from hypogoal.evaluation import questions
    from hypogoal.evaluation.judging import cases_of
    from hypogoal.evaluation.run import find
    from hypogoal.meta.config import layout_seeds

    prepare()
    played = tuple(layout_seeds(layouts)) if layouts else ()
    settings: dict[str, Any] = dict(questions.SETTINGS)
    if layouts:
        settings["layouts"] = layouts
    contents = find(run)
    trained = [artefact.path for artefact in contents.everything()]
    data = sorted({artefact.input("data") for artefact in contents.ensembles})
    cases = cases_of(contents.ensembles)
    with call.draft("evaluation", settings, [*data, *trained]) as draft:
        for path in trained:
            open_artefact(path)  # refuses changed files
        parts = 2 * len(cases) + len(contents.ladders) + len(contents.agents) * (1 + len(played))
        with (
            create_hdf5(draft.files / "arrays.h5") as arrays,
            Progress("evaluate", total=parts, quiet=call.quiet) as progress,
        ):
            work = questions.work_of(contents, arrays, progress, played)
            questions.judge_ensembles(work, cases)
            questions.answer(work)
            missing = [*questions.missing(work), *unmade_cells(run)]
            metrics = questions.metrics_of(work, settings, data, missing)
        questions.write(draft.files, metrics, work.rows)
    table = drawn(questions.summary_table(metrics), WIDTH).splitlines()
    if call.out == run / "evaluation":
        return Done(table, ("report", run))
    return Done(table, ("show", call.out))


def unmade_cells(run: Path) -> list[str]:
    """The cells that the run was to have and has not: failed, or not run yet."""
    from hypogoal.experiments.sweep import unmade

    left = unmade(run)
    if not left:
        return []
    names = ", ".join(left[:5]) + (", ..." if len(left) > 5 else "")
    return [f"{len(left)} of the run's cells are not done: {names}"]
