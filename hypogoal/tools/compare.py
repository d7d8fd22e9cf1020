"""The command that puts several evaluated runs side by side, as one page and its numbers."""

from pathlib import Path
from typing import Annotated

from typer import Argument

from hypogoal.command.call import NO_SETTINGS, Call, Done
from hypogoal.command.stage import stage
from hypogoal.core.artefacts import SUMMARY
from hypogoal.core.errors import UserError


@stage(
    "compare runs/mine runs/other --out runs/both",
    leaves_out=(*NO_SETTINGS, "resume", "quiet"),
)
def compare(
    call: Call,
    runs: Annotated[
        list[Path], Argument(metavar="RUN...", help="Evaluated runs; each is compared with the first one.")
    ],
) -> Done:
    """Put evaluated runs side by side, and say which one wins.

    Raises ``UserError`` if there are fewer than two runs, if a run is named twice, if a run was not evaluated, or if
    the runs cannot be compared.
    """
    from hypogoal.evaluation.page import write
    from hypogoal.evaluation.run import evaluation_of, read_evaluation
    from hypogoal.tools import beside

    where = " ".join(map(str, runs))
    places = {run.resolve() for run in runs}
    if len(places) < max(2, len(runs)):
        raise UserError("a comparison takes two or more different runs", where, "Name each run once.")
    inputs = [evaluation_of(run).path for run in runs]
    with call.draft("comparison", {}, inputs) as draft:
        labels = beside.labels_of([run.resolve().as_posix() for run in runs])
        evaluations = map(read_evaluation, runs)
        results = dict(zip(labels, evaluations, strict=True))
        questions = beside.shared(results)
        reason = beside.why_not(results, questions)
        if reason is not None:
            raise UserError("these runs cannot be compared", reason, "Choose runs of one experiment, evaluated alike.")
        paths = [str(run) for run in runs]
        page, figures, tables = beside.page_of(results, questions, paths)
        write(draft.files, page, figures)
        for name, table in tables.items():
            table.to_csv(draft.files / f"{name}.csv", index=False)
        lines = beside.winners(tables["pairs"])
        (draft.files / SUMMARY).write_text("\n".join(lines) + "\n", encoding="utf-8")
    return Done(lines)
