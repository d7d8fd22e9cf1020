"""Spec A5, F: every number of the report, from whatever artefacts a run has; what is missing is named."""

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from hypogoal.core.artefacts import create, open_artefact
from hypogoal.core.files import write_table
from hypogoal.core.processes import cores, prepare
from hypogoal.core.progress import Progress
from hypogoal.data import create_hdf5
from hypogoal.evaluation.curves import SOLVED, group_runs, read_run
from hypogoal.evaluation.distance import INSIDE, NEAR
from hypogoal.evaluation.judging import Case, Work, cases_of, judgements, processes_for
from hypogoal.evaluation.numbers import plain
from hypogoal.evaluation.provenance import provenance
from hypogoal.evaluation.questions import QUESTIONS, agents_last, meanings
from hypogoal.evaluation.run import FORMAT, find, most_used
from hypogoal.evaluation.table import Row, compared, defined
from hypogoal.experiments.sweep import unmade
from hypogoal.learners.episodes import LAST
from hypogoal.meta.config import layout_seeds

SETTINGS = {"window": LAST, "solved": SOLVED}
LADDERS = {"executions": LAST, "inside_counts": INSIDE, "near": NEAR}  # settings that only runs with ladders have


def evaluate(
    run: Path, out: Path, *, layouts: str = "", force: bool = False, resume: bool = False, quiet: bool = False
) -> dict[str, Any]:
    """Compute every number of the report and write an artefact: ``metrics.json``, ``numbers.csv``, ``arrays.h5``.

    ``run`` is a folder with ensemble, options, meta and baseline artefacts, any of them; none, or a damaged one, is a
    ``UserError``. On ``layouts``, 2000-2099, trained agents play, too, without learning. Returns what ``metrics.json``
    holds, see its ``quantities``.
    """
    prepare()
    seeds = tuple(layout_seeds(layouts)) if layouts else ()
    settings = SETTINGS | ({"layouts": layouts} if layouts else {})
    contents = find(run)
    inputs = [artefact.path for artefact in contents.everything()]
    data = sorted({artefact.input("data") for artefact in contents.ensembles})
    cases = cases_of(contents.ensembles)
    workers = processes_for([case for _, case in cases], cores())
    with create(
        out, kind="evaluation", config=settings, seed=0, inputs=[*data, *inputs], force=force, resume=resume
    ) as draft:
        for path in inputs:
            open_artefact(path)  # refuses changed files
        parts = 2 * len(cases) + len(contents.ladders) + len(contents.agents) * (1 + len(seeds))
        steps = Progress("evaluate", total=parts, quiet=quiet)
        with create_hdf5(draft.files / "arrays.h5") as arrays, steps as progress:
            agents = group_runs([read_run(artefact, contents.name(artefact)) for artefact in contents.agents])
            work = Work(contents, arrays, progress, seeds, agents=agents)
            judge_ensembles(work, cases, workers)
            for question in QUESTIONS:
                work.rows += question.rows(work)
                work.metrics |= question.view(work)
            pairs = [question.pairs for question in QUESTIONS if question.pairs]
            metrics = plain(
                {
                    "format": FORMAT,
                    "run": contents.run.resolve().name,
                    "settings": {**settings, **(LADDERS if contents.ladders else {})},
                    "missing": missing(work),
                    **work.metrics,
                    "comparisons": {by.name: compared(work.rows, by) for by in pairs},
                    "provenance": provenance(contents, data),
                    "quantities": meanings(),
                }
            )
        write_table(draft.files / "numbers.csv", Row._fields, defined(work.rows))
        text = json.dumps(metrics, indent=1, allow_nan=False)
        (draft.files / "metrics.json").write_text(text + "\n", encoding="utf-8")
    return metrics


def judge_ensembles(work: Work, cases: Sequence[tuple[int, Case]], workers: int) -> None:
    """Show the questions every ensemble of the run on its data's held-out and unlabelled states.

    Of one ensemble, the first of those with the most members, example states and attributions are kept too; of one,
    the one with the most members whose options were learned most often, states to browse.
    """
    configs = [artefact.config for artefact in work.contents.ensembles]
    work.shown = max(range(len(configs)), key=lambda index: configs[index]["members"], default=None)
    work.browsed = most_used(work.contents)
    rows: list[list[Row]] = [[] for _ in configs]
    for judgement in judgements(cases, workers, work.progress.advance):
        for question in QUESTIONS:
            rows[judgement.number] += question.look(work, judgement)
        work.progress.advance()
    work.rows += [row for of_ensemble in rows for row in of_ensemble]


def missing(work: Work) -> list[str]:
    """One line for everything of section F that this run has no artefacts for.

    A run with ladders is asked for what Figures 3 to 5 need, one with agents for those that Figure 6 has beside them.
    """
    lines = [] if work.contents.ensembles else ["no ensemble"]
    lines += [line for question in agents_last() for line in question.missing(work)]
    return lines + _unfinished_cells(work.contents.run)


def _unfinished_cells(run: Path) -> list[str]:
    """The cells that the run was to have and has not: failed, or not run yet."""
    left = unmade(run)
    names = ", ".join([*left[:5], *(["..."] if len(left) > 5 else [])])
    return [f"{len(left)} of the run's cells are not done: {names}"] if left else []
