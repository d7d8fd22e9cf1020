"""The command line: each command parses, calls one stage and prints the artefact's path as its last line.

Spec A1-A8. Heavy imports happen inside the commands, so that ``hypogoal --help`` is quick.
"""

from __future__ import annotations

import signal
import sys
from pathlib import Path
from typing import Annotated, Any

import typer

from hypogoal.core.errors import NumericalError, UserError

app = typer.Typer(
    help="Transferable sub-goals by hypothesising which features generalise.",
    no_args_is_help=True,
    pretty_exceptions_enable=False,
    context_settings={"help_option_names": ["-h", "--help"]},
)

Out = Annotated[Path, typer.Option("--out", help="What to write; it must not exist yet.")]
Preset = Annotated[str | None, typer.Option("--preset", help="demo, paper, or an own .toml file.")]
Set = Annotated[
    list[str] | None,
    typer.Option("--set", metavar="KEY=VALUE", help="Change a setting; see 'hypogoal config'."),
]
Seed = Annotated[int, typer.Option("--seed", min=0, help="Seed of everything that is random.")]
Force = Annotated[bool, typer.Option("--force", help="Replace what stands at --out.")]
Resume = Annotated[bool, typer.Option("--resume", help="Keep a complete --out as it is; otherwise make it.")]
Quiet = Annotated[bool, typer.Option("--quiet", "-q", help="No progress.")]
Device = Annotated[str, typer.Option("--device", help="auto, cpu or cuda.")]
AsJson = Annotated[bool, typer.Option("--json", help="Machine-readable output.")]


def _version(value: bool) -> None:
    if value:
        from hypogoal import __version__

        typer.echo(f"hypogoal {__version__}")
        raise typer.Exit


@app.callback()
def _root(
    version: Annotated[
        bool, typer.Option("--version", callback=_version, is_eager=True, help="Show the version and exit.")
    ] = False,
    debug: Annotated[bool, typer.Option("--debug", help="Show the traceback of an error.")] = False,
) -> None:
    """Stages: collect, train-ensemble, train-options, train-meta, evaluate, report; 'run' chains them."""


def _complete(out: Path, resume: bool) -> bool:
    """Whether ``--resume`` was given and ``out`` is complete; then the stage has nothing to do."""
    if not resume or not out.exists():
        return False
    if out.is_dir():
        from hypogoal.core.artefacts import open_artefact

        open_artefact(out)
    else:
        from hypogoal.dataset import open_dataset

        open_dataset(out)
    typer.echo(f"{out} is complete already", err=True)
    typer.echo(out)
    return True


@app.command()
def collect(
    domain: Annotated[str, typer.Argument(help="doorkey, or module:object.")],
    out: Out,
    preset: Preset = None,
    set_: Set = None,
    seed: Seed = 0,
    force: Force = False,
    resume: Resume = False,
    quiet: Quiet = False,
) -> None:
    """Collect labelled, unlabelled and held-out states into an HDF5 file."""
    from hypogoal.core.config import resolve
    from hypogoal.domains.base import load_domain
    from hypogoal.stages.collect import collect as stage

    if _complete(out, resume):
        return
    found = load_domain(domain)
    config: Any = resolve(found.config_class, stage="collect", preset=preset, assignments=set_ or ())
    counts = stage(found, config, out, seed=seed, force=force, quiet=quiet)
    if not quiet:
        for split in ("labelled", "heldout"):
            for sub_goal, row in counts[split].items():
                typer.echo(f"{split:9s} {sub_goal:20s} {row['states']:7d} states {row['positives']:7d} positives")
        typer.echo(f"unlabelled                     {counts['unlabelled']:7d} states")
    typer.echo(out)


@app.command("train-ensemble")
def train_ensemble(
    data: Annotated[Path, typer.Argument(help="The HDF5 file that 'collect' wrote.")],
    out: Out,
    diversity: Annotated[str | None, typer.Option(help="dbat, divdis, none, or an own one.")] = None,
    members: Annotated[int | None, typer.Option(help="Hypotheses per sub-goal (K).")] = None,
    preset: Preset = None,
    set_: Set = None,
    seed: Seed = 0,
    device: Device = "auto",
    force: Force = False,
    resume: Resume = False,
    quiet: Quiet = False,
) -> None:
    """Train an ensemble of diverse classifiers for each sub-goal."""
    from hypogoal.core.config import resolve
    from hypogoal.stages.train_ensemble import TrainEnsembleConfig
    from hypogoal.stages.train_ensemble import train_ensemble as stage

    if _complete(out, resume):
        return
    given = {"diversity": diversity, "members": members}
    config = resolve(TrainEnsembleConfig, stage="train-ensemble", preset=preset, options=given, assignments=set_ or ())
    stage(data, config, out, seed=seed, force=force, quiet=quiet, device=device)
    typer.echo(out)


