"""The stage that learns the meta-policy over all options while their policies go on learning.

Without ``--options`` the policies start fresh, as in the paper. With it they continue, and the steps already spent
count in every curve.
"""

from pathlib import Path
from typing import Annotated

from typer import Argument, Option

from hypogoal.command.call import Call, Done, outcome_of
from hypogoal.command.stage import stage
from hypogoal.core.artefacts import open_artefact

FIXED = (  # settings that must be as of the options trained before
    *("network", "recurrence", "embedding", "termination"),
    *("layout_seed", "start", "option_timeout"),
)
WORLD = ("domain_config", "cap", "max_episode_steps")  # if these differ, the agent does not count practice episodes


@stage(
    "train-meta runs/mine/ensemble --out runs/mine/meta",
    often=["steps", "layout_seed", "network", "termination", "chooser"],
    then="evaluate {run}",
)
def train_meta(
    call: Call,
    ensemble: Annotated[Path, Argument(help="The folder that 'train-ensemble' wrote.")],
    *,
    options: Annotated[
        Path | None, Option(help="Go on with the options in this folder, which 'train-options' wrote.")
    ] = None,
    agent: Annotated[
        Path | None, Option(help="Begin with what the agent in this folder learned about choosing.")
    ] = None,
) -> Done:
    """Learn from the reward which options to choose.

    Options start fresh, or continue as those of an ``options`` artefact. Choosing starts fresh, or continues as the
    agent ``agent`` chose.
    """
    from hypogoal.core.tensors import load_tensors
    from hypogoal.domains.episodes import PlayedEpisode
    from hypogoal.meta import training
    from hypogoal.meta.setup import assemble
    from hypogoal.options.choosers import FILE
    from hypogoal.options.tables import Episodes
    from hypogoal.stages import agents

    practice = open_artefact(options, "options") if options else None
    setup = agents.setup_of(call, ensemble, practice, FIXED)
    steps = setup.config.steps
    spent = {"options_steps": 0}
    if practice:
        spent = {"options_steps": practice.config["steps"]}
        if "ended_at" in practice.config:
            spent["options_ended_at"] = practice.config["ended_at"]
    settings = agents.description(setup, **spent)
    inputs = [each for each in (ensemble, options, agent) if each]
    if agent:
        agents.require_ensemble(open_artefact(agent, "meta"), ensemble)
    with call.training("meta", settings, inputs, steps) as work:
        loop = assemble(setup)
        if practice:
            training.continue_with(loop, practice)
            begun_at = spent.get("options_ended_at", spent["options_steps"])
            loop.recorder.start_at(begun_at)
            if all(practice.config[key] == settings[key] for key in WORLD):
                practised = Episodes.read(practice.path / Episodes.FILE)
                loop.recorder.episodes.rows += map(PlayedEpisode._make, practised.rows())
        if agent:
            loop.chooser.carry(load_tensors(agent / FILE))
        agents.learn(work, setup, loop, steps)
    episodes = loop.recorder.episodes
    numbers = episodes.counts() | episodes.recent()
    return Done(outcome_of(numbers))
