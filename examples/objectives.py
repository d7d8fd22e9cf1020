"""Two diversity objectives of whole ensembles: keep logits apart, or contradict each other where that is easiest.

    hypogoal collect doorkey --out runs/objectives/data.h5
    hypogoal train-ensemble runs/objectives/data.h5 --out runs/objectives/repulsive --diversity objectives:repulsive
    hypogoal train-ensemble runs/objectives/data.h5 --out runs/objectives/ace --diversity objectives:ace
    hypogoal evaluate runs/objectives

Check them: hypogoal check --diversity objectives:ace
"""

import math
from itertools import permutations

import torch
from torch import Tensor

from hypogoal.diversity import Context

TINY = 1e-12  # added to the kernel's width, in case all members are the same
LEAST_SHARE = 0.1  # of unlabelled states on which members should differ, in each direction: the mix rate of ACE


def repulsive(context: Context) -> Tensor:
    """``sum_m log mean_j k(f_m, f_j)``, whose gradient by f_m is the kernelised repulsion of D'Angelo and Fortuin 2021.

    f_m are member m's log-odds on the unlabelled states; k is a Gaussian kernel, its width the median squared distance
    between members over log K (held fixed). The f_j are held fixed too: each member is pushed away from the others.
    Repulsion decreases with distance, unlike D-BAT's, which continues until members contradict each other.

    Returns:
        float (), from -K log K to 0; 0 for one member or no states.

    Source: arXiv:2106.11642 (Repulsive deep ensembles are Bayesian), in function space.
    """
    gaps = context.unlabelled[..., 1] - context.unlabelled[..., 0]
    frozen = context.frozen[..., 1] - context.frozen[..., 0]
    others = torch.cat([gaps.detach(), frozen.to(gaps)])
    if len(others) < 2 or gaps.shape[1] == 0:
        return context.unlabelled.sum() * 0.0
    squared = (gaps[:, None] - others[None]).square().mean(-1)
    apart = ~torch.eye(len(gaps), len(others), dtype=torch.bool, device=gaps.device)
    width = squared.detach()[apart].median() / math.log(len(others)) + TINY
    kernel = -squared / width
    return (torch.logsumexp(kernel, dim=1) - math.log(len(others))).sum()


def ace(context: Context) -> Tensor:
    """For each ordered pair, -log p_a(positive) - log p_b(negative), mean over the tenth of states with the lowest.

    D-BAT rewards contradiction on every unlabelled state. This rewards confident contradiction where the members
    already disagree most, and ignores the rest. It covers both directions: a is positive and b negative on some states,
    and the reverse on others.

    Returns:
        float (), at least 0, in nats; 0 for no states or no pairs.

    Source: after arXiv:2509.07955 (ACE), written from its description; the share is set, not scheduled.
    """
    logits = torch.cat([context.unlabelled, context.frozen.to(context.unlabelled)])
    log = torch.log_softmax(logits, dim=-1)
    trained, states = context.unlabelled.shape[:2]
    pairs = [(a, b) for a, b in permutations(range(len(log)), 2) if min(a, b) < trained]
    if not pairs or states == 0:
        return context.unlabelled.sum() * 0.0
    positive = torch.stack([log[a, :, 1] for a, _ in pairs])
    negative = torch.stack([log[b, :, 0] for _, b in pairs])
    cheapest = math.ceil(LEAST_SHARE * states)
    lowest = torch.topk(-(positive + negative), cheapest, dim=1, largest=False, sorted=False)
    return lowest.values.mean(dim=1).sum()