@app.command("train-options")
def train_options(
    ensemble: Annotated[Path, typer.Argument(help="The folder that 'train-ensemble' wrote.")],
    out: Out,
    layout_seed: Annotated[int | None, typer.Option(min=0, help="The layout to learn on.")] = None,
    preset: Preset = None,
    set_: Set = None,
    seed: Seed = 0,
    device: Device = "auto",
    force: Force = False,
    resume: Resume = False,
    quiet: Quiet = False,
) -> None:
    """Learn an option policy for every member, options chosen at random."""
    from hypogoal.core.config import resolve
    from hypogoal.stages.train_options import TrainOptionsConfig
    from hypogoal.stages.train_options import train_options as stage

    if _complete(out, resume):
        return
    given = {"layout_seed": layout_seed}
    config = resolve(TrainOptionsConfig, stage="train-options", preset=preset, options=given, assignments=set_ or ())
    _outcome(stage(ensemble, config, out, seed=seed, force=force, quiet=quiet, device=device), quiet)
    typer.echo(out)


@app.command("train-meta")
def train_meta(
    ensemble: Annotated[Path, typer.Argument(help="The folder that 'train-ensemble' wrote.")],
    out: Out,
    options: Annotated[Path | None, typer.Option(help="Continue the options of 'train-options'.")] = None,
    layout_seed: Annotated[int | None, typer.Option(min=0, help="The layout to learn on.")] = None,
    preset: Preset = None,
    set_: Set = None,
    seed: Seed = 0,
    device: Device = "auto",
    force: Force = False,
    resume: Resume = False,
    quiet: Quiet = False,
) -> None:
    """Learn which options to choose, by the environment's reward."""
    from hypogoal.core.config import resolve
    from hypogoal.stages.train_meta import TrainMetaConfig
    from hypogoal.stages.train_meta import train_meta as stage

    if _complete(out, resume):
        return
    given = {"layout_seed": layout_seed}
    config = resolve(TrainMetaConfig, stage="train-meta", preset=preset, options=given, assignments=set_ or ())
    _outcome(
        stage(ensemble, config, out, options=options, seed=seed, force=force, quiet=quiet, device=device),
        quiet,
    )
    typer.echo(out)


@app.command("train-baseline")
def train_baseline(
    domain: Annotated[str, typer.Argument(help="doorkey, or module:object.")],
    out: Out,
    agent: Annotated[str | None, typer.Option(help="ppo or dqn.")] = None,
    layout_seed: Annotated[int | None, typer.Option(min=0, help="The layout to learn on.")] = None,
    preset: Preset = None,
    set_: Set = None,
    seed: Seed = 0,
    device: Device = "auto",
    force: Force = False,
    resume: Resume = False,
    quiet: Quiet = False,
) -> None:
    """Train PPO or DQN on the primitive actions, for comparison."""
    from hypogoal.core.config import resolve
    from hypogoal.stages.train_baseline import BaselineConfig
    from hypogoal.stages.train_baseline import train_baseline as stage

    if _complete(out, resume):
        return
    given = {"agent": agent, "layout_seed": layout_seed}
    config = resolve(BaselineConfig, stage="train-baseline", preset=preset, options=given, assignments=set_ or ())
    _outcome(stage(domain, config, out, seed=seed, force=force, quiet=quiet, device=device), quiet)
    typer.echo(out)


@app.command()
def evaluate(
    run: Annotated[Path, typer.Argument(help="A run: a folder with artefacts in it.")],
    out: Annotated[Path | None, typer.Option("--out", help="Default: RUN/evaluation.")] = None,
    force: Force = False,
    resume: Resume = False,
    quiet: Quiet = False,
) -> None:
    """Compute every number of the report: accuracy, curves, controls, selection."""
    from hypogoal.stages.evaluate import evaluate as stage
    from hypogoal.stages.evaluate import summary_table

    out = out or run / "evaluation"
    if _complete(out, resume):
        return
    metrics = stage(run, out, force=force, quiet=quiet)
    if not quiet:
        _print_table(summary_table(metrics))
    typer.echo(out)


@app.command()
def report(
    run: Annotated[Path, typer.Argument(help="A run that was evaluated.")],
    force: Force = False,
    quiet: Quiet = False,
) -> None:
    """Draw RUN/report/index.html: one file, readable offline."""
    from hypogoal.stages.report import report as stage

    typer.echo(stage(run, force=force))


