"""A run of cells: begun, made anew in part, gone on with (Spec A6, G1, G4, I7)."""

import shlex
import shutil
from collections.abc import Callable, Sequence
from pathlib import Path

from hypogoal.cells import CELLS, PLAN, Cell, read_plan, status_lines, unmade
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
    if out.exists() and not (force or resume or from_ or only):
        do = "Give --resume to finish it, --from STAGE to make a part anew, --force to make all anew."
        raise UserError("the run exists already", out, do)
    slurm.check_free(out, is_wanted=sbatch is not None)
    anew = [] if resume else chosen
    if force:
        anew = [*anew, *read_plan(out)]
    begin(cells, out, anew)
    todo = [cell for cell in (chosen if only else cells) if not cell.is_done]
    if sbatch is not None:
        slurm.submit(todo, out, workers, sbatch, say)
        return
    try:
        run_local(todo, workers=workers, say=say)
    except KeyboardInterrupt as error:
        error.add_note("what is done is kept: give the same command with --resume to go on")
        raise
    if not all(cell.is_done for cell in todo):
        head, *lines = [*status_lines(out), "what they need is not made"]
        do = "Mend it, then give the same command with --resume: what is done is kept."
        raise UserError(head, lines[0].strip(), do)


def in_part(cells: Sequence[Cell], from_: str | None, only: str | None) -> list[Cell]:
    """The cells of the stage ``only`` or, with all that read them, of the stage ``from_``; without one all."""
    if not (from_ or only):
        return [*cells]
    places = {cell.place for cell in cells if cell.stage == (from_ or only)}
    if not places or (from_ and only):
        stages = dict.fromkeys(cell.stage for cell in cells)
        do = f"Choose one of {', '.join(stages)}."
        raise UserError("--from or --only needs one stage of the run", from_ or only, do)
    for cell in cells:  # those that a cell needs are before it
        if from_ and not places.isdisjoint(cell.needs):
            places.add(cell.place)
    return [cell for cell in cells if cell.place in places]


def begin(cells: Sequence[Cell], run: Path, anew: Sequence[Cell] = ()) -> None:
    """Write the plan, and remove what cells to be made ``anew`` made. A run that has made others is a ``UserError``."""
    words = {cell.name: cell.words for cell in cells}
    renewed = {cell.name for cell in anew}
    for old in read_plan(run):
        is_kept = old.name not in renewed and not old.is_derived
        is_begun = old.is_done or old.draft.folder.exists()
        if is_kept and is_begun and old.words != words.get(old.name):
            raise UserError(f"the run here began {old.name} otherwise", shlex.join(old.words), OTHERWISE)
    discard(anew)
    for cell in cells:
        cell.log().parent.mkdir(parents=True, exist_ok=True)
        cell.log("code").unlink(missing_ok=True)
    replace_text(run / PLAN, CELLS.dump_json([*cells], indent=1).decode() + "\n")
    if unmade(run):
        discard([cell for cell in cells if cell.is_derived])  # they are of less than there will be


def discard(cells: Sequence[Cell]) -> None:
    """Remove what cells made or began; one that is being made is a ``UserError``."""
    for cell in cells:
        if cell.draft.is_locked:
            raise UserError("another process makes it", cell.draft.out, "Wait until it is done, or end it.")
    for cell in cells:
        out = cell.draft.out
        shutil.rmtree(cell.draft.folder, ignore_errors=True)
        if out.is_dir():
            shutil.rmtree(out)
        out.unlink(missing_ok=True)
