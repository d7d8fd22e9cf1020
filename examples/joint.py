r"""A teacher: linear classifiers of small patterns, one for each member, searched for jointly (beyond the paper).

    hypogoal collect rooms --out runs/joint/data.h5
    hypogoal train-ensemble runs/joint/data.h5 --out runs/joint/ensemble --diversity none --members 2 \
        --set teacher=joint:independent
    hypogoal evaluate runs/joint --trust

``hypogoal run rooms --set methods=joint --trust`` does so for ten seeds, and trains agents that choose among the
members' options.

Networks that a diversity objective drives apart learn mixtures of features, which fit the labels and differ as well.
Linear classifiers of simple patterns, *proposals*, are cheap enough to search for whole sets, from many starts: the set
with the least loss wins. All proposals fit the labels and are independent on the unlabelled states; each member learns
what its proposal predicts there, beside the labels. No truth is needed.

The search assumes that features are about as frequent as the labels, and that they agree in one common share of the
unlabelled states: ``independent`` takes that to be 0, ``teach`` looks for it. It takes pictures that are made of tiles
of 8 x 8 pixels; for others set ``STRIDE`` to 2.
"""

from functools import reduce
from math import sqrt

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.nn import functional

from hypogoal.core.seeding import rng_for, torch_generator

# The constants were chosen on seeds 200 to 204 of rooms with planted features.
SIDE, STRIDE = 8, 8  # pixels of a pattern, and between two of them
FILTERS, SAMPLED = 256, 20_000  # patches that become filters, of so many
PICTURES = 512  # pictures that patches are taken from
STRIKING = 0.3  # share of the patches, those of most contrast, that filters are drawn from where there are enough
SILENT, OVERLAPPING = 0.5, 3.0  # the response up to which a filter is silent, among tiles and among overlapping patches
AT_ONCE = 256  # pictures that filters look at together

AGREEMENTS = (0.0, 0.25, 0.5, 0.75)  # shares of the unlabelled states in which all features agree: those to try
WORTH = 2.0  # times less loss that a higher agreement must have: it asks less of proposals
MOST = 8  # proposals: the table of their predictions has 2^K cells
RESTARTS = 96  # starts of a search
STEPS = 400  # of a search with one agreement
RAMP = STEPS // 4  # steps until independence has its full weight
MOST_STATES = 2048  # of each kind, labelled or not, that a search looks at
NOISE = 2.4  # standard errors: a correlation with the label up to here counts as none
KEPT = 0.999  # share of the variance in the principal components
RATE, SPREAD = 0.05, 0.7  # Adam's rate; deviation of the logarithm of a start's metric
TOGETHER, BALANCE, L2 = 3.0, 4.0, 1e-3  # weights of terms of the loss
FLOOR = 0.02  # added to expected shares: a cell hardly expected must not outweigh the others


def teach(
    observations: NDArray[np.uint8], labels: NDArray[np.bool_], unlabelled: NDArray[np.uint8], members: int, seed: int
) -> NDArray[np.float32]:
    """Scores (K, M) of the unlabelled pictures (M, h, w, C): those of the best set of K proposals.

    Takes labelled pictures (N, h, w, C) and their labels (N,).
    """
    search = Search(observations, labels, unlabelled, members, seed)
    return search.scores(AGREEMENTS)


def independent(
    observations: NDArray[np.uint8], labels: NDArray[np.bool_], unlabelled: NDArray[np.uint8], members: int, seed: int
) -> NDArray[np.float32]:
    """As :func:`teach`, of features that agree in no more of the unlabelled states than by chance."""
    search = Search(observations, labels, unlabelled, members, seed)
    return search.scores(AGREEMENTS[:1])


def as_float(pictures: NDArray[np.uint8]) -> Tensor:
    """uint8 (N, h, w, C) -> float32 (N, C, h, w) in 0..1."""
    return torch.from_numpy(pictures).permute(0, 3, 1, 2).float() / 255.0


def views(channels: int) -> tuple[Tensor, ...]:
    """What filters see of a patch, each a matrix (d, v): all of it, the mean of its channels, that of its pixels."""
    of_channels = torch.full((channels, 1), 1 / channels)
    of_pixels = torch.full((SIDE**2, 1), 1 / SIDE**2)
    grey = torch.kron(of_channels, torch.eye(SIDE**2))
    colour = torch.kron(torch.eye(channels), of_pixels)
    return torch.eye(channels * SIDE**2), grey, colour


