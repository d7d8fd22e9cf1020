"""Independent features: the Hilbert-Schmidt independence criterion between members' last hidden layers."""

from itertools import combinations

import torch
from torch import Tensor

from hypogoal.diversity import Context

TINY = 1e-12  # added to squared distances and norms of features, against division by 0


def ensemble_loss(context: Context) -> Tensor:
    """``2 sum_{a<b} HSIC(F_a, F_b) / sqrt(HSIC(F_a, F_a) HSIC(F_b, F_b))`` over the unlabelled states.

    HSIC = tr(H A H B) with Gaussian kernels A and B of two members' features, their widths the mean squared distance
    (of this batch, held fixed), and H = I - 1/N. It is 0 if two members' features are
    independent. The division keeps members from escaping it with small features. Frozen members have no features and
    are ignored.

    Returns:
        float (), from 0 to K (K - 1); 0 for fewer than two states or members.

    Source: Gretton et al. 2005 (HSIC, biased estimate); as a penalty between networks, arXiv:1910.02806 (ReBias).
    """
    features = context.unlabelled_features
    members, states = features.shape[:2]
    if members < 2 or states < 2:
        return context.unlabelled.sum() * 0.0
    norms = features.square().sum(-1)
    squared = (norms[:, :, None] + norms[:, None, :] - 2.0 * features @ features.mT).clamp(min=0.0)
    width = squared.detach().mean((1, 2), keepdim=True) + TINY
    kernels = torch.exp(-squared / width)
    centred = kernels - kernels.mean(1, keepdim=True)
    centred = centred - centred.mean(2, keepdim=True)
    flat = centred.flatten(1)
    flat = flat / (flat.square().sum(1, keepdim=True) + TINY).sqrt()
    return 2.0 * torch.stack([(flat[a] * flat[b]).sum() for a, b in combinations(range(members), 2)]).sum()
