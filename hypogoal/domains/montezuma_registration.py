"""The ladder environment's Gymnasium id. Light on purpose: the emulator is loaded only when one is made."""

from __future__ import annotations

ENV_ID = "hypogoal/MontezumaLadder-v0"


def register() -> None:
    """Spec B4: make ``gymnasium.make("hypogoal/MontezumaLadder-v0")`` work; calling it again does nothing."""
    # Here, not above: this may be called while the first module that wants Gymnasium is being imported.
    from gymnasium.envs.registration import register as register_env
    from gymnasium.envs.registration import registry

    if ENV_ID not in registry:
        register_env(id=ENV_ID, entry_point="hypogoal.domains.montezuma:MontezumaLadder")
