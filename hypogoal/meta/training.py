"""Options set up in a domain and trained for a number of steps: what ``train-options`` and ``train-meta`` share.

The words of the loop:

- step: one primitive action in one environment. Budgets, logs and curves count these.
- joint step: a step in each of the E environments at once, so E steps: one call of ``OptionLoop.step``.
- execution: an option at work, from the state in which it was chosen to that in which it ends: where it reaches its
  sub-goal, where its time is up, or with its episode. tau is its number of steps.
- decision: the choice of an option, and what came of it: the option's first state, R (the rewards inside the execution,
  discounted from its start), gamma ** tau, the state in which it ended. The meta-policy learns from decisions alone.
- update: of the option policies, one gradient step on a batch of replayed steps, every ``update_interval`` steps; of
  the meta-policy, ``epochs`` passes over the last ``decisions`` decisions.

Where an option's time runs out in mid-episode (``timed_out`` in :meth:`.OptionLoop.advance`), the episode goes on:

- record: its execution has ended, after ``option_timeout`` steps, without having reached its sub-goal.
- reward: its policy's reward is 0, as at every step that does not reach the sub-goal.
- bootstrap: time is not part of a state, so its policy's target there is gamma max Q(s'), as if it went on. Only the
  sub-goal and the end of the task are terminal.
- SMDP return: R and gamma ** tau, as at any other end. The meta-policy's advantage (:mod:`.smdp`) takes
  R + gamma ** tau V(s') - V(s), and its trace runs on into the next decision, which is made in the same state s'.

With ``restart_options`` the end of an execution is that of its episode too: there the trace ends, V(s') stays.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from hypogoal.core.artefacts import Artefact
from hypogoal.core.checkpoints import Checkpoints
from hypogoal.core.errors import UserError
from hypogoal.core.progress import MetricsLog, Progress
from hypogoal.core.seeding import rng_for
from hypogoal.core.tensors import load_tensors
from hypogoal.domains.base import Domain, Engine, Layouts
from hypogoal.hypotheses.ensemble import read_ensemble
from hypogoal.learners import world
from hypogoal.meta.config import GAMMA, MetaConfig, PracticeConfig, TrainMetaConfig, layout_seeds
from hypogoal.observations import PICTURE, standard_of
from hypogoal.options import termination as ends
from hypogoal.options.choosers import load_chooser
from hypogoal.options.config import STACK
from hypogoal.options.learner import load_learner
from hypogoal.options.loop import OptionLoop
from hypogoal.options.recording import Recorder
from hypogoal.options.visited import Visited

LOG_INTERVAL = 2_000  # environment steps


@dataclass(frozen=True)
class Setup:
    """Whose options are played, where, and how they are learned and chosen.

    Attributes:
        domain: where.
        source: the configuration of the ensemble; of another classifier what it has in common with one.
        folder: of the ensemble.
        config: of the options' policies, of the one over them, of the world.
        seed: of weights, exploration, choices and, where there are several, layouts and start states.
        device: of the networks.
    """

    domain: Domain
    source: Mapping[str, Any]
    folder: Path
    config: PracticeConfig | TrainMetaConfig
    seed: int
    device: str = "cpu"

    @property
    def members(self) -> int:
        """Options of each sub-goal: one for each member, or for the truth."""
        members: int = self.source["members"]
        return 1 if self.config.termination == ends.ORACLE else members

    @property
    def options(self) -> int:
        """Options of all sub-goals."""
        return len(self.source["sub_goals"]) * self.members

    @property
    def world(self) -> dict[str, Any]:
        """The domain's settings with which they play."""
        return world.played_world(self.domain, self.source["domain_config"], self.config)


def assemble(
    setup: Setup,
    terminations_of: Callable[[Setup, Engine], ends.Terminations] | None = None,
    layouts: Layouts | None = None,
) -> OptionLoop:
    """Environments, options in them, fresh policies of these and over these; each part refuses what it cannot do.

    Options end at an ensemble's predictions unless ``terminations_of`` gives others; ``layouts`` replace the setting.
    """
    config, seed, device = setup.config, setup.seed, setup.device
    learner, chooser = load_learner(config.network), load_chooser(config.chooser)
    engine = make_engine(setup, layouts)
    for part in (learner, chooser):
        part.refuse(config, engine)
    terminations = (terminations_of or of_ensemble)(setup, engine)
    options = terminations.options
    return OptionLoop(
        engine,
        terminations,
        learner(engine, terminations, config, seed, device),
        chooser.create(engine, options, config, seed, device),
        Recorder(options, engine),
        config,
        GAMMA if isinstance(config, TrainMetaConfig) else 1.0,
        Visited(engine, config.save_visited, config.layout_seed, seed) if config.save_visited else None,
    )


