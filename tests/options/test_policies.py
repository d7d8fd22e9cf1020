"""Greedy policies out of an artefact's weights, and in another process (Spec D2, D8)."""

from __future__ import annotations

import pickle
from typing import Any

import numpy as np
import pytest
import torch

from hypogoal.core.errors import UserError
from hypogoal.options.conv_gru import PaperQNetwork
from hypogoal.options.learner import make_policies
from hypogoal.options.networks import LightQNetwork
from hypogoal.options.saved import Policies

SHAPE, OPTIONS, ACTIONS = (24, 24, 3), 2, 5


def policies_of(network: str) -> Policies:
    """Of a network with fresh weights, made larger so that the action depends on the image."""
    torch.manual_seed(0)
    if network == "light":
        made = LightQNetwork(SHAPE, OPTIONS, ACTIONS).state_dict()
        weights = {f"online.{name}": value for name, value in made.items()}
    else:
        weights = {
            f"{option}.{name}": value
            for option in range(OPTIONS)
            for name, value in PaperQNetwork(SHAPE, ACTIONS).state_dict().items()
        }
    weights = {
        name: value * 0 if "bias" in name else value * 6 if value.ndim > 1 else value for name, value in weights.items()
    }
    config: dict[str, Any] = {"termination": "learned", "network": network, "sub_goals": ["a", "b"], "members": 1}
    config |= {"recurrence": 10} if network == "paper" else {"embedding": "auto"}
    return make_policies(config, weights, {"observation_shape": SHAPE})


@pytest.mark.parametrize("network", ["light", "paper"])
def test_policies_go_to_another_process(network: str) -> None:
    """Spec D2: what arrives there plays the same; so does an execution that has begun, with all that it remembers."""
    images = np.zeros((12, *SHAPE), np.uint8)
    for number, image in enumerate(images):
        image[2 * number :, : 24 - 2 * number, number % 3] = 255
    own = policies_of(network)
    began = own(1)
    first = [began(image) for image in images[:6]]
    sent, halfway = pickle.loads(pickle.dumps((own, began)))  # noqa: S301 - our own
    rest = [began(image) for image in images[6:]]
    assert [halfway(image) for image in images[6:]] == rest
    again = sent(1)
    assert [again(image) for image in images] == [*first, *rest]
    assert len({*first, *rest}) > 1, "a policy that always does the same would show nothing"


def test_options_that_end_at_true_sub_goals_are_refused() -> None:
    """Spec E6, G2: only the engine can see those."""
    with pytest.raises(UserError, match="these options end at the true sub-goals"):
        make_policies({"termination": "oracle"}, {}, {})
