"""DivDis: diversity by statistical independence (Lee et al. 2022), with its ratio term."""

import math

import torch
from torch import Tensor

from hypogoal.diversity import Context
from hypogoal.diversity.mutual_information import pair_loss

RATIO_WEIGHT = 1.0  # of the ratio term beside the mutual information: own choice; the source tunes it


def ensemble_loss(context: Context) -> Tensor:
    """Mutual information of all ordered pairs, plus each member's deviation from the labelled share of positives.

    ``sum_m sum_{i != m} I(y_i; y_m) + w sum_m KL(mean_n p_m(y|n) || p(y))``, with p(y) the labelled states' share of
    positives. The second term keeps members from predicting one class for all unlabelled states, where the first is 0
    without a gradient.

    Returns:
        float (), in nats, at least 0 up to rounding; 0 for no states.

    Source: arXiv:2202.03418 (DivDis), its repulsion loss and its regularisation loss.
    """
    logits, frozen = context.unlabelled, context.frozen
    members, states = logits.shape[:2]
    if states == 0:
        return logits.sum()
    losses = [2.0 * pair_loss(logits[:m], logits[m].expand_as(logits[:m])).sum() for m in range(1, members)]
    losses += [pair_loss(frozen, member.expand_as(frozen)).sum() for member in logits if len(frozen)]
    share = torch.logsumexp(torch.log_softmax(logits, dim=-1), dim=1) - math.log(states)  # (K, 2)
    priors = (math.log(1.0 - context.positives), math.log(context.positives))
    ratios = [(log.exp() * (log - prior)).sum() for log, prior in zip(share.unbind(-1), priors, strict=True)]
    return torch.stack([*losses, *(RATIO_WEIGHT * ratio for ratio in ratios)]).sum()