@app.command()
def run(
    experiment: Annotated[str, typer.Argument(help="doorkey.")],
    out: Out,
    preset: Preset = None,
    set_: Set = None,
    force: Force = False,
    resume: Annotated[bool, typer.Option("--resume", help="Keep what is complete, make the rest.")] = False,
    quiet: Quiet = False,
    dry_run: Annotated[bool, typer.Option("--dry-run", help="List the commands, run none.")] = False,
) -> None:
    """Chain all stages: from nothing to a report. --set takes KEY=VALUE or STAGE.KEY=VALUE."""
    import json

    from hypogoal.stages.evaluate import summary_table
    from hypogoal.stages.run import plan
    from hypogoal.stages.run import run as stage

    planned = plan(experiment, out, preset=preset, assignments=set_ or ())
    if dry_run:
        for cell in planned.cells:
            typer.echo(cell.text)
        return
    stage(planned, out, force=force, resume=resume, quiet=quiet)
    _print_table(summary_table(json.loads((out / "evaluation" / "metrics.json").read_text(encoding="utf-8"))))
    typer.echo(out / "report" / "index.html")


@app.command()
def show(
    path: Annotated[Path, typer.Argument(help="A data file, an artefact or a run.")], as_json: AsJson = False
) -> None:
    """What is this: kind, configuration, inputs, numbers."""
    from hypogoal.inspection import describe_path, lines

    about = describe_path(path)
    _echo(about, as_json, lines(about))


@app.command()
def verify(
    path: Annotated[Path, typer.Argument(help="A data file, an artefact or a run.")], as_json: AsJson = False
) -> None:
    """Check schema, hashes and readability; exit code 2 when something is wrong."""
    from hypogoal.inspection import faults_of

    faults = faults_of(path)
    _echo({"path": str(path), "faults": faults}, as_json, faults or [f"{path}: whole"])
    if faults:
        raise typer.Exit(2)


@app.command()
def config(
    stage: Annotated[str, typer.Argument(help="For example train-meta.")],
    domain: Annotated[str, typer.Option(help="Whose 'collect' settings.")] = "doorkey",
    as_json: AsJson = False,
) -> None:
    """Every setting of a stage: default, unit, meaning, source."""
    from hypogoal.core.config import describe
    from hypogoal.stages.run import config_class_of

    rows = describe(config_class_of(stage, domain))
    if as_json:
        _echo(rows, True, [])
        return
    for row in rows:
        default = ",".join(map(str, row["default"])) if isinstance(row["default"], tuple) else row["default"]
        unit = f" {row['unit']}" if row["unit"] else ""
        typer.echo(f"{row['name']} = {default}{unit}" + (f"   ({row['allowed']})" if row["allowed"] else ""))
        typer.echo(f"    {row['meaning']}" + (f" [{row['source']}]" if row["source"] else ""))


def _outcome(numbers: dict[str, Any], quiet: bool) -> None:
    if not quiet:
        text = ", ".join(
            f"{key} {value:.4g}" if isinstance(value, float) else f"{key} {value}" for key, value in numbers.items()
        )
        typer.echo(text)


def _print_table(table: Any) -> None:
    from rich.console import Console

    console = Console()
    if not console.is_terminal:
        console = Console(width=100)
    console.print(table)


def _echo(value: Any, as_json: bool, text: list[str]) -> None:
    import json

    if as_json:
        typer.echo(json.dumps(value, indent=1))
    else:
        for line in text:
            typer.echo(line)


def main(arguments: list[str] | None = None) -> int:
    """Run the command line; returns the exit code: 2 for the user's mistakes, 1 for ours."""
    if arguments is None:
        signal.signal(signal.SIGTERM, _stop)  # so that a cancelled job, too, leaves nothing half-written
    given = sys.argv[1:] if arguments is None else arguments
    debug = "--debug" in given
    given = [argument for argument in given if argument != "--debug"]
    try:
        code = app(args=given, standalone_mode=False, prog_name="hypogoal")
        return code if isinstance(code, int) else 0
    except UserError as error:
        if debug:
            raise
        return _fail(str(error), 2)
    except NumericalError as error:
        if debug:
            raise
        return _fail(f"training stopped: {error}", 1)
    except KeyboardInterrupt:
        return _fail("stopped; nothing was half-written", 130)
    except Exception as error:
        code = getattr(error, "exit_code", None)
        if code is not None:
            message = getattr(error, "format_message", lambda: "")()
            return _fail(f"{message} See 'hypogoal --help'.", 2) if message else int(code)
        if debug:
            raise
        return _fail(f"internal error: {type(error).__name__}: {error}. Run again with --debug for the traceback.", 1)


def _stop(signum: int, _frame: object) -> None:
    raise KeyboardInterrupt(signum)


def _fail(message: str, code: int) -> int:
    typer.echo(f"hypogoal: {message}", err=True)
    return code


if __name__ == "__main__":
    sys.exit(main())
