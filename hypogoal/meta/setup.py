"""The assembly of an agent from its environments, its options, where options end, and what learns and chooses."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from hypogoal.core.errors import UserError
from hypogoal.core.seeding import rng_for
from hypogoal.domains import world
from hypogoal.domains.base import Domain, Engine, Layouts
from hypogoal.hypotheses.ensemble import read_ensemble
from hypogoal.meta.config import PlayConfig, layout_seeds
from hypogoal.observations import PICTURE, standard_of
from hypogoal.options import termination as ends
from hypogoal.options.choosers import load_chooser
from hypogoal.options.learner import load_learner
from hypogoal.options.loop import OptionLoop
from hypogoal.options.recording import Recorder
from hypogoal.options.visited import Visited


@dataclass(frozen=True)
class Setup:
    """What an agent is assembled from: whose options are played, where, and how they are learned and chosen.

    Attributes:
        domain: where options are played.
        source: the configuration of the ensemble, which also says what options there are: K of each of its sub-goals.
            For another classifier, the settings that an ensemble has, too.
        folder: the folder of the ensemble.
        config: the settings of the option policies, of the policy over options, and of the world.
        seed: the seed of weights, exploration and choices, and of layouts and start states if there are several.
        device: the device of the networks.
    """

    domain: Domain[Any]
    source: Mapping[str, Any]
    folder: Path
    config: PlayConfig
    seed: int
    device: str = "cpu"

    @property
    def members(self) -> int:
        """The number of options of each sub-goal, one for each member, or one for the truth."""
        return 1 if self.config.termination == ends.ORACLE else self.source["members"]

    @property
    def options(self) -> int:
        """The number of options of all sub-goals."""
        return len(self.source["sub_goals"]) * self.members

    @property
    def world(self) -> dict[str, Any]:
        """The domain's settings with which options are played."""
        return world.played_world(
            self.domain,
            self.source["domain_config"],
            self.config,
        )


def assemble(
    setup: Setup,
    terminations_of: Callable[[Setup, Engine], ends.Terminations] | None = None,
    layouts: Layouts | None = None,
) -> OptionLoop:
    """Build an :class:`OptionLoop` with untrained option policies and an untrained policy over options.

    ``terminations_of`` says where options end, by default as the ensemble predicts. ``layouts`` replace the setting of
    that name. Raises ``UserError`` if a part does not work with the settings.
    """
    config, seed, device = setup.config, setup.seed, setup.device
    engine = make_engine(setup, layouts)
    load_chooser(config.chooser).refuse(config, engine)
    terminations = (terminations_of or of_ensemble)(setup, engine)
    learner = load_learner(config.network)(engine, terminations, config, seed, device)
    require_memory(engine, config, terminations.options)
    chooser = load_chooser(config.chooser).create(engine, terminations.options, config, seed, device)
    recorder = Recorder(terminations.options, engine)
    visited = Visited(engine, config.save_visited, seed) if config.save_visited else None
    return OptionLoop(engine, terminations, learner, chooser, recorder, config, config.gamma, visited)


def make_engine(setup: Setup, layouts: Layouts | None = None) -> Engine:
    """Return environments that begin episodes where the settings say, or in ``layouts``."""
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


def frames_kept(config: PlayConfig, options: int) -> int:
    """Return how many states back an engine must remember, for replays and for the meta-policy's decisions."""
    return max(load_learner(config.network).reach(config, options), load_chooser(config.chooser).reach(config))


def require_memory(engine: Engine, config: PlayConfig, options: int) -> None:
    """Raise ``UserError`` if the engine forgets states that replays or the meta-policy's decisions still need."""
    needed = frames_kept(config, options)
    if engine.memory is not None and needed > engine.memory:
        raise UserError(
            f"training looks back over {needed} states, the engine remembers {engine.memory}",
            f"option_timeout={config.option_timeout}",
            "Give a smaller option_timeout, decisions or replay, or the domain a larger memory.",
        )


def of_ensemble(setup: Setup, engine: Engine) -> ends.Terminations:
    """Return terminations by an ensemble's members or, with ``termination=oracle``, by its true sub-goals.

    If observations are numbers, this also sets the engine's standard to that of the members.
    """
    config, sub_goals = setup.config, setup.source["sub_goals"]
    oracle, numbers = config.termination == ends.ORACLE, engine.observation_dtype != PICTURE
    if oracle:
        columns = world.columns_of(setup.domain, sub_goals)
    else:
        ends.load_rule(config.termination).refuse(config, engine)
    ensembles = []
    for sub_goal in sub_goals if numbers or not oracle else ():
        ensemble = read_ensemble(setup.folder, setup.source, sub_goal)
        ensembles.append(ensemble.to(setup.device))
    if numbers:
        engine.standard = ensembles[0].view.standard or standard_of(engine.observation_shape)
    if oracle:
        return ends.oracle_terminations(engine, columns)
    running_only = config.experience == "own" and not config.mask_reached
    terminations = ends.learned_terminations(engine, ensembles, running_only=running_only, rule=config.termination)
    many = engine.layouts is not None and engine.layouts.many
    reachable = None if many else engine.reachable()
    if reachable is not None:
        terminations.of(reachable)  # judged at once, which is faster than state by state
    return terminations
