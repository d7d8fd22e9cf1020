"""The stage that learns every member's option policy while options are chosen at random or evenly."""

from pathlib import Path
from typing import Annotated, Any

from typer import Argument, Option

from hypogoal.command.call import Call, Done, outcome_of
from hypogoal.command.stage import stage
from hypogoal.core.artefacts import open_artefact

FIXED = ("network", "recurrence", "embedding", "termination")  # must be as of the options trained before


@stage(
    "train-options runs/mine/ensemble --out runs/mine/options",
    often=["steps", "layout_seed", "network", "termination", "option_timeout"],
    then="train-meta {source} --options {out} --out {run}/meta",
)
def train_options(
    call: Call,
    ensemble: Annotated[Path, Argument(help="The folder that 'train-ensemble' wrote.")],
    *,
    options: Annotated[
        Path | None, Option(help="Go on training the options in this folder, here or on another layout.")
    ] = None,
) -> Done:
    """Learn an option (a policy) for every member.

    If ``options``, an artefact, is given, its options are trained further.
    """
    from hypogoal.meta import training
    from hypogoal.meta.config import TrainOptionsConfig
    from hypogoal.meta.nearness import distances_of
    from hypogoal.meta.setup import assemble
    from hypogoal.stages import agents

    practice = open_artefact(options, "options") if options else None
    setup = agents.setup_of(call, ensemble, practice, FIXED)
    config = setup.config
    assert isinstance(config, TrainOptionsConfig)
    steps = config.steps
    if config.restart_options:
        steps *= setup.options
    settings = agents.description(setup, steps=steps)
    inputs = [ensemble, options] if options else [ensemble]
    with call.training("options", settings, inputs, steps) as work:
        loop = assemble(setup)
        if practice:
            training.continue_with(loop, practice)
        solved = agents.learn(work, setup, loop, steps, config.until)
        recorder = loop.recorder
        sub_goals = setup.source["sub_goals"]
        knows_all = set(sub_goals) <= set(setup.domain.sub_goals)
        if knows_all and setup.domain.measures and loop.engine.position_names:
            away = distances_of(setup.domain, sub_goals, setup.members)
            recorder.write_executions(work.draft.files, away)
        if config.until:
            settings["ended_at"] = recorder.steps  # the manifest, which is written last, has these settings
            settings["until_reached"] = solved
    counts: dict[str, Any] = dict(recorder.episodes.counts())
    numbers = counts | recorder.recent(restarted=config.restart_options)
    if config.until:
        numbers[f"until={config.until:g}"] = "reached" if solved else "not reached"
    return Done(outcome_of(numbers))
