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
    from hypogoal.evaluation.nearness import distances_of
    from hypogoal.meta import training
    from hypogoal.stages import agents

    device = prepare(call.device)
    source = open_artefact(ensemble, "ensemble")
    practice = open_artefact(options, "options") if options else None
    config = agents.settings_of(call, source, practice, FIXED)
    domain = load_domain(source.config["domain"])
    setup = training.Setup(domain, source.config, source.path, config, call.seed, device)
    steps = config.steps
    if config.restart_options:
        steps *= setup.options
    settings = agents.description(setup, steps=steps)
    inputs = [ensemble, options] if options else [ensemble]
    with call.training("options", settings, inputs, steps, tensorboard) as work:
        loop = training.assemble(setup)
        if practice:
            training.continue_with(loop, practice)
        solved = agents.learn(work, setup, loop, steps, config.until)
        if domain.measures and loop.engine.position_names:
            away = distances_of(domain, source.config["sub_goals"], setup.members)
            loop.recorder.write_executions(work.draft.files, away)
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
