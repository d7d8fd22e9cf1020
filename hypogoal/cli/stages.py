"""The commands that make something, one stage each."""

import tempfile
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Annotated

from typer import Argument, Option

from hypogoal.cli import common as cli
from hypogoal.core.errors import UserError
from hypogoal.core.terminal import draw, say
from hypogoal.settings import configuration
from hypogoal.stages import domain_of, inherited_of

ENSEMBLE = Argument(help="The folder that 'train-ensemble' wrote.")
VISITED = "a data file, or options or a meta-policy with save_visited; repeatable."
FILMS = "RUN/report/videos/*.gif; the page shows the first. Default: one, if possible."


@cli.stage(cli.MAKE, "collect", "collect doorkey --out data/doorkey.h5")
def collect(call: cli.StageCall, domain: cli.DomainName) -> None:
    """Collect labelled, unlabelled and held-out states."""
    cli.print_counts(call.make(domain), call.how["quiet"])
    call.end({}, "train-ensemble", call.out, "--out", cli.run_of(call.out) / "ensemble")


@cli.stage(cli.MAKE, "train-ensemble", "train-ensemble data/doorkey.h5 --out runs/mine/ensemble")
def train_ensemble(
    call: cli.StageCall,
    data: Annotated[Path, Argument(help="The HDF5 file that 'collect' wrote.")],
    unlabelled: Annotated[list[Path] | None, Option(help=f"Take unlabelled states from elsewhere: {VISITED}")] = None,
    tensorboard: cli.Tensorboard = None,
) -> None:
    """Train diverse classifiers (members) of each sub-goal."""
    from hypogoal.domains.base import installed_domain
    from hypogoal.look import numbers_of

    trained = call.make(data, unlabelled=tuple(unlabelled or ()), tensorboard=tensorboard)
    accuracies = [each["heldout"] for each in trained]
    installed = installed_domain(domain_of(data, "train-ensemble"))
    defaults = installed.defaults if installed else {}
    run, practised = call.out.parent, "train-options" in defaults or "train-meta" not in defaults
    then = ("train-options", call.out, "--out", run / "options")
    then = then if practised else ("train-meta", call.out, "--out", run / "meta")
    call.end(_mean_accuracy(accuracies) or numbers_of(call.out), *(then if installed else ("evaluate", run)))


def _mean_accuracy(accuracies: Sequence[Mapping[str, float]]) -> dict[str, float]:
    """Best, mean and worst member, means over sub-goals, with titles; empty if no sub-goal can be judged."""
    judged = [each for each in accuracies if each["best"] == each["best"]]
    titles = {"best": "held-out balanced accuracy: best member", "mean": "mean", "worst": "worst"}
    return {title: sum(each[key] for each in judged) / len(judged) for key, title in titles.items() if judged}


@cli.stage(cli.MAKE, "train-options", "train-options runs/mine/ensemble --out runs/mine/options")
def train_options(
    call: cli.StageCall,
    ensemble: Annotated[Path, ENSEMBLE],
    options: Annotated[Path | None, Option(help="Continue these options, perhaps elsewhere.")] = None,
    tensorboard: cli.Tensorboard = None,
) -> None:
    """Learn an option (a policy) for every member."""
    from hypogoal.stages.train_meta import FIXED

    numbers = call.make(ensemble, options=options, tensorboard=tensorboard)
    domain = domain_of(ensemble, "train-options")
    config = call.config(domain)
    inherited = inherited_of("train-meta", call.out)
    plain = configuration("train-meta", domain, call.preset, (), inherited=inherited)  # a preset may say otherwise
    fixed = [f"--set={name}={getattr(config, name)}" for name in FIXED if getattr(config, name) != getattr(plain, name)]
    preset, run = ["--preset", call.preset] if call.preset else [], call.out.parent
    then = ("train-meta", ensemble, "--options", call.out, *preset, *fixed, "--out", run / "meta")
    # With restart_options no episodes are left to choose in.
    call.end(numbers, *(("evaluate", run) if config.restart_options else then))


@cli.stage(cli.MAKE, "train-meta", "train-meta runs/mine/ensemble --out runs/mine/meta")
def train_meta(
    call: cli.StageCall,
    ensemble: Annotated[Path, ENSEMBLE],
    options: Annotated[Path | None, Option(help="Continue the options of 'train-options'.")] = None,
    tensorboard: cli.Tensorboard = None,
) -> None:
    """Learn from the reward which options to choose."""
    numbers = call.make(ensemble, options=options, tensorboard=tensorboard)
    call.end(numbers, "evaluate", call.out.parent)


@cli.stage(cli.MAKE, "train-baseline", "train-baseline doorkey --agent ppo --out runs/mine/ppo")
def train_baseline(
    call: cli.StageCall,
    domain: cli.DomainName,
    data: Annotated[Path | None, Option(help="Play in the world where these states were collected.")] = None,
    tensorboard: cli.Tensorboard = None,
) -> None:
    """Train PPO or DQN on primitive actions, to compare."""
    numbers = call.make(domain, data=data, tensorboard=tensorboard)
    call.end(numbers, "evaluate", call.out.parent)


