"""Domains by name, and the settings of stages on a domain."""

from __future__ import annotations

from hypogoal.core import own_code
from hypogoal.core.config import C, Values, model_of, resolve
from hypogoal.core.errors import NotInstalled, UserError
from hypogoal.core.presets import preset
from hypogoal.domains.base import Domain

BUILT_IN = {
    "doorkey": "hypogoal.domains.doorkey.domain:DOMAIN",
    "montezuma": "hypogoal.domains.montezuma.domain:DOMAIN",
    "rooms": "hypogoal.domains.rooms.domain:DOMAIN",
}
ENTRY_POINTS = "hypogoal.domains"
REGISTERED: dict[str, Domain] = {}  # domains that the running program defined, by name
IMPORTED = "imported"  # the name of the domain of states that 'hypogoal import' got without --domain


def load_domain(name: str) -> Domain:
    """Load a domain by name.

    The name is that of a built-in domain, of an installed entry point (group ``hypogoal.domains``), or
    ``module:object``. The user's own code that the domain's defaults name, such as a network, is allowed together with
    the domain. Raises ``UserError`` if the user did not allow the domain's code (see :mod:`hypogoal.core.own_code`), or
    if the object is no domain.
    """
    name = "rooms" if name == "which-feature" else name  # the name of rooms in files of version 0.23
    domain = REGISTERED.get(name)
    if domain is None and name == IMPORTED:
        raise NotInstalled(
            "the domain of these imported states is not known",
            name,
            f"Import them again with --domain, one of {', '.join(BUILT_IN)} or module:object, and train on that file.",
        )
    domain = domain or own_code.load(name, "domain", ENTRY_POINTS, BUILT_IN)
    if not isinstance(domain, Domain):
        raise UserError("the object is not a domain", name, "Derive it from hypogoal.domains.base.Domain.")
    for settings in domain.defaults.values():
        own_code.allow(settings.values())
    return domain


def installed_domain(name: str) -> Domain | None:
    """Return a domain as :func:`load_domain` does, or None if no domain of that name is installed.

    A user's data may name a domain that is not installed. Raises ``UserError`` if the user did not allow the code, or
    if the code cannot be loaded.
    """
    try:
        return load_domain(name)
    except NotInstalled:
        return None


def layers_of(stage: str, domain: str, preset_name: str | None) -> list[tuple[Values, str]]:
    """Return the values that replace the defaults of a stage's settings, with their source, in order.

    The domain's own values come first, then those of a preset.
    """
    installed = installed_domain(domain)
    layers = []
    if installed:
        layers.append((installed.defaults.get(stage, {}), installed.sources.get(stage, f"{domain}'s own")))
    return [*layers, (preset(preset_name, stage, domain), f"preset {preset_name}")]


def settings_of(
    kind: type[C],
    stage: str,
    domain: str,
    preset_name: str | None = None,
    typed: Values | None = None,
    *,
    inherited: Values | None = None,
) -> C:
    """Return the settings of a stage on a domain.

    The domain's values replace the defaults. Then follow a preset's values, then ``inherited``, the settings of the
    options that the stage continues, and then what the user ``typed``. Raises ``UserError`` if a name is unknown, or if
    a value is not allowed.
    """
    model = load_domain(domain).config_class if stage == "collect" else model_of(stage)
    layers = [values for values, _ in layers_of(stage, domain, preset_name)]
    settings = resolve(model, *layers, inherited or {}, typed or {}, stage=stage)
    assert isinstance(settings, kind)
    return settings
