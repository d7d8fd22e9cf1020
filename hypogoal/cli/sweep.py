"""Many cells with one command: ``run`` chains the stages, ``sweep`` runs experiments here or by Slurm (Spec A6, G4)."""

from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Annotated, Any

from typer import Argument, Option

from hypogoal.cli import common as cli
from hypogoal.core.terminal import amount, draw, say

KNOWN = (
    "doorkey, choosing, montezuma-ladders, rooms, figure3, figure4, figure6, or one of your own: "
    "a .toml file or module:function."
)
From = Annotated[
    str | None, Option("--from", metavar="STAGE", help="Make this stage again and all that needs it; keep the rest.")
]
Only = Annotated[str | None, Option("--only", metavar="STAGE", help="Make this stage again and run no other.")]
DryRun = Annotated[bool, Option("--dry-run", help="List the commands; run none.")]
_slurm = partial(Option, rich_help_panel="Slurm (with --engine slurm)")


@cli.command(cli.MAKE, "run doorkey --preset demo --out runs/demo")
def run(
    experiment: Annotated[str, Argument(help=KNOWN, autocompletion=cli.offer("experiment"))],
    out: Annotated[Path | None, Option(help="What to write. [dim]\\[default: runs/EXPERIMENT][/dim]")] = None,
    preset: cli.Preset = None,
    set_: cli.Set = None,
    seed: Annotated[int | None, Option(min=0, help="A single seed, instead of the experiment's.")] = None,
    device: cli.Device = "auto",
    force: cli.Force = False,
    resume: Annotated[bool, Option("--resume", help="Keep what is complete, continue with the rest.")] = False,
    from_: From = None,
    only: Only = None,
    quiet: cli.Quiet = False,
    dry_run: DryRun = False,
) -> None:
    """Chain all stages: from nothing to a report. (--set also takes STAGE.KEY=VALUE.)"""
    from hypogoal.core.compute import prepare
    from hypogoal.core.drafts import place_of
    from hypogoal.inspection import numbers_of, summary_of
    from hypogoal.stages.sweep import plan
    from hypogoal.stages.sweep import run as stage

    out = place_of(out or _folder_of(experiment))
    seeds = None if seed is None else str(seed)
    planned = plan(experiment, out, preset=preset, assignments=set_ or (), seeds=seeds, device=device, short=True)
    planned, chosen = _in_part(planned, from_, only)
    if dry_run:
        _list(planned, out, chosen)
        return
    prepare(device)
    stage(planned, out, force=force, resume=resume, quiet=quiet, only=chosen)
    metrics = out / "evaluation" / "metrics.json"
    if chosen or not metrics.is_file():
        say(out / "results.csv")
        return
    draw(summary_of(numbers_of(out) or {}, metrics), 100)
    say(out / "report" / "index.html")


