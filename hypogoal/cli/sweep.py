"""Many cells with one command (Spec A6, G4)."""

import shlex
from pathlib import Path
from typing import Annotated

from typer import Argument, Context, Option

from hypogoal.cli import common as cli
from hypogoal.core.terminal import say

KNOWN = (
    "doorkey, choosing, montezuma-ladders, rooms, figure3, figure4, figure6, or one of your own: "
    "a .toml file or module:function."
)
FROM = "Make this stage again and all that needs it; keep the rest."
WITH_SLURM = "Options for sbatch, as one types them: '--time=4:00:00 --mem=8G'."


@cli.command(cli.MAKE, "run doorkey --preset demo --out runs/demo")
def run(
    experiment: Annotated[str, Argument(help=KNOWN, autocompletion=cli.offer("experiment"))],
    out: Annotated[Path | None, Option(help="What to write. [dim]\\[default: runs/EXPERIMENT][/dim]")] = None,
    preset: cli.Preset = None,
    set_: cli.Set = None,
    seed: Annotated[str | None, Option(help="The run seeds, instead of the experiment's: 3, or 0-9.")] = None,
    device: cli.Device = "auto",
    force: cli.Force = False,
    resume: Annotated[bool, Option("--resume", help="Keep what is complete, continue with the rest.")] = False,
    from_: Annotated[str | None, Option("--from", metavar="STAGE", help=FROM)] = None,
    only: Annotated[
        str | None, Option("--only", metavar="STAGE", help="Make this stage again and run no other.")
    ] = None,
    engine: Annotated[str, Option(help="local: the cores of this machine; slurm: job arrays.")] = "local",
    sbatch: Annotated[str, Option(help=WITH_SLURM)] = "",
    quiet: cli.Quiet = False,
    dry_run: Annotated[bool, Option("--dry-run", help="List the commands; run none.")] = False,
) -> None:
    """Run all cells of an experiment: from nothing to a report. (--set also takes STAGE.KEY=VALUE.)"""
    from hypogoal.core.errors import UserError
    from hypogoal.core.processes import prepare
    from hypogoal.experiments.run import in_part, plan
    from hypogoal.experiments.run import run as run_cells
    from hypogoal.look import describe, outcome

    out = out or Path("runs", Path(experiment.rpartition(":")[2]).stem)
    if engine not in ("local", "slurm"):
        raise UserError("unknown engine", engine, "Choose local or slurm.")
    cells, workers = plan(experiment, preset=preset, assignments=set_ or (), seeds=seed, device=device)
    if dry_run:
        for cell in in_part(cells, from_, only):
            say(shlex.join(["hypogoal", *cell.command(out)]))
        return
    if engine == "local" and device == "cuda":  # with Slurm another machine's device is meant
        prepare(device)
    run_cells(
        cells,
        out,
        workers=workers,
        sbatch=shlex.split(sbatch) if engine == "slurm" else None,
        resume=resume,
        force=force,
        from_=from_,
        only=only,
        say=(lambda text: None) if quiet else (lambda text: say(text, err=True)),
    )
    if engine == "slurm" or only or not (out / "report").is_dir():
        say(out)
        return
    for line in outcome(describe(out / "evaluation")):
        say(line)
    say(out / "report" / "index.html")


@cli.app.command(
    hidden=True, rich_help_panel=cli.MAKE, context_settings={"allow_extra_args": True, "ignore_unknown_options": True}
)
def sweep(context: Context) -> None:
    """What is ``run`` now."""
    from hypogoal.core.errors import UserError

    raise UserError("'sweep' is 'run' now", None, "Type 'hypogoal run' in its place, see 'hypogoal run --help'.")
