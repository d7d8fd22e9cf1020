"""The stages that have settings, listed once: a new one is a line here, its file and its command."""

from collections.abc import Iterable, Mapping
from typing import Any

from hypogoal.core.config import resolve
from hypogoal.hypotheses.config import TrainEnsembleConfig
from hypogoal.learners.baselines.settings import BaselineConfig
from hypogoal.meta.config import AuditConfig, TrainMetaConfig, TrainOptionsConfig

CONFIGS: Mapping[str, type] = {
    "train-ensemble": TrainEnsembleConfig,
    "train-options": TrainOptionsConfig,
    "train-meta": TrainMetaConfig,
    "train-baseline": BaselineConfig,
    "audit": AuditConfig,
}
STAGES = ("collect", *CONFIGS)  # whose settings are its domain's
TABLES = (*STAGES, "run")  # of presets


def configuration(
    stage: str,
    domain: str,
    preset: str | None,
    assignments: Iterable[str] | None,
    options: Mapping[str, Any] | None = None,
    *,
    given: bool = False,
) -> Any:
    """A stage's settings, with the presets and defaults of the domain it works on; see
    :func:`hypogoal.core.config.resolve`.

    ``given``: the user gave the domain's name, no file did. No such domain is a ``UserError``.
    """
    from hypogoal.domains.base import defaults_of, load_domain  # with Gymnasium, which a list of stages needs not

    return resolve(
        load_domain(domain, given=given).config_class if stage == "collect" else CONFIGS[stage],
        stage=stage,
        preset=preset,
        options=options,
        assignments=assignments or (),
        domain=domain,
        defaults=defaults_of(domain, stage, given=given),
        tables=TABLES,
    )
