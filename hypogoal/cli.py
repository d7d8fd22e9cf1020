"""The command line. A command parses, calls one function and prints; its last line is the path of what it made.

The stages' commands come from the stages, see :mod:`hypogoal.command`. Heavy imports are inside commands, so that
``hypogoal --help`` is quick.
"""

import functools
import itertools
import os
import shlex
import shutil
import signal
import sys
import textwrap
import warnings
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any, Literal

import typer
from typer import Argument, Option

from hypogoal.command import call, program, stage
from hypogoal.core import own_code, processes
from hypogoal.core.errors import UserError
from hypogoal.core.progress import say

WIDTH = 100  # columns of tables
EXPERIMENTS = (
    "doorkey, choosing, montezuma-ladders, rooms, figure3, figure4, figure6, or one of your own: a .toml file or "
    "module:function."
)


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command line. Return the exit code: 2 for the user's mistakes, 1 for hypogoal's."""
    if arguments is None:
        signal.signal(signal.SIGTERM, processes.stop)  # so that a cancelled job leaves nothing half-written
        if signal.getsignal(signal.SIGINT) is not signal.SIG_IGN:  # ignored in the background
            signal.signal(signal.SIGINT, processes.stop)
        warnings.formatwarning = lambda message, *_: f"hypogoal: {message}\n"
    words = [*(sys.argv[1:] if arguments is None else arguments)]
    own_code.allow(words)
    try:
        return _called([word for word in words if word not in ("--debug", own_code.TRUST)])
    except BrokenPipeError:  # a program that read what was printed, such as head, has enough
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())  # Python flushes it once more at its exit
        return 1
    except KeyboardInterrupt as stop:
        number = stop.args[0] if stop.args else signal.SIGINT
        return _fail("stopped", 128 + number, stop)
    except (Exception, SystemExit) as error:
        if "--debug" in words or (isinstance(error, SystemExit) and not own_code.place_of(error)):
            raise
        line, code = own_code.message(error)
        return _fail(line, code, error)


@functools.cache
def _commands() -> Any:
    """Return Typer's commands, built once per process, because building takes longer than many commands."""
    return typer.main.get_command(program.app)


def commands() -> dict[str, Any]:
    """Return every command by name, with those of stages loaded."""
    of_stages = {name: stage.load_stage(name).command for name in stage.LISTED}
    return _commands().commands | of_stages


def _called(words: list[str]) -> int:
    """Run a command, and return its exit code.

    Ctrl-C and errors are passed on, except errors in the words themselves.
    """
    if "_HYPOGOAL_COMPLETE" in os.environ:  # the shell asks for completions
        _commands()(args=words, prog_name="hypogoal")
    try:
        with _commands().make_context("hypogoal", words) as context:
            _commands().invoke(context)
    except Exception as error:
        if not hasattr(error, "exit_code"):
            raise
        message = error.format_message() if hasattr(error, "format_message") else ""
        return _fail(f"{message.rstrip('.')}. {_advice(error)}", 2) if message else int(error.exit_code)
    return 0


def _advice(error: Any) -> str:
    """Return what to do about words that a command does not take. Settings are often mistaken for options."""
    from hypogoal.core.config import STAGES

    stage = error.ctx.info_name
    if hasattr(error, "possibilities") and stage in STAGES:
        return f"Settings are given as --set KEY=VALUE; 'hypogoal config {stage}' lists them."
    words = "hypogoal" if stage == "hypogoal" else f"hypogoal {stage}"
    return f"See '{words} --help'."


def _fail(message: str, code: int, error: BaseException | None = None) -> int:
    """Print what is wrong, with the notes that were added to the error. Return ``code``."""
    notes = getattr(error, "__notes__", [])
    if notes:
        message = "; ".join([message.rstrip("."), *notes])
    say(f"hypogoal: {message}", err=True)
    return code


