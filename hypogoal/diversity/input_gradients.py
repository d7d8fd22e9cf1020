"""Members that depend on different pixels: orthogonal input gradients of their logits (Teney et al. 2022)."""

from itertools import combinations

import torch
from torch import Tensor

from hypogoal.diversity import Context

TINY = 1e-12  # added to squared norms of gradients, against division by 0


def ensemble_loss(context: Context) -> Tensor:
    """``2 sum_{a<b} mean_n cos(g_a(n), g_b(n))^2`` over labelled states, with g the log-odds' gradient.

    Two members whose logits depend on the same pixels in the same way have a cosine of 1. The source uses the dot
    product of the gradients; here they are normalised, so that members cannot escape by flattening, and the cosine is
    squared, since opposite gradients use the same features. It needs no unlabelled states and ignores frozen members.

    Returns:
        float (), from 0 to K (K - 1); 0 for one member.

    Source: arXiv:2105.05612 (Evading the simplicity bias).
    """
    if len(context.labelled) < 2:
        return context.labelled.sum() * 0.0
    gradients = context.input_gradients()
    unit = gradients / (gradients.square().sum(-1, keepdim=True) + TINY).sqrt()
    pairs = combinations(range(len(unit)), 2)
    return 2.0 * torch.stack([(unit[a] * unit[b]).sum(-1).square().mean() for a, b in pairs]).sum()
