"""DivDis: diversity by statistical independence (Lee et al. 2022), with its ratio term."""

import math

import torch
from torch import Tensor

from hypogoal.diversity import Context
from hypogoal.diversity.mutual_information import log_mean, pair_loss

RATIO_WEIGHT = 1.0  # the weight of the ratio term beside the mutual information: own choice, the source tunes it


def ensemble_loss(context: Context) -> Tensor:
    """Return the mutual information of all ordered pairs, plus a ratio term.

    The loss is ``sum_m sum_{i != m} I(y_i; y_m) + w sum_m KL(mean_n p_m(y|n) || p(y))``. The second term, the ratio
    term, is each member's deviation from an expected share of positives. p(y) comes from the setting ``share``, which
    in the source is the labelled states' share of positives. The ratio term keeps members from predicting one class for
    all unlabelled states, because there the first term is 0 without a gradient.

    Returns:
        float (), in nats, at least 0 up to rounding. The loss is 0 if there are no states.

    Source: arXiv:2202.03418 (DivDis), its repulsion loss and its regularisation loss.
    """
    if context.unlabelled.shape[1] == 0:
        return context.unlabelled.sum()
    terms = dependence(context)
    priors = (1.0 - context.positives, context.positives)
    for log_share, prior in zip(log_shares(context).unbind(-1), priors, strict=True):
        ratio = log_share.exp() * (log_share - math.log(prior))
        terms.append(RATIO_WEIGHT * ratio.sum())
    return torch.stack(terms).sum()


def dependence(context: Context) -> list[Tensor]:
    """Return terms () whose sum is the mutual information of all pairs of members. There must be at least one state."""
    logits, frozen = context.unlabelled, context.frozen
    terms = []
    for number in range(1, len(logits)):
        earlier = logits[:number]
        shared = pair_loss(earlier, logits[number].expand_as(earlier))
        terms.append(2.0 * shared.sum())
    if len(frozen):
        terms += [pair_loss(frozen, member.expand_as(frozen)).sum() for member in logits]
    return terms


def log_shares(context: Context) -> Tensor:
    """Return the logarithms of each member's shares of negatives and positives of unlabelled states, float (K, 2)."""
    log_classes = torch.log_softmax(context.unlabelled, dim=-1)
    return log_mean(log_classes, dim=1)