class Patterns:
    """Features of pictures, without labels: how much there is of each pattern, and on which side.

    Filters are patches of the pictures (N, h, w, C) themselves, whitened (Coates and Ng 2011), in three :func:`views`:
    as they are, without colour, and their mean colour alone. Only with filters that are blind to colour is *a ball*
    simpler than *a ball if it is red, else on the right*, which fits labels and independence as well.
    """

    def __init__(self, pictures: NDArray[np.uint8], rng: np.random.Generator):
        height, width, channels = pictures.shape[1:]
        if min(height, width) < SIDE:
            raise ValueError(f"pictures of {height} x {width} pixels are too small for patterns")
        some = as_float(pictures[rng.permutation(len(pictures))[:PICTURES]])
        patches = functional.unfold(some, SIDE, stride=STRIDE).mT.reshape(-1, channels * SIDE**2)
        patches = patches[torch.from_numpy(rng.permutation(len(patches))[:SAMPLED])]
        filters = [self._filters(patches, view, rng) for view in views(channels)]
        self.weight = torch.cat([weight for weight, _ in filters]).view(-1, channels, SIDE, SIDE)
        self.bias = torch.cat([bias for _, bias in filters])

    @staticmethod
    def _filters(patches: Tensor, view: Tensor, rng: np.random.Generator) -> tuple[Tensor, Tensor]:
        """Weights (F, d) and biases (F,) of filters that see patches (P, d) through a view (d, v)."""
        seen = patches @ view
        centre = seen.mean(0)
        values, vectors = torch.linalg.eigh((seen - centre).T @ (seen - centre) / len(seen))
        whitening = vectors * (values + 0.01 * values[-1]).clamp(min=1e-9).rsqrt() @ vectors.T
        distinct = torch.unique(((seen - centre) @ whitening * 1e3).round(), dim=0)
        if len(distinct) > FILTERS:
            most = max(FILTERS, int(STRIKING * len(distinct)))
            by_contrast = distinct.norm(dim=1).argsort(descending=True, stable=True)
            distinct = distinct[by_contrast[:most]]
        chosen = torch.from_numpy(rng.permutation(len(distinct))[:FILTERS])
        filters = functional.normalize(distinct[chosen], dim=1) @ whitening
        silent = SILENT if STRIDE >= SIDE else OVERLAPPING
        return filters @ view.T, -(filters @ centre) - silent

    def of(self, pictures: NDArray[np.uint8]) -> Tensor:
        """The features (N, 3 F): each filter's responses summed, right minus left, and bottom minus top."""
        rows = []
        for start in range(0, len(pictures), AT_ONCE):
            inputs = as_float(pictures[start : start + AT_ONCE])
            found = functional.conv2d(inputs, self.weight, self.bias, STRIDE).relu()
            down, across = found.sum(3), found.sum(2)
            rows.append(torch.cat([down.sum(2), _difference(across), _difference(down)], dim=1))
        return torch.cat(rows)


def _difference(sums: Tensor) -> Tensor:
    """The second half of the last axis minus the first."""
    half = sums.shape[-1] // 2
    return sums[..., sums.shape[-1] - half :].sum(-1) - sums[..., :half].sum(-1)


def relevance(features: Tensor, labels: Tensor) -> Tensor:
    """How far each of the features (N, D) correlates with the labels bool (N,) beyond noise, float (D,)."""
    signs = 2.0 * labels - 1.0
    products = (features - features.mean(0)) * (signs - signs.mean())[:, None]
    correlation = products.mean(0) / (features.std(0) + 1e-6) / signs.std()
    return (correlation.abs() - NOISE / sqrt(len(labels))).relu()


def components(labelled: Tensor, labels: Tensor, unlabelled: Tensor) -> tuple[Tensor, Tensor]:
    """Principal components (N, k), (M, k) of features (N, D), (M, D), each scaled by its :func:`relevance` first.

    Proposals pay for size, so what does not go with the labels is dear. A ``ValueError`` if nothing does.
    """
    deviation = unlabelled.std(0)
    scale = relevance(labelled, labels) / (deviation + 1e-3 * deviation.max() + 1e-9)
    kept = scale > 0
    if not kept.any():
        raise ValueError("no pattern goes with the labels: more labelled states are needed")
    labelled, unlabelled = labelled[:, kept] * scale[kept], unlabelled[:, kept] * scale[kept]
    centre = unlabelled.mean(0)
    size = (unlabelled - centre).square().sum(1).mean().sqrt()
    labelled, unlabelled = (labelled - centre) / size, (unlabelled - centre) / size
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
    first = reduce(with_member, members[:half], ones)
    second = reduce(with_member, members[half:], ones)
    of_one = soft.new_tensor([[0.5, 0.5], [-0.5, 0.5]])  # negative (1 - m) / 2, positive (1 + m) / 2
    return (first @ second.mT).flatten(1) / soft.shape[2] @ reduce(torch.kron, [of_one] * len(members))


