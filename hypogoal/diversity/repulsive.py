"""A repulsive ensemble in function space (D'Angelo and Fortuin 2021)."""

import math

import torch
from torch import Tensor

from hypogoal.diversity import Context

TINY = 1e-12  # added to the kernel's width, in case all members are the same


def ensemble_loss(context: Context) -> Tensor:
    """``sum_m log mean_j k(f_m, f_j)``, whose gradient by f_m is the source's kernelised repulsion.

    f_m are member m's log-odds on the unlabelled states; k is a Gaussian kernel, its width the median squared distance
    between members over log K (held fixed). The f_j are held fixed too: each member is pushed away from the others.
    Repulsion decreases with distance, unlike D-BAT's, which continues until members contradict each other.

    Returns:
        float (), from -K log K to 0; 0 for one member or no states.

    Source: arXiv:2106.11642 (Repulsive deep ensembles are Bayesian), in function space.
    """
    gaps = context.unlabelled[..., 1] - context.unlabelled[..., 0]
    others = torch.cat([gaps.detach(), (context.frozen[..., 1] - context.frozen[..., 0]).to(gaps)])
    if len(others) < 2 or gaps.shape[1] == 0:
        return context.unlabelled.sum() * 0.0
    squared = (gaps[:, None] - others[None]).square().mean(-1)
    apart = ~torch.eye(len(gaps), len(others), dtype=torch.bool, device=gaps.device)
    width = squared.detach()[apart].median() / math.log(len(others)) + TINY
    kernel = -squared / width
    return (torch.logsumexp(kernel, dim=1) - math.log(len(others))).sum()
