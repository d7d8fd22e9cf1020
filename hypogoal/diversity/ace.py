"""ACE: confident disagreement on the few states where members disagree most easily (Daniels et al. 2025)."""

import math
from itertools import permutations

import torch
from torch import Tensor

from hypogoal.diversity import Context

LEAST_SHARE = 0.1  # of unlabelled states on which members should differ, in each direction: the source's mix rate


def ensemble_loss(context: Context) -> Tensor:
    """For each ordered pair, -log p_a(positive) - log p_b(negative), mean over the tenth of states with the lowest.

    D-BAT rewards contradiction on every unlabelled state. This rewards confident contradiction where the members
    already disagree most, and ignores the rest. It covers both directions: a is positive and b negative on some states,
    and the reverse on others.

    Returns:
        float (), at least 0, in nats; 0 for no states or no pairs.

    Source: after arXiv:2509.07955 (ACE), written from its description; the share is set, not scheduled.
    """
    log = torch.log_softmax(torch.cat([context.unlabelled, context.frozen.to(context.unlabelled)]), dim=-1)
    trained, states = context.unlabelled.shape[:2]
    pairs = [(a, b) for a, b in permutations(range(len(log)), 2) if min(a, b) < trained]
    if not pairs or states == 0:
        return context.unlabelled.sum() * 0.0
    positive, negative = (torch.stack([log[pair[side], :, 1 - side] for pair in pairs]) for side in (0, 1))
    lowest = torch.topk(-(positive + negative), math.ceil(LEAST_SHARE * states), dim=1, largest=False, sorted=False)
    return lowest.values.mean(dim=1).sum()