class Search:
    """The search for K proposals, jointly, from ``RESTARTS`` starts at once (R)."""

    def __init__(
        self,
        observations: NDArray[np.uint8],
        labels: NDArray[np.bool_],
        unlabelled: NDArray[np.uint8],
        members: int,
        seed: int,
    ):
        if not 2 <= members <= MOST:
            raise ValueError(f"proposals are searched for from 2 to {MOST} members, not {members}")
        rng, generator = rng_for(seed, "states"), torch_generator(seed, "starts")
        negatives = rng.permutation(np.flatnonzero(~labels))
        positives = rng.permutation(np.flatnonzero(labels))
        each = min(MOST_STATES // 2, len(negatives), len(positives))
        rows = np.concatenate([negatives[:each], positives[:each]])
        some = unlabelled[:: -(-len(unlabelled) // MOST_STATES)]
        patterns = Patterns(np.concatenate([observations[rows], some]), rng)
        truth = torch.from_numpy(labels[rows])
        self.members = members
        self.labelled, self.every = components(patterns.of(observations[rows]), truth, patterns.of(unlabelled))
        self.unlabelled = self.every[torch.from_numpy(rng.permutation(len(unlabelled))[:MOST_STATES])]
        self.signs, self.positives = 2.0 * truth - 1.0, float(labels.mean())
        shape = RESTARTS * members, self.labelled.shape[1]
        metric = torch.exp(SPREAD * torch.randn(shape, generator=generator))
        self.metric = metric / metric.square().mean(1, keepdim=True).sqrt()
        self.start = torch.randn(shape, generator=generator) * 3.0 / sqrt(shape[1])

    def scores(self, agreements: tuple[float, ...]) -> NDArray[np.float32]:
        """The best proposals' scores of all unlabelled states, (K, M): positive predictions above 0."""
        least, weights, biases = self.best(agreements[0])
        for agreement in agreements[1:]:
            loss, *found = self.best(agreement)
            if loss < least / WORTH:
                least, (weights, biases) = loss, found
        return torch.addmm(biases[:, None], weights, self.every.T).numpy()

    def best(self, agreement: float) -> tuple[float, Tensor, Tensor]:
        """The least loss with one agreement, and the weights (K, k) and biases (K,) of that set of proposals.

        In the first half each start measures the size of proposals by a random metric of its own.
        """
        weights, biases = self.start, torch.zeros(len(self.start))
        weights, biases = self.descend(weights, biases, agreement, range(STEPS // 2), self.metric)
        weights, biases = self.descend(self.metric * weights, biases, agreement, range(STEPS // 2, STEPS))
        loss, number = self.losses(weights, biases, agreement, TOGETHER).min(0)
        sets = weights.unflatten(0, (-1, self.members)), biases.unflatten(0, (-1, self.members))
        return loss.item(), sets[0][number], sets[1][number]

    def descend(
        self, weights: Tensor, biases: Tensor, agreement: float, steps: range, metric: Tensor | None = None
    ) -> tuple[Tensor, Tensor]:
        """Weights (R K, k) and biases (R K,) after these steps of Adam."""
        weights, biases = weights.clone().requires_grad_(), biases.clone().requires_grad_()
        adam = torch.optim.Adam([weights, biases], lr=RATE, fused=True)
        for step in steps:
            together = TOGETHER * min(1.0, (step + 1) / RAMP)
            losses = self.losses(weights, biases, agreement, together, metric)
            adam.zero_grad()
            losses.sum().backward()
            adam.step()
        return weights.detach(), biases.detach()

    def losses(
        self, weights: Tensor, biases: Tensor, agreement: float, together: float, metric: Tensor | None = None
    ) -> Tensor:
        """Each start's loss (R,): of its proposals one by one, and ``together`` times that of all of them.

        A proposal should fit the labels and decide unlabelled states, both with a margin; have as many positives as the
        labels; and be small. All of them should agree, beyond chance, in a share ``agreement`` of the states: in the
        correlation of each pair, and in the table of their predictions (chi-square), independent in all other states.
        """
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
        correlation = covariance / (deviation @ deviation.mT)
        pairs = (correlation - agreement).square().triu(1).sum((1, 2))

        expected = (1.0 - agreement) * table(soft.new_full((1, self.members, 1), prior))
        expected[:, [0, -1]] += agreement * torch.tensor([1.0 - self.positives, self.positives])
        cells = ((table(soft) - expected).square() / (expected + FLOOR)).sum(1)
        return alone.unflatten(0, (-1, self.members)).sum(1) + together * (pairs + cells)
