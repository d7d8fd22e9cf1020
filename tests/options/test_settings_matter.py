"""Settings of learning reach the learner: what each of them changes, seen where it is used (Spec D2, D3)."""

from typing import Any

import numpy as np
import pytest
import torch
from corridor import Corridor
from option_loops import loop_of, played

from hypogoal.options.termination import Terminations

QUICK: dict[str, Any] = {
    "environments": 3, "warm_up": 20, "update_interval": 4, "option_batch": 16, "replay": 200, "option_timeout": 3,
    "experience": "own", "mask_reached": False,
}  # fmt: skip


pytestmark = pytest.mark.usefixtures("small_gru")


class Endless(Corridor):
    """Whose episodes do not end, so that only a timeout can be terminal."""

    def __init__(self, count: int):
        super().__init__(count, max_steps=10_000)

    def step(self, actions: np.ndarray) -> Any:
        self.ids = np.clip(self.ids + np.where(actions == 1, 1, -1), 1, 4)
        none = np.zeros(self.count, dtype=np.bool_)
        return type(super().step(actions))(self.ids.copy(), none.astype(np.float32), none, none)


def learned(network: str, **settings: Any) -> dict[str, torch.Tensor]:
    """The weights of options whose sub-goals never hold, after some updates."""
    never = Terminations.of_predictions(lambda ids: np.zeros((len(ids), 2), np.bool_), 2)
    loop = loop_of(Endless(3), ends=never, network=network, **QUICK | {"option_learning_rate": 5e-4} | settings)
    return {name: value.clone() for name, value in played(loop, 40).learner.state().items()}


@pytest.mark.parametrize("network", ["light", "paper"])
@pytest.mark.parametrize("change", [{"option_learning_rate": 5e-2}, {"bounded_values": False}, {"option_gamma": 0.1}])
def test_other_settings_learn_other_weights(network: str, change: dict[str, Any]) -> None:
    """Spec D2: a setting that nobody reads would change nothing."""
    usual, other = learned(network), learned(network, **change)
    assert any(not torch.equal(value, other[name]) for name, value in usual.items())