def make_engine(setup: Setup, layouts: Layouts | None = None) -> Engine:
    """Spec D4, H6: environments that begin episodes where the settings say, or in these ``layouts``."""
    domain, config = setup.domain, setup.config
    if layouts is None and config.layouts.strip():
        seeds = layout_seeds(config.layouts, config.layout_seed)
        layouts = Layouts(seeds, rng_for(setup.seed, "layouts") if len(seeds) > 1 else None)
    if layouts and not domain.many_layouts:
        raise UserError("an engine of this domain plays one layout", domain.name, "Leave layouts out.")
    begins: dict[str, Any] = {"layouts": layouts} if layouts else {}
    if domain.starts:
        world.check_start(domain, config.start)  # an agent with options begins where the user says
        begins |= {"memory": frames_kept(config, setup.options), "seed": setup.seed}
    return world.make_engine(domain, setup.world, config, config.environments, **begins)


def frames_kept(config: PracticeConfig | TrainMetaConfig, options: int) -> int:
    """How many states back an engine must remember: those in replays and in the meta-policy's decisions."""
    reach = load_learner(config.network).reach(config, options)
    if not isinstance(config, MetaConfig):
        return reach
    return max(reach, (config.decisions + config.environments) * config.option_timeout + STACK * config.environments)


def of_ensemble(setup: Setup, engine: Engine) -> ends.Terminations:
    """Terminations of an ensemble's members, or of its sub-goals where they truly hold (``termination=oracle``).

    Agents see numbers by the standard that the members have.
    """
    config, sub_goals = setup.config, setup.source["sub_goals"]
    oracle = config.termination == ends.ORACLE
    columns = world.columns_of(setup.domain, sub_goals) if oracle else []
    ensembles = []
    if not oracle or engine.observation_dtype != PICTURE:
        for sub_goal in sub_goals:
            ensembles.append(read_ensemble(setup.folder, setup.source, sub_goal).to(setup.device))
    if engine.observation_dtype != PICTURE:
        engine.standard = ensembles[0].view.standard or standard_of(engine.observation_shape)
    if oracle:
        return ends.oracle_terminations(engine, columns)
    running_only = config.experience == "own" and not config.mask_reached
    terminations = ends.learned_terminations(engine, ensembles, running_only=running_only, rule=config.termination)
    many = engine.layouts is not None and engine.layouts.many
    reachable = None if many else engine.reachable()
    if reachable is not None:
        terminations.of(reachable)  # faster than state by state
    return terminations


def train(
    loop: OptionLoop, steps: int, log: MetricsLog, progress: Progress, checkpoints: Checkpoints, until: float = 0.0
) -> bool:
    """Step ``loop`` for ``steps`` more environment steps, logging every ``LOG_INTERVAL`` steps.

    It ends earlier once a share ``until`` of the last episodes has succeeded (0: never); returns whether it has. From
    the beginning of these ``steps`` it goes on to the last checkpoint, if there is one (Spec G1).
    """
    recorder, episodes = loop.recorder, loop.recorder.episodes
    begin = logged = recorder.steps
    numbers: dict[str, float] = {}
    checkpoints = checkpoints if loop.engine.resumes else Checkpoints(None)

    def state() -> dict[str, Any]:
        return {"loop": loop.snapshot(), "log": log.snapshot(), "logged": logged, "numbers": numbers}

    saved = checkpoints.load()
    log.restore(saved["log"] if saved else 0)
    if saved:
        loop.restore(saved["loop"])
        logged, numbers = saved["logged"], saved["numbers"]
        progress.resume(recorder.steps - begin)
    solved = episodes.solved(until)
    with checkpoints:
        while recorder.steps - begin < steps and not solved:
            numbers |= loop.step()
            done, solved = recorder.steps - begin, episodes.solved(until)
            shown = {}
            if recorder.steps - logged >= LOG_INTERVAL or done >= steps or solved:
                logged = recorder.steps
                shown = recorder.recent(restarted=loop.config.restart_options)
                reached = {"until_reached": solved} if until else {}
                counts = {"step": logged, "episodes": len(episodes), "states": loop.engine.n_states}
                log.write(**counts, **shown, **numbers, **reached)
            progress.update(min(done, steps), **shown)
            checkpoints.offer(state)
    return solved


def continue_with(loop: OptionLoop, trained: Artefact) -> None:
    """Go on with the options of an artefact; replays start empty."""
    weights = load_tensors(trained.path / "options.safetensors")
    loop.learner.load(weights)
    loop.terminations.load(weights)
