"""Settings of agents: where options are played, and how the meta-policy learns.

The light recipe's values are the defaults. The values of Table 5 are in the ``paper`` preset.
"""

from typing import ClassVar

from hypogoal.core.config import MOST, OWN, Config, integers, part, setting
from hypogoal.core.errors import UserError
from hypogoal.domains.world import WorldConfig
from hypogoal.options.config import OptionConfig

GAMMA = 0.99  # discount per environment step, so GAMMA^tau for an option of tau steps. Ours: the paper gives none.


class MetaConfig(Config):
    """PPO over options, with SMDP returns: chooser=ppo."""

    meta_network: str = setting(
        "light",
        "network of the meta-policy: light, a small network on cells; paper, three convolutions; or module:object, the "
        "light network with your own embedding",
        source="paper: three convolutions; the others: ours",
        choices=("light", "paper"),
        own=True,
    )
    head: str = setting(
        "categorical",
        "distribution from which the meta-policy draws an option",
        source="gaussian: paper",
        choices=("categorical", "gaussian"),
    )
    gae_lambda: float = setting(
        0.95, "lambda of generalised advantage estimation, per decision", source="paper: 0.97", low=0.0, high=1.0
    )
    decisions: int = setting(
        512, "decisions between two updates; a decision is the choice of one option", source="Table 5: 100", low=2
    )
    epochs: int = setting(6, "passes over the decisions in each update", source="Table 5: 10", low=1)
    meta_batch: int = setting(128, "decisions in each gradient step", source="Table 5: 64", low=1)
    meta_learning_rate: float = setting(5e-4, "Adam's step size", source="authors' code: 2.5e-4", low=0.0)
    advantage_floor: float = setting(
        0.1,
        "advantages are divided by their standard deviation, or by this number if it is larger",
        source="ours (DEV-34); paper: 0",
        low=0.0,
    )


class SymbolsConfig(Config):
    """A table that counts what options lead to: chooser=symbols."""

    history: int = setting(
        0,
        "number of an episode's last options that belong to the symbols, beside the options offered",
        low=0,
        high=2,
    )
    carried: str = setting(
        "prior",
        "how many counts are taken over from the agent that --agent names: none; prior, at most one execution of each "
        "option in each symbols; or all",
        choices=("none", "prior", "all"),
    )


class OwnChooserConfig(MetaConfig, SymbolsConfig):
    """The settings of all choosers, for a chooser of your own."""


class PlayConfig(OptionConfig, WorldConfig):
    """Where options are played."""

    gamma: ClassVar[float] = 1.0  # discount per environment step of the rewards inside an option

    steps: int = setting(1, "number of environment steps, summed over all environments", unit="steps", low=1)
    chooser: str = setting("random", "the chooser, which decides what option runs next", own=True)
    layouts: str = setting(
        "",
        "layouts from which episodes are drawn: a number, such as 1000, for the layouts with the 1000 seeds from "
        "'layout_seed' on; or seeds, such as 1000-1999; empty: the layout 'layout_seed' alone",
        source="ours: the paper lives on one",
    )
    save_visited: int = setting(
        0,
        "number of distinct visited states to save as a data file, on which ensembles can be trained",
        source="the paper's suggestion",
        low=0,
    )


def layout_seeds(layouts: str, first: int | None = None) -> list[int]:
    """Return the distinct seeds that ``layouts`` names.

    A bare number n means the n seeds from ``first`` on. An empty text means ``first`` alone. Raises ``UserError`` if
    ``layouts`` cannot be read, or if ``first`` is needed and None.
    """
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
        "number of environment steps, summed over all environments; with restart_options, the number for each option",
        unit="steps",
        source="paper: 3e5 for each option",
        low=1,
    )
    chooser: str = setting(
        "random",
        "the chooser, which decides what option runs next: random, any option offered, with equal probability; even, "
        "the option with the fewest steps so far",
        source="paper, policy learning",
        choices=("random", "even"),
        own=True,
    )


class TrainOptionsConfig(PracticeConfig):
    """When learning ends."""

    until: float = setting(
        0.0,
        "training ends once this share of the last 100 episodes has succeeded, and after 'steps' at the latest; "
        "0: only after 'steps'",
        source="ours: practice for a task in which choosing decides",
        low=0.0,
        high=1.0,
    )


class TrainMetaConfig(PlayConfig):
    """How options are learned and chosen, and for how long."""

    gamma: ClassVar[float] = GAMMA

    steps: int = setting(
        300_000, "number of environment steps, summed over all environments", unit="steps", source="paper: 1.5e6", low=1
    )
    chooser: str = setting(
        "symbols",
        "the chooser, which decides what option runs next: symbols, which counts what followed; ppo, a network; "
        "random, any option offered, with equal probability",
        source="ours (DEV-54); paper: ppo",
        choices=("symbols", "ppo", "random"),
        own=True,
    )
    choosing: MetaConfig | SymbolsConfig | None = part(
        "chooser", {"symbols": SymbolsConfig, "ppo": MetaConfig, OWN: OwnChooserConfig}
    )


class AuditConfig(PracticeConfig):
    """How policies learn to fool a classifier, and what is tried against them."""

    option_timeout: int = setting(
        50,
        "one run of a policy, called an execution, ends after this many steps at the latest",
        unit="steps",
        low=1,
        high=32_000,
    )
    restart_options: bool = setting(True, "every execution begins a new episode, at a start state")
    mask_reached: bool = setting(False, "do not begin executions where the prediction is already positive")
    steps: int = setting(80_000, "number of environment steps, summed over all policies", unit="steps", low=1)
    chooser: str = setting(
        "even",
        "which policy plays next: even, the policy with the fewest steps so far; random, any policy",
        choices=("random", "even"),
        own=True,
    )
    threshold: float = setting(
        0.0,
        "a prediction is positive above this probability; 0: above a member's own threshold, or above 0.5 for other "
        "classifiers",
        low=0.0,
        high=1.0,
    )
    mend: float = setting(
        0.95,
        "higher threshold at which a second policy learns to fool the classifier; 0 means no second policy",
        low=0.0,
        high=1.0,
    )
