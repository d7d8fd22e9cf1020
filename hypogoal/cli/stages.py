"""The commands that make something: one stage each."""

import inspect
from collections.abc import Callable
from dataclasses import fields
from importlib import import_module
from pathlib import Path
from typing import Annotated, Any

import typer

from hypogoal.cli.common import (
    Device,
    Force,
    Out,
    Preset,
    Quiet,
    Resume,
    Seed,
    Set,
    app,
    print_counts,
    print_outcome,
    values_of,
)
from hypogoal.core.files import MOST_INTEGER
from hypogoal.core.terminal import draw, give, say

EnsembleFolder = Annotated[Path, typer.Argument(help="The folder that 'train-ensemble' wrote.")]
LayoutSeed = Annotated[
    int | None, typer.Option("--layout-seed", min=0, max=MOST_INTEGER, help="The layout to learn on.")
]


@app.command()
def collect(
    domain: Annotated[str, typer.Argument(help="doorkey, montezuma, or module:object.")],
    out: Out,
    preset: Preset = None,
    set_: Set = None,
    seed: Seed = 0,
    force: Force = False,
    resume: Resume = False,
    quiet: Quiet = False,
) -> None:
    """Collect labelled, unlabelled and held-out states into an HDF5 file."""
    from hypogoal.domains.base import load_domain
    from hypogoal.settings import configuration
    from hypogoal.stages.collect import collect as stage

    found = load_domain(domain, given=True)
    config = configuration("collect", domain, preset, set_, given=True)
    counts = stage(found, config, out, name=domain, seed=seed, force=force, resume=resume, quiet=quiet)
    print_counts(counts, quiet)
    give(out)


def _common(
    out: Out,
    preset: Preset = None,
    set_: Set = None,
    seed: Seed = 0,
    device: Device = "auto",
    force: Force = False,
    resume: Resume = False,
    quiet: Quiet = False,
) -> None:
    """The options of every training command."""


def training(told: Callable[..., None]) -> None:
    """Make the command of a training stage, which is called as ``told`` is: that one's signature says what it reads and
    which options it alone has, those of its settings and those of the stage itself.
    """
    stage = told.__name__.replace("_", "-")
    source, *own = inspect.signature(told, eval_str=True).parameters.values()
    out, *others = inspect.signature(_common, eval_str=True).parameters.values()

    def command(preset: str | None, set_: list[str] | None, **given: Any) -> None:
        from hypogoal.core import own_code
        from hypogoal.domains.base import defaults_of
        from hypogoal.settings import CONFIGS, configuration

        read, path, named = given.pop(source.name), given.pop("out"), source.name == "domain"
        domain = read if named else _domain_of(read, source.name)
        settings = {field.name for field in fields(CONFIGS[stage])}
        options = {option.name: given.pop(option.name) for option in own if option.name in settings}
        config = configuration(stage, domain, preset, set_, options, given=named)
        words, vouched = [], []
        if "diversity" in options:  # the user's own words and the domain's may name code, what a preset says may not
            words = [options["diversity"] or "", *values_of(set_)]
            vouched = [value for value in defaults_of(domain, stage).values() if isinstance(value, str)]
        run = getattr(import_module(f"hypogoal.stages.{told.__name__}"), told.__name__)
        given = {name: value for name, value in given.items() if value is not None}
        with own_code.given(*words), own_code.vouched(*vouched):
            numbers = run(read, config, path, **given)
        if isinstance(numbers, dict):  # not of many ensembles
            print_outcome(numbers, given["quiet"])
        give(path)

    parameters = [source, out, *own, *others]
    command.__signature__ = inspect.Signature(parameters)  # type: ignore[attr-defined]
    command.__annotations__ = {parameter.name: parameter.annotation for parameter in parameters}
    app.command(stage, help=told.__doc__)(command)