@program.command(program.MAKE, "run doorkey --preset demo --out runs/demo")
def run(
    experiment: Annotated[str, Argument(help=EXPERIMENTS)],
    out: Annotated[Path | None, Option(help="The folder to write. Default: runs/EXPERIMENT.")] = None,
    preset: call.Preset = None,
    set_: stage.Set = None,
    seed: Annotated[str | None, Option(help="Seeds to run instead of the experiment's, such as 3 or 0-9.")] = None,
    device: call.Device = "auto",
    force: call.Force = False,
    resume: call.Resume = False,
    from_: Annotated[
        str | None, Option("--from", metavar="STAGE", help="Run this stage again, and every stage that reads it.")
    ] = None,
    only: Annotated[str | None, Option(metavar="STAGE", help="Run this stage again and no other stage.")] = None,
    engine: Annotated[
        Literal["local", "slurm"],
        Option(help="Where to run: on the cores of this machine, or in job arrays of a cluster."),
    ] = "local",
    sbatch: Annotated[str, Option(help="Options for sbatch as you type them, such as '--time=4:00:00 --mem=8G'.")] = "",
    quiet: call.Quiet = False,
    dry_run: Annotated[bool, Option("--dry-run", metavar="", help="List the commands and run none of them.")] = False,
) -> None:
    """Run every command of an experiment, from nothing to a report.

    --set KEY=VALUE changes a setting of the experiment. --set STAGE.KEY=VALUE
    changes a setting of a command in it, such as train-meta.
    """
    from hypogoal import look
    from hypogoal.experiments import plan as plans
    from hypogoal.experiments import run as runs

    out = out or Path("runs", Path(experiment.rpartition(":")[2]).stem)
    cells, workers = plans.plan(experiment, out, preset=preset, assignments=set_ or (), seeds=seed, device=device)
    if dry_run:
        for cell in runs.in_part(cells, from_, only):
            say(shlex.join(["hypogoal", *cell.command]))
        return
    if engine == "local" and device == "cuda":  # with Slurm, the device is another machine's
        processes.prepare(device)
    runs.run(
        cells,
        out,
        workers=workers,
        sbatch=shlex.split(sbatch) if engine == "slurm" else None,
        resume=resume,
        force=force,
        from_=from_,
        only=only,
        say=lambda text: None if quiet else say(text, err=True),
    )
    if only or not (out / "report").is_dir():
        say(out)
        return
    evaluation = look.describe(out / "evaluation")
    say(*look.outcome(evaluation), out / "report" / "index.html")


@program.command(stage.LOOK, "show runs/mine")
def show(
    path: program.Made,
    as_json: program.Json = False,
    pictures: Annotated[Path | None, Option(help="Draw labelled states of a data file into this folder.")] = None,
) -> None:
    """Say what a file or folder is, what came out, and how it was made."""
    from hypogoal import look

    details = look.describe(path)
    program.echo(details, as_json, [*look.outcome(details), *look.lines(details)] or look.in_the_making(path))
    if pictures is not None:
        from hypogoal.tools.sheets import write_sheets

        say(*write_sheets(path, pictures), err=as_json)


@program.command(stage.LOOK, "verify runs/mine")
def verify(path: program.Made, as_json: program.Json = False) -> None:
    """Check for missing or changed files. The exit code is 2 if there are any.

    It reads every file, and the inputs that lie within PATH. It names outputs
    that are still being made, but does not check them.
    """
    from hypogoal import look

    faults = look.faults(path)
    notes = look.in_the_making(path)
    state = "whole so far" if notes else "whole"
    if not look.parts_of(path):
        state = "nothing is complete yet"
    lines = faults or [f"{path}: {state}"]
    program.echo({"path": str(path), "faults": faults, "notes": notes}, as_json, lines + notes)
    if faults:
        raise typer.Exit(2)


@program.command(stage.LOOK, "status runs/mine")
def status(path: Annotated[Path, Argument(help="A run.")], as_json: program.Json = False) -> None:
    """Say which outputs are out of date or unfinished, why, and how to renew them."""
    from hypogoal import look

    notes = look.in_the_making(path)
    rows = look.stale(path)
    program.echo(rows, as_json, [*notes, *look.stale_lines(rows)])


@program.command(stage.LOOK, "config train-ensemble --domain montezuma")
def config(
    stage: Annotated[str, Argument(help="A command that has settings, such as train-meta or run.")],
    domain: Annotated[str, Option(help=f"The domain whose defaults to show: {call.DOMAINS}")] = "doorkey",
    preset: call.Preset = None,
    toml: Annotated[
        bool, Option("--toml", metavar="", help="Print a .toml file, which you can edit and give to --preset.")
    ] = False,
    as_json: program.Json = False,
) -> None:
    """List every setting of a stage, with default, unit, meaning and source."""
    from hypogoal.core import presets
    from hypogoal.domains import find as domains
    from hypogoal.experiments.experiment import config_class_of

    rows = presets.described(config_class_of(stage, domain), *domains.layers_of(stage, domain, preset))
    program.echo(rows, as_json, [presets.as_toml(stage, rows)] if toml else _setting_lines(rows))


