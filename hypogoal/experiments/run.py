"""A run of cells: begun, made anew in part, gone on with (Spec A6, G1, G4)."""

import shutil
from collections.abc import Callable, Sequence
from itertools import zip_longest
from pathlib import Path

from hypogoal.cells import CELLS, FAILED, PLAN, Cell, read_plan
from hypogoal.core.errors import UserError
from hypogoal.core.files import replace_text
from hypogoal.experiments import slurm
from hypogoal.experiments.local import run_local

OTHERWISE = "Give the settings it was begun with, --from STAGE to make a stage anew with these, or another --out."


def run(
    cells: Sequence[Cell],
    out: Path,
    *,
    workers: int,
    say: Callable[[str], None],
    sbatch: Sequence[str] | None = None,
    resume: bool = False,
    force: bool = False,
    from_: str | None = None,
    only: str | None = None,
) -> None:
    """Run the cells that are not done, on this machine or, with options for ``sbatch``, by Slurm.

    A run that exists is a ``UserError`` unless it is to be resumed, forced (all anew), or made anew ``from_`` a stage
    or ``only`` in that stage. A cell that is not made is a ``UserError`` at the end.
    """
    chosen = in_part(cells, from_, only)
    if out.exists() and not out.is_dir():
        raise UserError(
            "a run needs a folder, this is a file",
            out,
            "Choose another --out.",
        )
    if out.exists() and not (force or resume or from_ or only):
        do = "Give --resume to finish it, --from STAGE to make a part anew, --force to make all anew."
        raise UserError(
            "the run exists already",
            out,
            do,
        )
    slurm.check_free(out, is_wanted=sbatch is not None)
    anew = [] if resume else [*chosen, *read_plan(out)] if force else chosen
    begin(cells, out, anew)
    todo = [cell for cell in (chosen if only else cells) if not cell.is_done(out)]
    if sbatch is not None:
        slurm.submit(todo, out, workers, sbatch, say)
        return
    try:
        run_local(todo, out, workers=workers, say=say)
    except KeyboardInterrupt as error:
        error.add_note("what is done is kept: give the same command with --resume to go on")
        raise
    left = [cell for cell in todo if not cell.is_done(out)]
    failed = [cell for cell in left if cell.state(out) == FAILED]
    if left:
        first = [*failed, *left][0]
        why = first.last_words(out) if failed else "it needs what is not made"
        problem = f"{len(failed)} of {len(cells)} cells failed, {len(left)} are not made; {first.name}"
        raise UserError(
            problem,
            why,
            "Mend it, then give the same command with --resume: what is done is kept.",
        )


def in_part(cells: Sequence[Cell], from_: str | None, only: str | None) -> list[Cell]:
    """The cells of the stage ``only`` or, with all that read them, of the stage ``from_``; without one all."""
    if not (from_ or only):
        return [*cells]
    names = {cell.name for cell in cells if cell.stage == (from_ or only)}
    if not names or (from_ and only):
        stages = ", ".join(dict.fromkeys(cell.stage for cell in cells))
        raise UserError(
            "--from or --only needs one stage of the run",
            f"{from_ or only}",
            f"Choose one of {stages}.",
        )
    for cell in cells:  # those that a cell needs are before it
        if from_ and not names.isdisjoint(cell.needs):
            names.add(cell.name)
    return [cell for cell in cells if cell.name in names]


def begin(cells: Sequence[Cell], run: Path, anew: Sequence[Cell] = ()) -> None:
    """Write the plan, and remove what cells to be made ``anew`` made. A run that has made others is a ``UserError``."""
    ours = {cell.name: cell.words for cell in cells}
    renewed = {cell.name for cell in anew}
    for old in read_plan(run):
        is_begun = old.is_done(run) or old.draft(run).folder.exists()
        if not is_begun or old.is_derived or old.name in renewed:
            continue
        if old.name not in ours:
            raise UserError(
                f"the run here has a cell that this one lacks: {old.name}",
                run,
                OTHERWISE,
            )
        for before, now in zip_longest(old.words, ours[old.name]):
            if before != now:
                raise UserError(
                    f"{old.name} was begun with {before!r}, not {now!r}",
                    run,
                    OTHERWISE,
                )
    discard(anew, run)
    if not all(cell.is_derived or cell.is_done(run) for cell in cells):
        discard([cell for cell in cells if cell.is_derived], run)  # they are of less than there will be
    for cell in cells:
        if not cell.is_done(run):
            cell.log(run).parent.mkdir(parents=True, exist_ok=True)
            cell.log(run, "code").unlink(missing_ok=True)
    replace_text(run / PLAN, CELLS.dump_json([*cells], indent=1).decode() + "\n")


def discard(cells: Sequence[Cell], run: Path) -> None:
    """Remove what cells made or began; one that is being made is a ``UserError``."""
    for cell in cells:
        if cell.draft(run).is_locked:
            raise UserError(
                f"another process makes {cell.name}",
                run,
                "Wait until it is done, or end it.",
            )
    for cell in cells:
        shutil.rmtree(cell.draft(run).folder, ignore_errors=True)
        if cell.stage == "collect":
            (run / cell.place).unlink(missing_ok=True)
        elif cell.is_done(run):
            shutil.rmtree(run / cell.place)
