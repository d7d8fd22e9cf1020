"""The list of stages with settings. A new stage is a line here, a file and a command."""

import json
from collections.abc import Iterable, Mapping
from typing import Any

from hypogoal.core.config import DOMAIN, as_dict, describe, from_values, gathered, load_preset, resolve
from hypogoal.domains.doorkey_defaults import DEFAULTS, SOURCES
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
OFTEN: Mapping[str, tuple[str, ...]] = {  # the settings changed most, options of the stage's command
    "train-ensemble": ("members", "diversity", "diversity_weight", "network", "steps"),
    "train-options": ("steps", "layout_seed", "network", "termination", "option_timeout"),
    "train-meta": ("steps", "layout_seed", "network", "termination", "chooser"),
    "train-baseline": ("agent", "steps", "layout_seed", "setting"),
    "audit": ("steps", "layout_seed", "option_timeout", "mend"),
}
STAGES = ("collect", *CONFIGS)  # whose settings are its domain's
TABLES = (*STAGES, "run")  # of presets


def options_of(stage: str) -> dict[str, dict[str, Any]]:
    """The settings in ``OFTEN``, described, by the option of the stage's command that is short for ``--set``."""
    rows = {row["name"]: row for row in describe(CONFIGS[stage])} if stage in CONFIGS else {}
    return {f"--{name.replace('_', '-')}": rows[name] for name in OFTEN.get(stage, ())}


def described(config_class: type, stage: str, domain: str, preset: str | None = None) -> list[dict[str, Any]]:
    """Every setting of a stage with the defaults of a domain and a preset, as :func:`hypogoal.core.config.describe`."""
    instead: list[tuple[Mapping[str, Any], str]] = []
    if domain == DOMAIN:
        instead.append((DEFAULTS.get(stage, {}), SOURCES.get(stage, "")))
    else:
        from hypogoal.domains.base import load_domain

        loaded = load_domain(domain)
        instead.append((loaded.defaults.get(stage, {}), loaded.sources.get(stage, f"{domain}'s own")))
    if preset is not None:
        values = load_preset(preset, stage, domain, TABLES)
        checked = as_dict(from_values(config_class, values, stage))
        instead.append(({key: checked[key] for key in gathered(values)}, f"preset {preset}"))
    return describe(config_class, *instead)


def preset_text(stage: str, rows: Iterable[Mapping[str, Any]]) -> str:
    """Settings as :func:`described` has them, as a TOML preset of the stage to edit; unset ones are commented out."""
    lines = [f"[{stage}]"]
    for row in rows:
        allowed = f" ({row['allowed']})" if row["allowed"] else ""
        value = row["default"]
        lines += ["", f"# {row['meaning']}{allowed}"]
        text = f"{row['name']} = {json.dumps(value, ensure_ascii=False)}"
        lines.append(f"# {row['name']} =" if value is None else text)
    return "\n".join(lines) + "\n"


def configuration(
    stage: str,
    domain: str,
    preset: str | None,
    assignments: Iterable[str] | None,
    options: Mapping[str, Any] | None = None,
    *,
    inherited: Mapping[str, Any] | None = None,
) -> Any:
    """A stage's settings with the presets and defaults of its domain; see :func:`hypogoal.core.config.resolve`.

    ``inherited`` ones, of the options that the stage continues, replace defaults. An unknown domain is a ``UserError``.
    """
    from hypogoal.domains.base import defaults_of, load_domain  # loads Gymnasium, not needed to list stages

    return resolve(
        load_domain(domain).config_class if stage == "collect" else CONFIGS[stage],
        stage=stage,
        preset=preset,
        options=options,
        assignments=assignments or (),
        domain=domain,
        defaults={**defaults_of(domain, stage), **(inherited or {})},
        tables=TABLES,
    )