@cli.command(cli.MANY, "sweep figure3 --out runs/figure3 --seeds 0-2 --dry-run")
def sweep(
    experiment: Annotated[str | None, Argument(help=KNOWN, autocompletion=cli.offer("experiment"))] = None,
    out: Annotated[
        Path | None,
        Option(help="The sweep's folder, given again to continue the sweep. [dim]\\[default: runs/EXPERIMENT][/dim]"),
    ] = None,
    preset: cli.Preset = None,
    set_: cli.Set = None,
    seeds: Annotated[str | None, Option(help="The run seeds: 0-9, or 0,3,7.")] = None,
    device: cli.Device = "auto",
    from_: From = None,
    only: Only = None,
    engine: Annotated[str, Option(help="local: the cores of this machine; slurm: job arrays.")] = "local",
    dry_run: DryRun = False,
    status: Annotated[bool, Option("--status", help="Only show how far the sweep is.")] = False,
    cancel: Annotated[bool, Option("--cancel", help="Only cancel its Slurm jobs; they save first.")] = False,
    gather: Annotated[bool, Option("--gather", help="Only write results.csv of the cells done so far.")] = False,
    cell: Annotated[str | None, Option(hidden=True, help="Only this cell, within a Slurm job.")] = None,
    quiet: cli.Quiet = False,
    as_json: cli.AsJson = False,
    partition: Annotated[str, _slurm(help="Partition, as for sbatch.")] = "",
    time: Annotated[str, _slurm(help="Time limit of a cell, as for sbatch: 4:00:00.")] = "",
    memory: Annotated[str, _slurm(help="Memory of a cell, as for sbatch --mem.")] = "",
    cpus: Annotated[int, _slurm(min=0, help="Processors of a cell; 0: as many as it can use.")] = 0,
    gpus: Annotated[int, _slurm(min=0, help="GPUs of a cell.")] = 0,
    cap: Annotated[int, _slurm(min=0, help="Cells of an array that run at once.")] = 0,
    warn: Annotated[int, _slurm(min=1, max=65535, help="Seconds before its limit at which a cell saves.")] = 120,
    sbatch: Annotated[
        list[str] | None, _slurm(help="More options for sbatch: --sbatch=--account=x; repeatable.")
    ] = None,
) -> None:
    """Run an experiment's cells: seeds, layouts, methods.

    Finished cells are not run again. --set takes KEY=VALUE or STAGE.KEY=VALUE; AXIS=VALUES if the experiment is yours.
    """
    from hypogoal.core.drafts import place_of
    from hypogoal.core.errors import UserError

    if experiment is None and out is None:
        raise UserError("which experiment?", "sweep", "Which there are: hypogoal sweep --help")
    out = place_of(out or _folder_of(experiment or ""))
    if cell is not None:
        from hypogoal.experiments.runners.slurm import run_job

        run_job(out, cell)
        return
    if status:
        from hypogoal.experiments.status import as_json as status_json
        from hypogoal.experiments.status import lines, read_status

        progress = read_status(out)
        cli.echo(status_json(progress), as_json, lines(progress))
        return
    if cancel:
        from hypogoal.experiments.runners.slurm import cancel as end

        say(f"{amount(end(out), 'job')} ended; give the same command as before to continue", err=True)
        return

    from hypogoal.core.compute import prepare
    from hypogoal.experiments.runners.slurm import Options
    from hypogoal.stages import sweep as stage

    if gather:
        say(stage.gather(out))
        return
    if experiment is None:
        raise UserError("which experiment?", "sweep", "Which there are: hypogoal sweep --help")
    if engine not in ("local", "slurm"):
        raise UserError("unknown engine", engine, "Choose local or slurm.")
    planned = stage.plan(experiment, out, preset=preset, assignments=set_ or (), seeds=seeds, device=device)
    planned, chosen = _in_part(planned, from_, only)
    if dry_run:
        _list(planned, out, chosen)
        return
    if engine == "local":  # with Slurm another machine's device is meant
        prepare(device)
        go_on = stage.AGAIN if not planned.anew else "give it without --from and --only to go on"
        say(stage.sweep(planned, out, quiet=quiet, go_on=go_on, only=chosen))
        return
    options = Options(partition, time, memory, gpus, cpus, cap, warn, tuple(sbatch or ()))
    jobs = stage.submit(planned, out, options, quiet=quiet, only=chosen)
    for job in jobs:
        say(f"job {job['id']}: {job['name']}, {amount(max(1, len(job['cells'])), 'cell')}", err=True)
    say(out)


def _folder_of(experiment: str) -> Path:
    """The default folder of an experiment's run."""
    return Path("runs", Path(experiment.rpartition(":")[2]).stem)


def _in_part(planned: Any, from_: str | None, only: str | None) -> tuple[Any, frozenset[str]]:
    """The plan with the cells to be made anew, and the names of the only ones to run; empty: all."""
    from hypogoal.core.errors import UserError

    if from_ and only:
        raise UserError("--from and --only cannot both be given", f"{from_}, {only}", "Give one of them.")
    stage = from_ or only
    anew = planned.from_stage(stage) if stage else frozenset()
    return replace(planned, anew=anew), planned.of_stage(only) if only else frozenset()


def _list(planned: Any, out: Path, chosen: frozenset[str]) -> None:
    """The commands of all cells or, with ``--from`` and ``--only``, of those that would run."""
    from hypogoal.stages.sweep import to_run

    cells = to_run(planned, out, chosen) if planned.anew else planned.cells
    for cell in cells:
        say(cell.text)
