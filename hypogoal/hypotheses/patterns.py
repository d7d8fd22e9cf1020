"""Patterns: simple features of pictures, without labels, which proposals are classifiers of."""

from __future__ import annotations

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.nn import functional

from hypogoal.core.errors import UserError
from hypogoal.hypotheses.networks import as_input, at_once

# Chosen on WhichFeature, seeds 200 to 204: docs/results/which-feature.md.
SIDE = 8  # pixels of a patch
FILTERS, SAMPLED = 256, 20_000  # patches that become filters, of so many
STRIKING = 0.3  # share of the patches, those of most contrast, that filters are drawn from where there are enough
SILENT, OVERLAPPING = 0.5, 3.0  # the response up to which a filter is silent, among tiles and among overlapping patches


def views(channels: int) -> tuple[Tensor, ...]:
    """What filters see of a patch, each a matrix (d, v): all of it, the mean of its channels, that of its pixels."""
    of_channels, of_pixels = (torch.full((count, 1), 1 / count) for count in (channels, SIDE**2))
    grey, colour = torch.kron(of_channels, torch.eye(SIDE**2)), torch.kron(torch.eye(channels), of_pixels)
    return torch.eye(channels * SIDE**2), grey, colour


class Patterns:
    """Features of pictures, without labels: how much there is of each pattern, and on which side.

    Filters are patches of the pictures (N, h, w, C) themselves, whitened (Coates and Ng 2011), in three :func:`views`:
    as they are, without colour, and their mean colour alone. Only with filters that are blind to colour is *a ball*
    simpler than *a ball if it is red, else on the right*, which fits labels and independence as well.
    """

    def __init__(self, pictures: NDArray[np.uint8], stride: int, rng: np.random.Generator):
        self.stride = stride
        height, width, channels = pictures.shape[1:]
        if min(height, width) < SIDE:
            fault = f"pictures of {height} x {width} pixels are too small for patterns"
            raise UserError(fault, "proposals=joint", "Set proposals=none.")
        some = as_input(torch.from_numpy(pictures[rng.permutation(len(pictures))[:512]]))
        patches = functional.unfold(some, SIDE, stride=stride).mT.reshape(-1, channels * SIDE**2)
        patches = patches[torch.from_numpy(rng.permutation(len(patches))[:SAMPLED])]
        silent = SILENT if stride >= SIDE else OVERLAPPING
        weights, biases = zip(*(self._filters(patches, view, silent, rng) for view in views(channels)), strict=True)
        self.weight, self.bias = torch.cat(weights).view(-1, channels, SIDE, SIDE), torch.cat(biases)

    @staticmethod
    def _filters(patches: Tensor, view: Tensor, silent: float, rng: np.random.Generator) -> tuple[Tensor, Tensor]:
        """Weights (F, d) and biases (F,) of filters that see patches (P, d) through a view (d, v)."""
        seen = patches @ view
        centre = seen.mean(0)
        values, vectors = torch.linalg.eigh((seen - centre).T @ (seen - centre) / len(seen))
        whitening = vectors * (values + 0.01 * values[-1]).clamp(min=1e-9).rsqrt() @ vectors.T
        distinct = torch.unique(((seen - centre) @ whitening * 1e3).round(), dim=0)
        if len(distinct) > FILTERS:
            most = max(FILTERS, int(STRIKING * len(distinct)))
            distinct = distinct[distinct.norm(dim=1).argsort(descending=True, stable=True)[:most]]
        filters = functional.normalize(distinct[torch.from_numpy(rng.permutation(len(distinct))[:FILTERS])], dim=1)
        filters = filters @ whitening
        return filters @ view.T, -(filters @ centre) - silent

    def of(self, pictures: NDArray[np.uint8]) -> Tensor:
        """The features (N, 3 F): each filter's responses summed, right minus left, and bottom minus top."""
        rows, size = [], at_once(256, pictures.shape[1:])
        for start in range(0, len(pictures), size):
            inputs = as_input(torch.from_numpy(pictures[start : start + size]))
            found = functional.conv2d(inputs, self.weight, self.bias, self.stride).relu()
            down, across = found.sum(3), found.sum(2)
            rows.append(torch.cat([down.sum(2), _difference(across), _difference(down)], dim=1))
        return torch.cat(rows)


def _difference(sums: Tensor) -> Tensor:
    """The second half of the last axis minus the first."""
    half = sums.shape[-1] // 2
    return sums[..., sums.shape[-1] - half :].sum(-1) - sums[..., :half].sum(-1)
