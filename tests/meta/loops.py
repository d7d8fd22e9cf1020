"""Ways to play and learn options, each of them small: light and paper's, shared and own experience, every chooser."""

from collections.abc import Callable
from functools import partial
from typing import Any

import corridor_env
from corridor import Corridor, LongCorridor

from hypogoal.core.seeding import rng_for
from hypogoal.domains.base import Layouts
from hypogoal.domains.doorkey.domain import DOMAIN
from hypogoal.domains.doorkey.engine import DoorKeyEngine
from hypogoal.meta.config import MetaConfig
from hypogoal.meta.ppo import MetaPolicy
from hypogoal.meta.symbols import SymbolsChooser
from hypogoal.options.choosers import Chooser, EvenChooser, RandomChooser
from hypogoal.options.config import OptionConfig
from hypogoal.options.learner import load_learner
from hypogoal.options.loop import OptionLoop
from hypogoal.options.recording import Recorder
from hypogoal.options.termination import oracle_terminations

QUICK = {
    "environments": 3,
    "warm_up": 40,
    "update_interval": 4,
    "option_batch": 16,
    "epsilon_steps": 200,
    "replay": 150,
}
OWN = {"experience": "own", "mask_reached": False}
FAR = {**OWN, "n_step": 3, "exploration": "persistent", "restart_options": True, "option_timeout": 6}


def gymnasium_corridor(count: int) -> Any:
    """Environments that nobody can save: their episodes are played again. Their domain says what is a success."""
    return corridor_env.SWIFT.make_engine(0, count, 30)


def many(make: Any, count: int) -> Any:
    """Environments whose episodes begin in layouts that are drawn."""
    return make(100, count, 30, layouts=Layouts(range(40), rng_for(0, "layouts")))


CASES: dict[str, tuple[Callable[[int], Any], str, dict[str, object], str]] = {
    "light, shared, ppo": (Corridor, "light", {}, "ppo"),
    "light, shared, gaussian": (Corridor, "light", {}, "gaussian"),
    "light, own, n steps, even": (LongCorridor, "light", FAR, "even"),
    "a Gymnasium environment, ppo": (gymnasium_corridor, "light", {}, "ppo"),
    "DoorKey, many layouts, random": (partial(many, DOMAIN.make_engine), "light", {}, "random"),
    "Gymnasium, many layouts, random": (partial(many, corridor_env.SWIFT.make_engine), "light", {}, "random"),
    "planned, ppo": (partial(DoorKeyEngine, 4), "planned", {}, "ppo"),
    "light, shared, symbols": (Corridor, "light", {}, "symbols"),
    "paper, own, random": (Corridor, "paper", {**OWN, "replay": 100, "recurrence": 3}, "random"),
    "paper without memory, random": (Corridor, "paper", {**OWN, "replay": 100}, "random"),
}


def loop_of(case: str, device: str = "cpu") -> OptionLoop:
    """Options that are played and learned, of the case, from the same seeds each time."""
    engine_class, network, changes, chooser_name = CASES[case]
    config = OptionConfig.of(network=network, **{"option_timeout": 10, **QUICK, **changes})
    engine = engine_class(3)
    verdicts = oracle_terminations(engine, (0, 1))
    learner = load_learner(network)(engine, verdicts, config, seed=1, device=device)
    chooser: Chooser = RandomChooser(rng_for(0, "choice"))
    if chooser_name == "even":
        chooser = EvenChooser(rng_for(0, "choice"), 2)
    elif chooser_name == "symbols":
        chooser = SymbolsChooser(engine.count, 2, rng_for(0, "choice"), 2, keep=0.99)
    elif chooser_name != "random":
        head = "gaussian" if chooser_name == "gaussian" else "categorical"
        meta = MetaConfig(head=head, decisions=8, meta_batch=4)
        chooser = MetaPolicy(engine, 2, meta, 2, device)
    return OptionLoop(engine, verdicts, learner, chooser, Recorder(2, engine), config, gamma=0.9)
