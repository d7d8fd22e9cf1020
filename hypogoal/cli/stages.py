"""The commands that make something: one stage each."""

from pathlib import Path
from typing import Annotated

import typer

from hypogoal.cli.common import (
    Device,
    Force,
    LayoutSeed,
    Out,
    Preset,
    Quiet,
    Resume,
    Seed,
    Set,
    app,
    domain_of,
    print_counts,
    print_outcome,
    values_of,
)
from hypogoal.core.terminal import draw, give, say


@app.command()
def collect(
    domain: Annotated[str, typer.Argument(help="doorkey, montezuma, which-feature, or module:object.")],
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


@app.command("train-ensemble")
def train_ensemble(
    data: Annotated[Path, typer.Argument(help="The HDF5 file that 'collect' wrote.")],
    out: Out,
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
    preset: Preset = None,
    set_: Set = None,
    seed: Seed = 0,
    device: Device = "auto",
    force: Force = False,
    resume: Resume = False,
    quiet: Quiet = False,
) -> None:
    """Train an ensemble of diverse classifiers for each sub-goal."""
    from hypogoal.core import own_code
    from hypogoal.domains.base import defaults_of
    from hypogoal.settings import configuration
    from hypogoal.stages.train_ensemble import train_ensemble as stage

    given = {"diversity": diversity, "members": members}
    domain = domain_of(data, "data")
    config = configuration("train-ensemble", domain, preset, set_, given)
    own = [value for value in defaults_of(domain, "train-ensemble").values() if isinstance(value, str)]
    others = tuple(unlabelled or ())
    with own_code.given(diversity or "", *values_of(set_)), own_code.vouched(*own):  # and not what a preset says
        stage(data, config, out, unlabelled=others, seed=seed, force=force, resume=resume, quiet=quiet, device=device)
    give(out)


@app.command("train-options")
def train_options(
    ensemble: Annotated[Path, typer.Argument(help="The folder that 'train-ensemble' wrote.")],
    out: Out,
    options: Annotated[
        Path | None,
        typer.Option(help="Go on with these options of the same ensemble, from another start or elsewhere."),
    ] = None,
    layout_seed: LayoutSeed = None,
    preset: Preset = None,
    set_: Set = None,
    seed: Seed = 0,
    device: Device = "auto",
    force: Force = False,
    resume: Resume = False,
    quiet: Quiet = False,
) -> None:
    """Learn an option policy for every member, options chosen at random."""
    from hypogoal.settings import configuration
    from hypogoal.stages.train_options import train_options as stage

    given = {"layout_seed": layout_seed}
    config = configuration("train-options", domain_of(ensemble, "ensemble"), preset, set_, given)
    numbers = stage(
        ensemble, config, out, options=options, seed=seed, force=force, resume=resume, quiet=quiet, device=device
    )
    print_outcome(numbers, quiet)
    give(out)


@app.command("train-meta")
def train_meta(
    ensemble: Annotated[Path, typer.Argument(help="The folder that 'train-ensemble' wrote.")],
    out: Out,
    options: Annotated[Path | None, typer.Option(help="Continue the options of 'train-options'.")] = None,
    layout_seed: LayoutSeed = None,
    preset: Preset = None,
    set_: Set = None,
    seed: Seed = 0,
    device: Device = "auto",
    force: Force = False,
    resume: Resume = False,
    quiet: Quiet = False,
) -> None:
    """Learn which options to choose, by the environment's reward."""
    from hypogoal.settings import configuration
    from hypogoal.stages.train_meta import train_meta as stage

    given = {"layout_seed": layout_seed}
    config = configuration("train-meta", domain_of(ensemble, "ensemble"), preset, set_, given)
    numbers = stage(
        ensemble, config, out, options=options, seed=seed, force=force, resume=resume, quiet=quiet, device=device
    )
    print_outcome(numbers, quiet)
    give(out)


@app.command("train-baseline")
def train_baseline(
    domain: Annotated[str, typer.Argument(help="doorkey, montezuma, which-feature, or module:object.")],
    out: Out,
    agent: Annotated[str | None, typer.Option(help="ppo or dqn.")] = None,
    data: Annotated[
        Path | None, typer.Option(help="States of the domain: play in the world that they were collected in.")
    ] = None,
    layout_seed: LayoutSeed = None,
    preset: Preset = None,
    set_: Set = None,
    seed: Seed = 0,
    device: Device = "auto",
    force: Force = False,
    resume: Resume = False,
    quiet: Quiet = False,
) -> None:
    """Train PPO or DQN on the primitive actions, for comparison."""
    from hypogoal.settings import configuration
    from hypogoal.stages.train_baseline import train_baseline as stage

    given = {"agent": agent, "layout_seed": layout_seed}
    config = configuration("train-baseline", domain, preset, set_, given, given=True)
    numbers = stage(domain, config, out, data=data, seed=seed, force=force, resume=resume, quiet=quiet, device=device)
    print_outcome(numbers, quiet)
    give(out)


@app.command()
def audit(
    classifier: Annotated[str, typer.Argument(help="An ensemble's folder, or module:function (docs/audit.md).")],
    out: Out,
    domain: Annotated[str, typer.Option(help="Where it is played: doorkey, montezuma, or module:object.")],
    sub_goal: Annotated[str, typer.Option(help="Of the domain: whose truth counts.")],
    member: Annotated[int, typer.Option(min=0, help="Of the ensemble.")] = 0,
    layout_seed: LayoutSeed = None,
    preset: Preset = None,
    set_: Set = None,
    seed: Seed = 0,
    device: Device = "auto",
    force: Force = False,
    resume: Resume = False,
    quiet: Quiet = False,
) -> None:
    """Train a policy against a success classifier: how often is it fooled, and where?"""
    from hypogoal.core import own_code
    from hypogoal.evaluation.audit import lines_of
    from hypogoal.settings import configuration
    from hypogoal.stages.audit import audit as stage

    config = configuration("audit", domain, preset, set_, {"layout_seed": layout_seed}, given=True)
    with own_code.given(classifier, domain):
        report = stage(
            classifier, config, out, domain=domain, sub_goal=sub_goal, member=member,
            seed=seed, force=force, resume=resume, quiet=quiet, device=device,
        )  # fmt: skip
    for line in () if quiet else lines_of(report):
        say(line)
    give(out)


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
        int | None,
        typer.Option(
            min=0,
            help="So many episodes of the policy over options, RUN/report/videos/*.gif; the page shows the first. "
            "Where it is not said: one, if there is such an agent.",
        ),
    ] = None,
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
