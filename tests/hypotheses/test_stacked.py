"""Many members as one network give what each member gives (Spec D1; the rule that a fast path equals the plain one)."""

import numpy as np
import pytest
import torch

from hypogoal.hypotheses.ensemble import Ensemble
from hypogoal.hypotheses.stacked import StackedMembers


@pytest.mark.parametrize(("network", "shape"), [("doorkey", (64, 64, 3)), ("montezuma", (84, 84, 4))])
def test_stacked_members_equal_each_ensemble(network: str, shape: tuple[int, ...]) -> None:
    """Two ensembles of two members, with running statistics that are not the initial ones."""
    generator = torch.Generator().manual_seed(0)
    rng = np.random.default_rng(0)
    ensembles = [Ensemble(network, shape, 2, generator) for _ in range(2)]
    states = rng.integers(0, 256, size=(70, *shape), dtype=np.uint8)
    for ensemble in ensembles:
        ensemble.train()
        for member in ensemble.members:
            member(torch.from_numpy(states[:16]).permute(0, 3, 1, 2).float() / 255)
        ensemble.eval()
    plain = np.concatenate([ensemble.predict(states) for ensemble in ensembles], axis=1)
    stacked = StackedMembers(ensembles).predict(states)
    np.testing.assert_allclose(stacked, plain, atol=1e-5)
    assert np.ptp(plain) > 1e-3
    assert StackedMembers(ensembles).predict(states[:0]).shape == (0, 4)
