"""Settings of the meta-policy (Spec E), with the light recipe as defaults and Table 5 in the ``paper`` preset."""

from __future__ import annotations

from dataclasses import dataclass

from hypogoal.core.config import setting


@dataclass(frozen=True)
class MetaConfig:
    """PPO over options, with SMDP returns."""

    meta_network: str = setting(
        "light",
        "the paper's three convolutions, or a small one on cells",
        source="Spec E2",
        choices=("light", "paper"),
    )
    head: str = setting(
        "categorical",
        "distribution over options",
        source="gaussian: paper",
        choices=("categorical", "gaussian"),
    )
    gamma: float = setting(0.99, "discount per environment step; an option of tau steps counts gamma^tau", source="E1")
    gae_lambda: float = setting(0.95, "advantage trace per decision", source="paper: 0.97", low=0.0, high=1.0)
    decisions: int = setting(512, "decisions between two updates", source="Table 5: 100", low=2)
    epochs: int = setting(6, "passes over the decisions per update", source="Table 5: 10", low=1)
    meta_batch: int = setting(128, "decisions per gradient step", source="Table 5: 64", low=1)
    meta_learning_rate: float = setting(5e-4, "Adam's step size", source="paper: not given", low=0.0)
    clip: float = setting(0.2, "PPO's clipping range", source="Schulman et al. 2017", low=0.0)
    entropy: float = setting(0.01, "weight of the entropy bonus", source="Table 5", low=0.0)
    value_weight: float = setting(0.5, "weight of the value loss", source="Schulman et al. 2017", low=0.0)
    advantage_floor: float = setting(
        0.1,
        "advantages are divided by their standard deviation, but by no less than this",
        source="ours: docs/decisions.md; paper: 0",
        low=0.0,
    )