def _domain_of(read: Path, kind: str) -> str:
    """The domain of a data file (kind ``data``) or of an artefact."""
    from hypogoal.core.artefacts import open_artefact
    from hypogoal.dataset import open_dataset

    return open_dataset(read).domain if kind == "data" else str(open_artefact(read, kind).config["domain"])


@training
def train_ensemble(
    data: Annotated[Path, typer.Argument(help="The HDF5 file that 'collect' wrote.")],
    diversity: Annotated[
        str | None, typer.Option(help="dbat, none, another (docs/concepts.md), or module:function.")
    ] = None,
    members: Annotated[int | None, typer.Option(help="Hypotheses per sub-goal (K).")] = None,
    unlabelled: Annotated[
        list[Path] | None,
        typer.Option(
            help="Take the unlabelled states of this data file, or those visited by these options or this "
            "meta-policy, instead of DATA's; repeatable."
        ),
    ] = None,
) -> None:
    """Train an ensemble of diverse classifiers for each sub-goal."""


@training
def train_options(ensemble: EnsembleFolder, layout_seed: LayoutSeed = None) -> None:
    """Learn an option policy for every member, options chosen at random."""


@training
def train_meta(
    ensemble: EnsembleFolder,
    options: Annotated[Path | None, typer.Option(help="Continue the options of 'train-options'.")] = None,
    layout_seed: LayoutSeed = None,
) -> None:
    """Learn which options to choose, by the environment's reward."""


@training
def train_baseline(
    domain: Annotated[str, typer.Argument(help="doorkey, montezuma, or module:object.")],
    agent: Annotated[str | None, typer.Option(help="ppo or dqn.")] = None,
    data: Annotated[
        Path | None, typer.Option(help="States of the domain: play in the world that they were collected in.")
    ] = None,
    layout_seed: LayoutSeed = None,
) -> None:
    """Train PPO or DQN on the primitive actions, for comparison."""


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
    metrics = stage(run, out, force=force, resume=resume, quiet=quiet)
    if not quiet:
        draw(summary_table(metrics), 100)
    give(out)


@app.command()
def report(
    run: Annotated[Path, typer.Argument(help="A run that was evaluated.")],
    figures: Annotated[
        Path | None, typer.Option(help="Instead of the page: the paper's figures, with captions, into this folder.")
    ] = None,
    format_: Annotated[
        str | None, typer.Option("--format", help="Of --figures: svg (where it is not said), pdf or png.")
    ] = None,
    videos: Annotated[
        int, typer.Option(min=0, help="Also so many episodes of the policy over options, as RUN/report/videos/*.gif.")
    ] = 0,
    force: Force = False,
    resume: Resume = False,
    quiet: Quiet = False,
) -> None:
    """Draw RUN/report/index.html: one file, readable offline."""
    from hypogoal.core.errors import Complete, UserError
    from hypogoal.stages.report import draw_figures
    from hypogoal.stages.report import report as stage

    if figures is None and format_ is not None:
        raise UserError("--format is for --figures", format_, "Give --figures DIR too, or leave it out.")
    if figures is not None and (videos or resume):
        what = "--videos" if videos else "--resume"
        raise UserError(f"{what} is for the page, not for --figures", figures, "Give one command for each.")
    if figures is None:
        try:
            give(stage(run, videos=videos, force=force, resume=resume))
        except Complete as complete:
            raise Complete(run / "report" / "index.html", complete.note) from None
        return
    written, missing = draw_figures(run, figures, format_ or "svg", force=force)
    for line in missing:
        say(line, err=True)
    for path in written:
        give(path)


@app.command()
def compare(
    runs: Annotated[
        list[Path], typer.Argument(metavar="RUN RUN ...", help="Evaluated runs; the first is compared with.")
    ],
    out: Out,
    force: Force = False,
) -> None:
    """Evaluated runs side by side: what differs, curves, tables, who wins seed by seed."""
    from hypogoal.stages.compare import compare as stage

    give(stage(runs, out, force=force))
