"""Spec A5, F: every number of the report, from whatever artefacts a run has; what is missing is named."""

import json
from pathlib import Path
from typing import Annotated, Any

from typer import Argument, Option

from hypogoal.core.artefacts import create, open_artefact
from hypogoal.core.progress import Progress
from hypogoal.core.terminal import drawn
from hypogoal.stages import WIDTH, Call, Done, stage

PLAYED = "Agents, and each option alone, also play these without learning: 2000-2099 or 7,9."


@stage("evaluate runs/mine", leaves_out=["preset", "set_", "seed", "device"], into="evaluation")
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
    from hypogoal.core.files import write_table
    from hypogoal.core.processes import cores, prepare
    from hypogoal.data import create_hdf5
    from hypogoal.evaluation import questions
    from hypogoal.evaluation.curves import group_runs, read_run
    from hypogoal.evaluation.judging import Work, cases_of, processes_for
    from hypogoal.evaluation.run import find
    from hypogoal.evaluation.table import Row, defined
    from hypogoal.meta.config import layout_seeds

    prepare()
    seeds = tuple(layout_seeds(layouts)) if layouts else ()
    settings = questions.SETTINGS | ({"layouts": layouts} if layouts else {})
    contents = find(run)
    trained = [artefact.path for artefact in contents.everything()]
    data = sorted({artefact.input("data") for artefact in contents.ensembles})
    cases = cases_of(contents.ensembles)
    workers = processes_for([case for _, case in cases], cores())
    inputs = [*data, *trained]
    about: dict[str, Any] = {"kind": "evaluation", "config": settings, "seed": 0, "inputs": inputs}
    with create(call.out, **about, force=call.force, resume=call.resume) as draft:
        for path in trained:
            open_artefact(path)  # refuses changed files
        parts = 2 * len(cases) + len(contents.ladders) + len(contents.agents) * (1 + len(seeds))
        progress = Progress("evaluate", total=parts, quiet=call.quiet)
        with create_hdf5(draft.files / "arrays.h5") as arrays, progress:
            agents = group_runs([read_run(artefact, contents.name(artefact)) for artefact in contents.agents])
            work = Work(contents, arrays, progress, seeds, agents=agents)
            questions.judge_ensembles(work, cases, workers)
            questions.answer(work)
            missing = [*questions.missing(work), *_unmade(run)]
            metrics = questions.metrics_of(work, settings, data, missing)
        write_table(draft.files / "numbers.csv", Row._fields, defined(work.rows))
        text = json.dumps(metrics, indent=1, allow_nan=False)
        (draft.files / "metrics.json").write_text(text + "\n", encoding="utf-8")
    then = ("report", run) if call.out == run / "evaluation" else ("show", call.out)
    return Done(drawn(questions.summary_table(metrics), WIDTH).splitlines(), then)


def _unmade(run: Path) -> list[str]:
    """The cells that the run was to have and has not: failed, or not run yet."""
    from hypogoal.experiments.sweep import unmade

    left = unmade(run)
    names = ", ".join([*left[:5], *(["..."] if len(left) > 5 else [])])
    return [f"{len(left)} of the run's cells are not done: {names}"] if left else []
