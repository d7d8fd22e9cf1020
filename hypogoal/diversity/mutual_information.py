"""Mutual information of members' classes: DivDis without its ratio term, as the authors' code optimises it."""

import math

import torch
from torch import Tensor

SMALLEST_LOG = -1e30  # replaces log 0, so that 0 log 0 is 0 instead of NaN


def pair_loss(
    logits_a: Tensor,
    logits_b: Tensor,
) -> Tensor:
    """Return the mutual information of two members' classes over the unlabelled states, which training minimises.

    The mutual information is ``KL(mean_n p_a(y|n) p_b(z|n)  ||  mean_n p_a(y|n) x mean_n p_b(z|n))``: the joint
    distribution of both members' classes over the batch, against the product of their marginals. The loss is 0 if one
    member's predictions carry no information about the other member's predictions. So the loss is lowest when members
    differ on as many states as independence implies, because always contradicting another member is as informative as
    always agreeing. If a member predicts one class for all states, the loss is 0 with a gradient near 0, and members
    that agree there stay in agreement. DivDis adds a ratio term against that (:mod:`hypogoal.diversity.divdis`), which
    the authors dropped.

    Args:
        logits_a: float (..., N, 2), the logits of one member on N unlabelled states.
        logits_b: float (..., N, 2), the logits of another member on the same states.

    Returns:
        float (...,), from 0 to log 2 up to rounding, in nats. The loss is 0 for N = 0, and symmetric in a and b.

    Source: arXiv:2202.03418 (DivDis). The paper's appendix calls the loss the Kullback-Leibler divergence.
    """
    states = logits_a.shape[-2]
    if states == 0:
        return (logits_a + logits_b).sum(dim=(-2, -1))
    log_a = torch.log_softmax(logits_a, dim=-1)
    log_b = torch.log_softmax(logits_b, dim=-1)
    log_a = log_a.clamp(min=SMALLEST_LOG)
    log_b = log_b.clamp(min=SMALLEST_LOG)
    both = log_a.unsqueeze(-1) + log_b.unsqueeze(-2)  # (..., N, 2, 2)
    joint = log_mean(both, dim=-3)  # (..., 2, 2)
    marginal_a = log_mean(log_a, dim=-2)  # (..., 2)
    marginal_b = log_mean(log_b, dim=-2)
    product = marginal_a.unsqueeze(-1) + marginal_b.unsqueeze(-2)
    information = joint.exp() * (joint - product)
    return information.sum(dim=(-2, -1))


def log_mean(
    logs: Tensor,
    dim: int,
) -> Tensor:
    """Return the logarithm of the mean along ``dim`` of the numbers whose logarithms are ``logs``."""
    return torch.logsumexp(logs, dim=dim) - math.log(logs.shape[dim])
