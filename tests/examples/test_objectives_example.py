"""Repulsive and ACE as objectives of one's own: the laws, and what they make of members."""

import numpy as np
import pytest
from numpy.typing import NDArray

from hypogoal.check.objectives import check_objective
from hypogoal.check.verdict import require
from hypogoal.diversity import load_objective
from hypogoal.hypotheses.config import EnsembleConfig
from hypogoal.hypotheses.scores import mean_disagreement
from hypogoal.hypotheses.training import train


@pytest.mark.parametrize("name", ["repulsive", "ace"])
def test_they_keep_the_laws(name: str) -> None:
    """Spec C1, C2: shapes, empty sets, any order, extreme logits, a gradient for each member."""
    require(check_objective(load_objective(f"objectives:{name}")))


def numbers(easy: NDArray[np.bool_], hard: NDArray[np.bool_], seed: int) -> NDArray[np.float32]:
    """Three numbers: the first has the easy feature's sign, the product of the others the hard one's."""
    rng = np.random.default_rng(seed)
    first, second = np.where(easy, 1.0, -1.0), rng.choice([-1.0, 1.0], size=len(easy))
    values = np.stack([first, second, np.where(hard, second, -second)], axis=1)
    return (values + 0.1 * rng.normal(size=values.shape)).astype(np.float32)


@pytest.mark.parametrize(("name", "weight"), [("repulsive", 1.0), ("ace", 0.1)])
def test_members_disagree_where_they_agree_without(name: str, weight: float) -> None:
    """Labels fit two features, and one is easy: without an objective every member takes that one."""
    labels, free = np.arange(200) % 2 == 0, np.arange(200)
    seen, elsewhere = numbers(labels, labels, 0), numbers(free % 2 == 0, free % 4 < 2, 1)
    plain = EnsembleConfig(members=3, steps=150, learning_rate=1e-3, diversity="none")
    diverse = plain.model_copy(update={"diversity": f"objectives:{name}", "diversity_weight": weight})
    found = []
    for config in (plain, diverse):
        ensemble = train(seen, labels, elsewhere, config, seed=1)
        assert (ensemble.predictions(seen) == labels[:, None]).mean() > 0.95
        found.append(mean_disagreement(ensemble.predictions(elsewhere)))
    assert found[0] < 0.05 and found[1] > 0.15, found
