"""What coverage says of members whose knowledge is known (Spec H1)."""

from __future__ import annotations

from itertools import product

import numpy as np
import pytest
from numpy.typing import NDArray

from hypogoal.evaluation import coverage

FACTORS = np.array(list(product((False, True), repeat=4)) * 20)  # (320, 4), crossed
SURE: NDArray[np.float32] = np.where(FACTORS, 0.9, 0.1).astype(np.float32)  # a member for each factor


def rng() -> np.random.Generator:
    return np.random.default_rng(0)


def test_members_that_know_a_factor_each_cover_all() -> None:
    """By hand: .9 where it holds and .1 where not."""
    ranked = coverage.rankings(SURE, FACTORS)
    assert (ranked == np.where(np.eye(4) == 1, 1.0, 0.5)).all()
    assert (coverage.owned(ranked) == np.eye(4, dtype=bool)).all()
    assert coverage.owned(ranked).any(axis=0).mean() == 1.0


@pytest.mark.parametrize("factor", range(4))
def test_copies_of_one_member_cover_one_factor(factor: int) -> None:
    """However many there are."""
    ranked = coverage.rankings(np.repeat(SURE[:, [factor]], 6, axis=1), FACTORS)
    assert coverage.owned(ranked).any(axis=0).mean() == 0.25


def test_members_that_guess_cover_nothing() -> None:
    """And neither do members that always say the same."""
    for seed in range(20):
        guesses = np.random.default_rng(seed).random((320, 4)).astype(np.float32)
        assert not coverage.owned(coverage.rankings(guesses, FACTORS)).any()
    assert not coverage.owned(coverage.rankings(np.full((320, 4), 0.3, np.float32), FACTORS)).any()


def test_a_member_that_uses_two_factors_owns_neither() -> None:
    """A member of both at once ranks .75 on each; one of the first, with a hint of the second, 1 and .75."""
    both = (FACTORS[:, :1] & FACTORS[:, 1:2]).astype(np.float32)
    assert coverage.rankings(both, FACTORS)[0].tolist() == [0.75, 0.75, 0.5, 0.5]
    hint = (0.6 * FACTORS[:, :1] + 0.2 * FACTORS[:, 1:2]).astype(np.float32)
    ranked = coverage.rankings(hint, FACTORS)
    assert ranked[0].tolist() == [1.0, 0.75, 0.5, 0.5]
    assert coverage.owned(ranked).any(axis=0).mean() == 0.0
    assert coverage.owned(ranked, low=0.8).any(axis=0).mean() == 0.25


def test_a_member_that_ranks_by_another_factor_the_wrong_way_round_owns_neither() -> None:
    """A ranking of .25 says as much of a factor as one of .75: what is owned does not change with a factor's sign."""
    against = (0.6 * FACTORS[:, :1] - 0.2 * FACTORS[:, 1:2]).astype(np.float32)
    ranked = coverage.rankings(against, FACTORS)
    assert ranked[0].tolist() == [1.0, 0.25, 0.5, 0.5]
    assert not coverage.owned(ranked).any()
    table = rng().random((500, 4)) * 0.5 + 0.25
    table[:, 0] = 1.0
    turned = np.where(rng().random((500, 4)) < 0.5, table, 1 - table)
    turned[:, 0] = 1.0
    assert (coverage.owned(table) == coverage.owned(turned)).all()
    assert 0 < coverage.owned(table).sum() < 500


@pytest.mark.parametrize("low", [0.5, 0.55, 0.6, 0.65, 0.7, 0.75, 0.8, 0.9])
def test_bounds_of_owning_are_met_exactly(low: float) -> None:
    """On either side, a thousandth beyond them no more; the same of the upper bound."""
    for other, owns in ((low, True), (1 - low, True), (low + 0.001, False), (1 - low - 0.001, False)):
        assert coverage.owned(np.array([[0.95, other]]), low=low).any() == owns
    assert not coverage.owned(np.array([[0.949, 0.5]]), low=low).any()
