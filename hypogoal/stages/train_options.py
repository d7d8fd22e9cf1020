"""Spec A3: learn every member's option policy while options are chosen at random, for a time or until that succeeds."""

from pathlib import Path
from typing import Annotated, Any

from typer import Argument, Option

from hypogoal.core.artefacts import open_artefact
from hypogoal.stages import Call, Done, Tensorboard, outcome_of, stage

FIXED = ("network", "recurrence", "embedding", "termination")  # as of the options trained before


@stage(
    "train-options runs/mine/ensemble --out runs/mine/options",
    often=["steps", "layout_seed", "network", "termination", "option_timeout"],
)
def train_options(
    call: Call,
    ensemble: Annotated[Path, Argument(help="The folder that 'train-ensemble' wrote.")],
    *,
    options: Annotated[Path | None, Option(help="Continue these options, perhaps elsewhere.")] = None,
    tensorboard: Tensorboard = None,
) -> Done:
    """Learn an option (a policy) for every member.

    ``options``, an artefact, are trained further. ``tensorboard``, a folder, gets the numbers of the log.
    """
    from hypogoal.core.processes import prepare
    from hypogoal.domains.base import load_domain
    from hypogoal.meta import training

    device = prepare(call.device)
    source = open_artefact(ensemble, "ensemble")
    practice = open_artefact(options, "options") if options else None
    config = call.settings(source.config["domain"], training.inherited(practice, FIXED))
    if practice:
        training.check_fit(practice, source, config, FIXED)
    domain = load_domain(source.config["domain"])
    training.start_arguments(domain, config, 1, call.seed)  # refuse an impossible start before any work
    count = training.options_of(source.config, config)
    steps = config.steps
    if config.restart_options:
        steps *= count
    settings = training.description(domain, source.config, config, steps=steps)
    inputs = [ensemble, options] if options else [ensemble]
    with call.training(
        "options",
        settings,
        inputs,
        steps,
        tensorboard,
    ) as work:
        loop = training.assemble(
            domain,
            source.path,
            source.config,
            config,
            call.seed,
            device,
        )
        if practice:
            training.continue_with(loop, practice)
        solved = training.train(
            loop,
            steps,
            work.log,
            work.progress,
            work.draft.checkpoints(),
            config.until,
        )
        if domain.measures and loop.engine.position_names:
            sub_goals = source.config["sub_goals"]
            away = training.distances_of(domain, sub_goals, count // len(sub_goals))
            loop.recorder.write_executions(work.draft.files, away)
        training.write_trained(
            work.draft.files,
            loop,
            domain,
            source.config,
            config,
            call.seed,
        )
        if config.until:
            settings["ended_at"] = loop.recorder.steps  # for the manifest, which comes last
            settings["until_reached"] = solved
    recorder = loop.recorder
    numbers: dict[str, Any] = {**recorder.episodes.counts(), **recorder.recent(restarted=config.restart_options)}
    if config.until:
        numbers[f"until={config.until:g}"] = "reached" if solved else "not reached"
    return Done(outcome_of(numbers), _next(call, ensemble, config))


def _next(call: Call, ensemble: Path, config: Any) -> tuple[object, ...]:
    """Choose among the options; where each began an episode, no episodes are left to choose in."""
    run = call.out.parent
    if config.restart_options:
        return "evaluate", run
    preset = ["--preset", call.preset] if call.preset else []
    inputs = [ensemble, "--options", call.out]
    return "train-meta", *inputs, *preset, "--out", run / "meta"