def _setting_lines(rows: Iterable[Mapping[str, Any]]) -> Iterable[str]:
    """Yield settings under the parts that they belong to. A range such as 0-9, or a command, stays in one piece."""
    width = min(shutil.get_terminal_size().columns, WIDTH)
    wrapped = textwrap.TextWrapper(width, " " * 6, " " * 6, break_on_hyphens=False, break_long_words=False)
    for part, settings in itertools.groupby(rows, lambda row: row["part"]):
        yield f"{part.replace('`', '')}:"
        for row in settings:
            default = row["default"]
            if isinstance(default, tuple | list):
                default = ",".join(map(str, default))
            yield f"  {row['name']} = {default} {row['unit']}".rstrip()
            allowed = f" ({row['allowed']})".replace("|", "| ") if row["allowed"] else ""
            source = f" [{row['source']}]" if row["source"] else ""
            yield from wrapped.wrap(f"{row['meaning']}{allowed}{source}")


for _stage, _help in stage.LISTED.items():  # for --help alone; the commands are made when they are called
    _panel = stage.TOOLS.get(_stage, program.MAKE)
    program.app.command(_stage, help=_help, rich_help_panel=_panel)(lambda: None)


@program.command(stage.OWN, "check mine:DOMAIN")
def check(
    domain: Annotated[str | None, Argument(help=f"{call.DOMAINS[:-1]}; or a data file, FILE.h5.")] = None,
    diversity: Annotated[str | None, Option(help="A diversity objective: a name or module:function.")] = None,
    network: Annotated[str | None, Option(help="A member network: a name or module:function.")] = None,
    view: Annotated[str | None, Option(help="A view, which says what members see: module:Class.")] = None,
    teacher: Annotated[
        str | None, Option(help="A teacher, which says what members should predict: module:function.")
    ] = None,
    chooser: Annotated[str | None, Option(help="A chooser, which picks options: module:Class.")] = None,
    learner: Annotated[str | None, Option(help="A learner, which trains options: module:Class.")] = None,
    termination: Annotated[str | None, Option(help="A rule that ends options: module:Class.")] = None,
    set_: stage.Set = None,
    seed: call.Seed = 0,
) -> None:
    """Check that your domain or your part of an agent works, or that your data suffice.

    Of a data file it says in a minute whether there are enough labels, whether
    they leave more than one hypothesis, and how long training will take. There
    --set changes settings of 'train-ensemble'.

    Of a domain it collects a few states twice, where --set changes settings of
    'collect'. A part plays in the domain that you name. If you name none, views
    and teachers see rooms, and other parts play in doorkey. The exit code is 2
    if something is wrong.
    """
    from hypogoal import check as contracts
    from hypogoal.core import config as settings
    from hypogoal.data import open_dataset
    from hypogoal.domains import find as domains
    from hypogoal.hypotheses.config import TrainEnsembleConfig

    checks = []
    observations: tuple[Any, ...] = ()
    loaded = chosen = None
    assigned = settings.assigned(set_ or ())
    if domain is not None and domain.endswith(".h5"):
        in_file = open_dataset(Path(domain)).domain
        training = domains.settings_of(TrainEnsembleConfig, "train-ensemble", in_file, typed=assigned)
        checks.append(contracts.check_data(Path(domain), training, seed=seed))
    elif domain is not None:
        loaded = domains.load_domain(domain)
        chosen = domains.settings_of(settings.Config, "collect", domain, typed=assigned)
        checks.append(contracts.check_domain(loaded, chosen, seed=seed))
        observations = loaded.observation_shape, loaded.observation_dtype
    parts: list[Any] = [
        (diversity, contracts.check_objective, ()),
        (network, contracts.check_network, observations),
        (view, contracts.check_view, (loaded, chosen, seed)),
        (teacher, contracts.check_teacher, (loaded, chosen, seed)),
        (chooser, functools.partial(contracts.check_part, "chooser"), (loaded, seed)),
        (learner, functools.partial(contracts.check_part, "network"), (loaded, seed)),
        (termination, functools.partial(contracts.check_part, "termination"), (loaded, seed)),
    ]
    checks += [check_it(name, *where) for name, check_it, where in parts if name is not None]
    if not checks:
        raise UserError("nothing to check", None, "Give a domain, or an option such as --network.")
    for verdict in itertools.chain(*checks):
        say(*verdict.lines)
        if not verdict.ok:
            raise typer.Exit(2)


if __name__ == "__main__":
    sys.exit(main())
