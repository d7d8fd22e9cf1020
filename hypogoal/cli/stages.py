"""The commands that make something: one stage each."""

from pathlib import Path
from typing import Annotated, Any

import typer

from hypogoal.cli.common import (
    LOOK,
    MAKE,
    OWN,
    Force,
    Given,
    Out,
    Quiet,
    Resume,
    after_data,
    command,
    domain_of,
    print_counts,
    print_next,
    stage,
)
from hypogoal.core.terminal import draw, give, say
from hypogoal.settings import configuration


@stage(MAKE, "collect", "collect doorkey --out data/doorkey.h5")
def collect(
    given: Given,
    domain: Annotated[str, typer.Argument(help="doorkey, montezuma, which-feature, or module:object.")],
) -> None:
    """Collect labelled, unlabelled and held-out states."""
    from hypogoal.domains.base import load_domain
    from hypogoal.stages.collect import collect as collected

    found = load_domain(domain, given=True)
    config = given.config(domain, given=True)
    print_counts(collected(found, config, given.out, name=domain, **given.how), given.how["quiet"])
    given.end({}, *after_data(given.out))


@stage(MAKE, "train-ensemble", "train-ensemble data/doorkey.h5 --out runs/mine/ensemble")
def train_ensemble(
    given: Given,
    data: Annotated[Path, typer.Argument(help="The HDF5 file that 'collect' wrote.")],
    unlabelled: Annotated[
        list[Path] | None,
        typer.Option(
            metavar="<path>",
            help="Take the unlabelled states of this data file, or those visited by these options or this "
            "meta-policy, instead of DATA's; repeatable.",
        ),
    ] = None,
) -> None:
    """Train diverse classifiers (members) of each sub-goal."""
    from hypogoal.core import own_code
    from hypogoal.domains.base import installed_domain
    from hypogoal.inspection import result_of
    from hypogoal.stages.train_ensemble import train_ensemble as trained

    domain = domain_of(data, "data")
    config = given.config(domain)
    installed = installed_domain(domain)
    defaults = installed.defaults if installed else {}
    own = [value for value in defaults.get("train-ensemble", {}).values() if isinstance(value, str)]
    with own_code.given(*given.values), own_code.vouched(*own):  # and not what a preset says
        trained(data, config, given.out, unlabelled=tuple(unlabelled or ()), **given.how)
    run, practised = given.out.parent, "train-options" in defaults or "train-meta" not in defaults
    then = ("train-options", given.out, "--out", run / "options")
    then = then if practised else ("train-meta", given.out, "--out", run / "meta")
    given.end(result_of(given.out), *(then if installed else ("evaluate", run)))


ENSEMBLE = typer.Argument(help="The folder that 'train-ensemble' wrote.")


@stage(MAKE, "train-options", "train-options runs/mine/ensemble --out runs/mine/options")
def train_options(
    given: Given,
    ensemble: Annotated[Path, ENSEMBLE],
    options: Annotated[
        Path | None,
        typer.Option(help="Go on with these options of the same ensemble, from another start or elsewhere."),
    ] = None,
) -> None:
    """Learn an option (a policy) for every member."""
    from hypogoal.stages.train_options import train_options as trained

    domain = domain_of(ensemble, "ensemble")
    config = given.config(domain)
    numbers = trained(ensemble, config, given.out, options=options, **given.how)
    given.end(numbers, *_after_options(domain, config, ensemble, given))


def _after_options(domain: str, config: Any, ensemble: Path, given: Given) -> tuple[object, ...]:
    """The command for a policy over them, with what must be as they have it; none is over options without episodes."""
    from hypogoal.stages.train_meta import FIXED

    if config.restart_options:
        return "evaluate", given.out.parent
    plain = configuration("train-meta", domain, given.preset, ())
    fixed = [f"--set={name}={getattr(config, name)}" for name in FIXED if getattr(config, name) != getattr(plain, name)]
    preset = ["--preset", given.preset] if given.preset else []
    return "train-meta", ensemble, "--options", given.out, *preset, *fixed, "--out", given.out.parent / "meta"


