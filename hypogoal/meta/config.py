"""Settings of agents: where options are played, how the meta-policy learns.

The light recipe's are the defaults, those of Table 5 are in the ``paper`` preset.
"""

from typing import ClassVar

from hypogoal.core.config import MOST, OWN, Config, integers, part, setting
from hypogoal.core.errors import UserError
from hypogoal.domains.world import WorldConfig
from hypogoal.options.config import OptionConfig

GAMMA = 0.99  # discount per environment step, ours: an option of tau steps counts GAMMA^tau; the paper gives none


class MetaConfig(Config):
    """PPO over options, with SMDP returns: chooser=ppo."""

    meta_network: str = setting(
        "light",
        "light, a small network on cells; the paper's three convolutions; or the light one with an own embedding",
        source="paper: three convolutions; the others: ours",
        choices=("light", "paper"),
        own=True,
    )
    head: str = setting(
        "categorical", "distribution over options", source="gaussian: paper", choices=("categorical", "gaussian")
    )
    gae_lambda: float = setting(
        0.95, "lambda of the advantage estimate, per decision", source="paper: 0.97", low=0.0, high=1.0
    )
    decisions: int = setting(512, "decisions between two updates", source="Table 5: 100", low=2)
    epochs: int = setting(6, "passes over the decisions per update", source="Table 5: 10", low=1)
    meta_batch: int = setting(128, "decisions per gradient step", source="Table 5: 64", low=1)
    meta_learning_rate: float = setting(5e-4, "Adam's step size", source="authors' code: 2.5e-4", low=0.0)
    advantage_floor: float = setting(
        0.1,
        "advantages are divided by their standard deviation, or by this if it is larger",
        source="ours (DEV-34); paper: 0",
        low=0.0,
    )


class SymbolsConfig(Config):
    """A counted table of symbols: chooser=symbols."""

    history: int = setting(
        0, "how many of an episode's last options belong to its symbols, beside those offered", low=0, high=2
    )
    carried: str = setting(
        "prior",
        "what is taken over of the counts of 'agent': nothing, at most one execution of each, or all",
        choices=("none", "prior", "all"),
    )


class OwnChooserConfig(MetaConfig, SymbolsConfig):
    """The settings of all choosers, for one of your own."""


class PlayConfig(OptionConfig, WorldConfig):
    """Where options are played."""

    gamma: ClassVar[float] = 1.0  # discount per environment step of what options return

    steps: int = setting(1, "environment steps", unit="steps", low=1)
    chooser: str = setting("random", "who chooses options", own=True)
    layouts: str = setting(
        "",
        "layouts to draw episodes from: 1000, so many from 'layout_seed' on, or seeds, 1000-1999; empty: that one",
        source="ours: the paper lives on one",
    )
    save_visited: int = setting(
        0,
        "distinct visited states to save as a data file, for training ensembles",
        source="the paper's suggestion",
        low=0,
    )


def layout_seeds(layouts: str, first: int | None = None) -> list[int]:
    """The seeds that ``layouts`` names, each once, a bare number so many from ``first`` on; else a ``UserError``."""
    text = layouts.strip()
    if text and not text.isdecimal():
        return list(dict.fromkeys(integers(text)))
    count = int(text or 1)
    if first is None or not 0 < count <= MOST:
        raise UserError(
            "which layouts, or how many?", f"layouts={layouts}", f"Give 1 to {MOST}, or seeds as 2000-2099."
        )
    return list(range(first, first + count))


class PracticeConfig(PlayConfig):
    """How the options are learned, and for how long."""

    steps: int = setting(
        60_000,
        "environment steps, all environments together; of each option, where options are restarted",
        unit="steps",
        source="paper: 3e5 for each option",
        low=1,
    )
    chooser: str = setting(
        "random",
        "random: uniform among the options offered; even: the one with the fewest steps so far",
        source="paper, policy learning",
        choices=("random", "even"),
        own=True,
    )


class TrainOptionsConfig(PracticeConfig):
    """When learning ends."""

    until: float = setting(
        0.0,
        "training ends once this share of the last 100 episodes has succeeded, at 'steps' at the latest; 0: only then",
        source="ours: practice for a task in which choosing decides",
        low=0.0,
        high=1.0,
    )


class TrainMetaConfig(PlayConfig):
    """How options are learned and chosen, and for how long."""

    gamma: ClassVar[float] = GAMMA

    steps: int = setting(
        300_000, "environment steps, all environments together", unit="steps", source="paper: 1.5e6", low=1
    )
    chooser: str = setting(
        "symbols",
        "who chooses options: symbols, a counted table; ppo, a network; random, uniform",
        source="ours (DEV-54); paper: ppo",
        choices=("symbols", "ppo", "random"),
        own=True,
    )
    choosing: MetaConfig | SymbolsConfig | None = part(
        "chooser", {"symbols": SymbolsConfig, "ppo": MetaConfig, OWN: OwnChooserConfig}
    )


class AuditConfig(PracticeConfig):
    """How policies learn to fool a classifier, and what is tried against them."""

    option_timeout: int = setting(50, "an execution ends after this many steps", unit="steps", low=1, high=32_000)
    restart_options: bool = setting(True, "every execution begins a new episode, at a start state")
    mask_reached: bool = setting(False, "do not begin executions where the prediction is already positive")
    steps: int = setting(80_000, "environment steps, all policies together", unit="steps", low=1)
    chooser: str = setting(
        "even", "who plays: the policy with the fewest steps so far, or any", choices=("random", "even"), own=True
    )
    threshold: float = setting(
        0.0,
        "a prediction is positive above this probability; 0: a member's own threshold, or 0.5 for other classifiers",
        low=0.0,
        high=1.0,
    )
    mend: float = setting(0.95, "a second policy learns against this higher threshold; 0: none", low=0.0, high=1.0)