@cli.stage(cli.OWN, "audit", "audit ensemble --domain doorkey --sub-goal go-to-goal --out audit")
def audit(
    call: cli.StageCall,
    classifier: Annotated[str, Argument(help="An ensemble's folder, or module:function (docs/audit.md).")],
    domain: Annotated[
        str | None,
        Option(help="Where to play; without it, look at recorded data.", autocompletion=cli.offer("domain")),
    ] = None,
    sub_goal: Annotated[str | None, Option(help="The domain's sub-goal that is the truth.")] = None,
    member: Annotated[int | None, Option(min=0, help="Which member of the ensemble. Default: 0.")] = None,
) -> None:
    """How often, and where, do policies fool a success classifier?

    Without --domain: where do members disagree on the data that they were
    trained with, which failures come first, which states to label next?
    """
    from hypogoal.evaluation.audit import lines_of
    from hypogoal.tools.audit import audit as audited

    if domain is None:
        _audit_recorded(call, classifier, sub_goal, member)
        return
    if sub_goal is None:
        raise UserError("which sub-goal is the truth?", domain, "Give --sub-goal NAME.")
    config = call.config(domain)
    rates = audited(classifier, config, call.out, domain=domain, sub_goal=sub_goal, member=member or 0, **call.how)
    for line in () if call.how["quiet"] else lines_of(rates):
        say(line)
    call.end({})


def _audit_recorded(call: cli.StageCall, source: str, sub_goal: str | None, member: int | None) -> None:
    from hypogoal.core.artefacts import DATA, TO_FILL_IN, Artefact
    from hypogoal.data import open_dataset
    from hypogoal.tools.audit_recorded import audit_recorded, lines_of

    if not Path(source).is_dir() or member is not None or call.settings or call.preset or call.how["resume"]:
        do = "Give --domain and --sub-goal; or an ensemble's folder alone."
        raise UserError("on recorded data an audit takes an ensemble, all members, without settings", source, do)
    how = {name: call.how[name] for name in ("force", "quiet", "device")}
    parts = audit_recorded(Path(source), call.out, sub_goal=sub_goal, **how)
    for line in () if call.how["quiet"] else lines_of(parts):
        say(line)
    data = Artefact(call.out).input(DATA)
    goals = open_dataset(data).sub_goals
    if len(goals) == 1 and not call.how["quiet"]:  # 'import' takes labels of a data file's only sub-goal
        table = call.out / "next" / goals[0] / TO_FILL_IN
        more = data.with_name(f"{data.stem}-more.h5")
        say(f"then fill in the column 'label' of {table}: 1 or 0, for the pictures beside it")
        cli.print_next(False, "import", data, "--label", f"{goals[0]}={table}", "--out", more)
    say(call.out / "index.html")


@cli.command(cli.MAKE, "evaluate runs/mine")
def evaluate(
    run: Annotated[Path, Argument(help="A run: a folder with artefacts in it.")],
    out: Annotated[Path | None, Option(help="Default: RUN/evaluation.")] = None,
    layouts: Annotated[
        str | None, Option(help="Agents, and each option alone, also play these without learning: 2000-2099 or 7,9.")
    ] = None,
    force: cli.Force = False,
    resume: cli.Resume = False,
    quiet: cli.Quiet = False,
) -> None:
    """Compute every number of a run: accuracy, curves, choices."""
    from hypogoal.evaluation.questions import summary_table
    from hypogoal.stages.evaluate import evaluate as evaluated

    out = out or run / "evaluation"
    metrics = evaluated(run, out, layouts=layouts or "", force=force, resume=resume, quiet=quiet)
    if not quiet:
        draw(summary_table(metrics), 100)
    cli.print_next(quiet, *(["report", run] if out == run / "evaluation" else ["show", out]))
    say(out)


@cli.command(cli.MAKE, "report runs/mine --videos 3")
def report(
    run: Annotated[Path, Argument(help="An evaluated run.")],
    figures: Annotated[Path | None, Option(help="Draw the paper's figures into this folder, not the page.")] = None,
    format_: Annotated[str | None, Option("--format", help="For --figures: svg (the default), pdf or png.")] = None,
    videos: Annotated[int | None, Option(min=0, help=f"Films of the policy over options, in {FILMS}")] = None,
    force: cli.Force = False,
    resume: cli.Resume = False,
    quiet: cli.Quiet = False,
) -> None:
    """Draw the report of an evaluated run: one HTML file."""
    from hypogoal.core.errors import Complete, UserError
    from hypogoal.stages.report import draw_figures
    from hypogoal.stages.report import report as drawn

    if figures is None and format_ is not None:
        raise UserError("--format is for --figures", format_, "Give --figures DIR too, or leave it out.")
    if figures is not None and (videos or resume):
        option = "--videos" if videos else "--resume"
        raise UserError(f"{option} is for the page, not for --figures", figures, "Give one command for each.")
    if figures is None:
        try:
            say(drawn(run, videos=videos, force=force, resume=resume))
        except Complete:
            raise Complete(run / "report" / "index.html") from None
        return
    written, missing = draw_figures(run, figures, format_ or "svg", force=force)
    for line in missing:
        say(line, err=True)
    for path in written:
        say(path)


@cli.command(cli.LOOK, "compare runs/mine runs/other --out runs/both")
def compare(
    runs: Annotated[list[Path], Argument(metavar="RUN", help="Evaluated; each is compared with the first.")],
    out: Annotated[Path | None, Option("--out", help="Where to write a page; else who wins is printed.")] = None,
    force: cli.Force = False,
) -> None:
    """Put evaluated runs side by side: what differs, who wins."""
    from hypogoal.look import describe, outcome
    from hypogoal.tools.compare import compare as compared

    with tempfile.TemporaryDirectory() as folder:
        place = out or Path(folder, "comparison")
        page = compared(runs, place, force=force)
        for line in outcome(describe(place)):
            say(line)
    if out is not None:
        say(page)