@stage(MAKE, "train-meta", "train-meta runs/mine/ensemble --options runs/mine/options --out runs/mine/meta")
def train_meta(
    given: Given,
    ensemble: Annotated[Path, ENSEMBLE],
    options: Annotated[Path | None, typer.Option(help="Continue the options of 'train-options'.")] = None,
) -> None:
    """Learn which options to choose, by the reward."""
    from hypogoal.stages.train_meta import train_meta as trained

    config = given.config(domain_of(ensemble, "ensemble"))
    given.end(trained(ensemble, config, given.out, options=options, **given.how), "evaluate", given.out.parent)


@stage(MAKE, "train-baseline", "train-baseline doorkey --agent ppo --out runs/mine/ppo")
def train_baseline(
    given: Given,
    domain: Annotated[str, typer.Argument(help="doorkey, montezuma, which-feature, or module:object.")],
    data: Annotated[
        Path | None, typer.Option(help="States of the domain: play in the world that they were collected in.")
    ] = None,
) -> None:
    """Train PPO or DQN on primitive actions, to compare."""
    from hypogoal.stages.train_baseline import train_baseline as trained

    config = given.config(domain, given=True)
    given.end(trained(domain, config, given.out, data=data, **given.how), "evaluate", given.out.parent)


@stage(OWN, "audit", "audit runs/mine/ensemble --domain doorkey --sub-goal go-to-goal --out audit")
def audit(
    given: Given,
    classifier: Annotated[str, typer.Argument(help="An ensemble's folder, or module:function (docs/audit.md).")],
    domain: Annotated[str, typer.Option(help="Where it is played: doorkey, montezuma, or module:object.")],
    sub_goal: Annotated[str, typer.Option(help="Of the domain: whose truth counts.")],
    member: Annotated[int, typer.Option(min=0, help="Of the ensemble.")] = 0,
) -> None:
    """How often do policies fool a success classifier, where?"""
    from hypogoal.core import own_code
    from hypogoal.evaluation.audit import lines_of
    from hypogoal.stages.audit import audit as audited

    config = given.config(domain, given=True)
    with own_code.given(classifier, domain):
        found = audited(classifier, config, given.out, domain=domain, sub_goal=sub_goal, member=member, **given.how)
    for line in () if given.how["quiet"] else lines_of(found):
        say(line)
    given.end({})


@command(MAKE, "evaluate runs/mine")
def evaluate(
    run: Annotated[Path, typer.Argument(help="A run: a folder with artefacts in it.")],
    out: Annotated[Path | None, typer.Option("--out", help="Default: RUN/evaluation.")] = None,
    force: Force = False,
    resume: Resume = False,
    quiet: Quiet = False,
) -> None:
    """Compute every number of a run: accuracy, curves, choices."""
    from hypogoal.stages.evaluate import evaluate as evaluated
    from hypogoal.stages.evaluate import summary_table

    out = out or run / "evaluation"
    metrics = evaluated(run, out, force=force, resume=resume, quiet=quiet)
    if not quiet:
        draw(summary_table(metrics), 100)
    print_next(quiet, *(["report", run] if out == run / "evaluation" else ["show", out]))
    give(out)


@command(MAKE, "report runs/mine --videos 3")
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
    """Draw the report of an evaluated run: one HTML file."""
    from hypogoal.core.errors import Complete, UserError
    from hypogoal.stages.report import draw_figures
    from hypogoal.stages.report import report as drawn

    if figures is None and format_ is not None:
        raise UserError("--format is for --figures", format_, "Give --figures DIR too, or leave it out.")
    if figures is not None and (videos or resume):
        what = "--videos" if videos else "--resume"
        raise UserError(f"{what} is for the page, not for --figures", figures, "Give one command for each.")
    if figures is None:
        try:
            give(drawn(run, videos=videos, force=force, resume=resume))
        except Complete as complete:
            raise Complete(run / "report" / "index.html", complete.note) from None
        return
    written, missing = draw_figures(run, figures, format_ or "svg", force=force)
    for line in missing:
        say(line, err=True)
    for path in written:
        give(path)


@command(LOOK, "compare runs/mine runs/other --out runs/both")
def compare(
    runs: Annotated[
        list[Path], typer.Argument(metavar="RUN RUN ...", help="Evaluated runs; the first is compared with.")
    ],
    out: Out,
    force: Force = False,
) -> None:
    """Evaluated runs side by side: what differs, who wins."""
    from hypogoal.stages.compare import compare as compared

    give(compared(runs, out, force=force))
