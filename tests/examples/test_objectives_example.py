"""Repulsive and ACE as objectives of one's own: the laws, values worked by hand, and what they make of members."""

from __future__ import annotations

import math
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from numpy.typing import NDArray

from hypogoal.check.objectives import check_objective
from hypogoal.check.verdict import require
from hypogoal.diversity import Objective, load_objective
from hypogoal.hypotheses.config import EnsembleConfig
from hypogoal.hypotheses.scores import mean_disagreement
from hypogoal.hypotheses.training import train
from tests.logits import confident, context_of

EXAMPLES = Path(__file__).parents[2] / "examples"
NAMES = ("repulsive", "ace")


@pytest.fixture(autouse=True)
def trusted(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sys, "path", [*sys.path, str(EXAMPLES)])
    monkeypatch.setenv("HYPOGOAL_TRUST", "1")


def objective(name: str) -> Objective:
    return load_objective(f"objectives:{name}")


@pytest.mark.parametrize("name", NAMES)
def test_they_keep_the_laws(name: str) -> None:
    """Spec C1, C2: shapes, empty sets, any order, extreme logits, a gradient for each member."""
    require(check_objective(objective(name)))


@pytest.mark.parametrize("name", NAMES)
def test_members_that_differ_have_a_lower_loss(name: str) -> None:
    """Spec C2: on half of the states, against members that are nearly the same."""
    agreeing = torch.stack([confident(1, 1, 0, 0), confident(1, 1, 0, 0, gap=6.1)])
    differing = torch.stack([confident(1, 1, 0, 0), confident(1, 0, 1, 0, gap=6.1)])
    third = confident(0, 0, 0, 0)[None]
    losses = []
    for members in (agreeing, differing):
        context = context_of(3, 4)
        losses.append(objective(name).loss(replace(context, unlabelled=torch.cat([members, third]))).item())
    assert losses[1] < losses[0]


def test_repulsive_is_the_kernels_own_repulsion() -> None:
    """Its gradient by one member's gaps is the sum of the kernel's gradients over the kernel's sum."""
    context = context_of(3, 5)
    (gradient,) = torch.autograd.grad(objective("repulsive").loss(context).sum(), context.unlabelled)
    gaps = (context.unlabelled[..., 1] - context.unlabelled[..., 0]).detach()
    squared = (gaps[:, None] - gaps[None]).square().mean(-1)
    width = squared[~torch.eye(3, dtype=torch.bool)].median() / math.log(3)
    kernel = torch.exp(-squared / width)
    for member in range(3):
        away = sum(kernel[member, j] * -2 * (gaps[member] - gaps[j]) / 5 / width for j in range(3))
        torch.testing.assert_close(gradient[member, :, 1], away / kernel[member].sum())
    assert objective("repulsive").loss(context_of(1)).item() == 0.0


def test_ace_asks_for_the_easiest_tenth_only() -> None:
    """Of 20 states the two cheapest of each direction; the others get no gradient."""
    generator = torch.Generator().manual_seed(1)
    logits = torch.randn(2, 20, 2, generator=generator, dtype=torch.float64).requires_grad_()
    loss = objective("ace").loss(replace(context_of(2, 20), unlabelled=logits)).sum()
    log = torch.log_softmax(logits.detach(), -1)
    costs = [-(log[0, :, 1] + log[1, :, 0]), -(log[1, :, 1] + log[0, :, 0])]
    assert loss.item() == pytest.approx(sum(float(cost.sort().values[:2].mean()) for cost in costs))
    (gradient,) = torch.autograd.grad(loss, logits)
    asked = set(costs[0].argsort()[:2].tolist()) | set(costs[1].argsort()[:2].tolist())
    assert set((gradient.abs().sum((0, 2)) > 0).nonzero().flatten().tolist()) == asked


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
