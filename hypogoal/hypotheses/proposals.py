"""Proposals: linear classifiers, jointly independent on unlabelled states; each teaches a member (beyond the paper).

Networks that a diversity objective drives apart learn mixtures of features, which fit the labels and differ as well.
Linear classifiers of simple patterns are cheap enough to search for whole sets, from many starts: the set with the
least loss wins. No truth is needed.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from functools import reduce
from math import inf, sqrt

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from hypogoal.core.checkpoints import Resumable
from hypogoal.core.errors import UserError
from hypogoal.core.seeding import rng_for, torch_generator
from hypogoal.hypotheses.config import EnsembleConfig
from hypogoal.hypotheses.patterns import Patterns

AUTO = "auto"  # an agreement that no higher one is worth
AGREEMENTS = (0.0, 0.25, 0.5, 0.75)
STEPS = 400  # of a search with one agreement
MOST = 8  # proposals: the table of their predictions has 2^K cells
MOST_STATES = 2048  # of each kind, labelled or not, that a search looks at
# What follows was chosen on WhichFeature, seeds 200 to 204: docs/results/which-feature.md.
NOISE = 2.4  # standard errors: a correlation with the label up to here counts as none
KEPT = 0.999  # share of the variance in the principal components
RATE, SPREAD = 0.05, 0.7  # Adam's rate; deviation of the logarithm of a start's metric
TOGETHER, BALANCE, L2 = 3.0, 4.0, 1e-3  # weights of terms of the loss
WORTH = 2.0  # times less loss: a higher agreement asks less of proposals, so a little less loss says nothing
RAMP = STEPS // 4  # steps until the first has its full weight
FLOOR = 0.02  # added to expected shares: a cell hardly expected must not outweigh the others


def agreements(config: EnsembleConfig) -> tuple[float, ...]:
    """The agreements to search with, none without proposals; wrong settings are a ``UserError``."""
    if config.proposals == "none":
        return ()
    if not 1 < config.members <= MOST:
        do = f"Set members=2 to {MOST}, or proposals=none."
        raise UserError("proposals are independent of each other", f"proposals=joint, members={config.members}", do)
    if config.agreement == AUTO:
        return AGREEMENTS
    try:
        value = float(config.agreement)
    except ValueError:
        value = -1.0
    if not 0.0 <= value < 1.0:
        do = "Give auto, or a number from 0 to below 1."
        raise UserError("not an agreement", f"agreement={config.agreement}", do)
    return (value,)


def search_steps(config: EnsembleConfig) -> int:
    """Steps of a search with all agreements; 0 without proposals."""
    return STEPS * len(agreements(config))


def relevance(features: Tensor, labels: Tensor) -> Tensor:
    """How far each of the features (N, D) correlates with the labels bool (N,) beyond noise, float (D,)."""
    signs = 2.0 * labels - 1.0
    products = (features - features.mean(0)) * (signs - signs.mean())[:, None]
    correlation = products.mean(0) / (features.std(0) + 1e-6) / signs.std()
    return (correlation.abs() - NOISE / sqrt(len(labels))).relu()


def components(labelled: Tensor, labels: Tensor, unlabelled: Tensor) -> tuple[Tensor, Tensor]:
    """Principal components (N, k), (M, k) of features (N, D), (M, D), each scaled by its :func:`relevance` first.

    Proposals pay for size, so what does not go with the labels is dear. A ``UserError`` if nothing does.
    """
    deviation = unlabelled.std(0)
    scale = relevance(labelled, labels) / (deviation + 1e-3 * deviation.max() + 1e-9)
    kept = scale > 0
    if not kept.any():
        do = "Collect more labelled states, or set proposals=none."
        raise UserError("no pattern goes with the labels", "proposals=joint", do)
    labelled, unlabelled = (features[:, kept] * scale[kept] for features in (labelled, unlabelled))
    centre = unlabelled.mean(0)
    size = (unlabelled - centre).square().sum(1).mean().sqrt()
    labelled, unlabelled = ((features - centre) / size for features in (labelled, unlabelled))
    every = torch.cat([unlabelled, labelled]).double()
    values, vectors = torch.linalg.eigh(every.T @ every / len(every))
    values, vectors = values.flip(0).clamp(min=0.0), vectors.flip(1).float()
    count = int((values.cumsum(0) / values.sum() < KEPT).sum()) + 1
    return labelled @ vectors[:, :count], unlabelled @ vectors[:, :count]


def table(soft: Tensor) -> Tensor:
    """Shares (R, 2^K) of N states with each combination of K predictions, from soft ones (R, K, N), -1..1.

    The first cell is *all negative*, the last *all positive*. Computed from the means of products of predictions.
    """
    members, ones = soft.unbind(1), soft.new_ones(len(soft), 1, soft.shape[2])

    def with_member(products: Tensor, member: Tensor) -> Tensor:
        return torch.cat([products, products * member[:, None]], dim=1)

    half = len(members) // 2
    first, second = (reduce(with_member, some, ones) for some in (members[:half], members[half:]))
    of_one = soft.new_tensor([[0.5, 0.5], [-0.5, 0.5]])  # negative (1 - m) / 2, positive (1 + m) / 2
    return (first @ second.mT).flatten(1) / soft.shape[2] @ reduce(torch.kron, [of_one] * len(members))


class Search(Resumable):
    """The search for K proposals, jointly, from many starts at once, with each agreement in turn.

    Args:
        labelled, labels: pictures (N, h, w, C) and whether the sub-goal holds (N,).
        unlabelled: pictures (M, h, w, C).

    Attributes:
        total: steps of the whole search.
        best: weights (K, k) and biases (K,) of the best set so far; empty at first.
        loss, agreement: its loss, and with which agreement it was found.
    """

    CHANGING = ("parameters", "optimiser", "done", "best", "loss", "agreement")

    def __init__(
        self,
        labelled: NDArray[np.uint8],
        labels: NDArray[np.bool_],
        unlabelled: NDArray[np.uint8],
        config: EnsembleConfig,
        seed: int,
    ):
        rng = rng_for(seed, "states")
        classes = [rng.permutation(np.flatnonzero(labels == holds)) for holds in (False, True)]
        each = min(MOST_STATES // 2, *map(len, classes))
        rows = np.concatenate([some[:each] for some in classes])
        some = unlabelled[:: -(-len(unlabelled) // MOST_STATES)]
        patterns = Patterns(np.concatenate([labelled[rows], some]), config.pattern_stride, rng)
        truth = torch.from_numpy(labels[rows])
        self.labelled, self.every = components(patterns.of(labelled[rows]), truth, patterns.of(unlabelled))
        self.unlabelled = self.every[torch.from_numpy(rng.permutation(len(unlabelled))[:MOST_STATES])]
        self.signs, self.positives = 2.0 * truth - 1.0, float(labels.mean())
        self.agreements, self.members, self.restarts = agreements(config), config.members, config.restarts
        self.total = search_steps(config)
        shape, generator = (self.restarts * self.members, self.labelled.shape[1]), torch_generator(seed, "starts")
        metric = torch.exp(SPREAD * torch.randn(shape, generator=generator))
        self.metric = metric / metric.square().mean(1, keepdim=True).sqrt()
        self.start = torch.randn(shape, generator=generator) * 3.0 / sqrt(shape[1])
        self.parameters = nn.ParameterList([self.start.clone(), torch.zeros(shape[0])])
        self.done, self.loss, self.agreement = 0, inf, inf
        self.best: list[Tensor] = []
        self._renew(*self.parameters)

    def _renew(self, weights: Tensor, biases: Tensor) -> None:
        """Go on from these weights with a fresh optimiser."""
        with torch.no_grad():
            for parameter, value in zip(self.parameters, (weights, biases), strict=True):
                parameter.copy_(value)
        self.optimiser = torch.optim.Adam(self.parameters.parameters(), lr=RATE, fused=True)

    def steps(self, report: Callable[[int, dict[str, float]], None], every: int) -> Iterator[int]:
        """Take the steps that are left, and yield their numbers; reports the least loss after ``every`` so many.

        With the last step of an agreement it reports the best so far. In the first half each start measures the size of
        proposals by a random metric of its own.
        """
        while self.done < self.total:
            number, step = divmod(self.done, STEPS)
            if step == 0:
                self._renew(self.start, torch.zeros_like(self.parameters[1]))
            if step == STEPS // 2:
                self._renew(self.metric * self.parameters[0].detach(), self.parameters[1].detach())
            metric = self.metric if step < STEPS // 2 else None
            losses = self.losses(self.agreements[number], TOGETHER * min(1.0, (step + 1) / RAMP), metric)
            self.optimiser.zero_grad()
            losses.sum().backward()
            self.optimiser.step()
            self.done += 1
            if step + 1 == STEPS:
                self._keep(self.agreements[number])
                report(self.done, {"loss": self.loss, "agreement": self.agreement})
            elif self.done % every == 0:
                report(self.done, {"loss": losses.min().item(), "agreement": self.agreements[number]})
            yield self.done

    def _keep(self, agreement: float) -> None:
        """Remember the best of the sets, unless one with a lower agreement has little more loss."""
        with torch.no_grad():
            loss, number = self.losses(agreement, TOGETHER).min(0)
            if loss.item() < self.loss / WORTH:
                self.loss, self.agreement = loss.item(), agreement
                self.best = [values.unflatten(0, (-1, self.members))[number].clone() for values in self.parameters]

    def losses(self, agreement: float, together: float, metric: Tensor | None = None) -> Tensor:
        """Each start's loss (R,): of its proposals one by one, and ``together`` times that of all of them.

        A proposal should fit the labels and decide unlabelled states, both with a margin; have as many positives as the
        labels; and be small. All of them should agree, beyond chance, in a share ``agreement`` of the states: in the
        correlation of each pair, and in the table of their predictions (chi-square), independent in all other states.
        """
        weights, biases = self.parameters
        size = weights.square().sum(1)
        weights = weights if metric is None else metric * weights
        scores = torch.addmm(biases[:, None], weights, self.unlabelled.T)  # (R K, M)
        fitted = torch.addmm(biases[:, None], weights, self.labelled.T) * self.signs
        soft = torch.tanh(1.5 * scores)
        means, prior = soft.mean(1), 2.0 * self.positives - 1.0
        margins = (1.0 - scores.abs()).relu().square().mean(1) + (1.0 - fitted).relu().square().mean(1)
        alone = margins + BALANCE * (means - prior).square() + L2 * size
        soft, means = soft.unflatten(0, (-1, self.members)), means.view(-1, self.members, 1)
        covariance = soft @ soft.mT / soft.shape[2] - means @ means.mT
        deviation = covariance.diagonal(dim1=1, dim2=2).clamp(min=1e-6).sqrt()[:, :, None]
        pairs = (covariance / (deviation @ deviation.mT) - agreement).square().triu(1).sum((1, 2))
        expected = (1.0 - agreement) * table(soft.new_full((1, self.members, 1), prior))
        expected[:, [0, -1]] += agreement * torch.tensor([1.0 - self.positives, self.positives])
        cells = ((table(soft) - expected).square() / (expected + FLOOR)).sum(1)
        return alone.unflatten(0, (-1, self.members)).sum(1) + together * (pairs + cells)

    def scores(self) -> Tensor:
        """The best proposals' scores of all unlabelled states, float32 (K, M): positive predictions above 0."""
        weights, biases = self.best
        return torch.addmm(biases[:, None], weights, self.every.T)
