"""The settings of the stages that train, by their commands' names (those of ``collect`` are its domain's)."""

from __future__ import annotations

from collections.abc import Mapping
from types import MappingProxyType

from hypogoal.hypotheses.config import TrainEnsembleConfig
from hypogoal.learners.baselines.settings import BaselineConfig
from hypogoal.meta.config import TrainMetaConfig, TrainOptionsConfig

CONFIGS: Mapping[str, type] = MappingProxyType(
    {
        "train-ensemble": TrainEnsembleConfig,
        "train-options": TrainOptionsConfig,
        "train-meta": TrainMetaConfig,
        "train-baseline": BaselineConfig,
    }
)
