"""Members that are independent, each with a share of positives of its own: DivDis with a range of shares."""

import torch
from torch import Tensor

from hypogoal.diversity import Context
from hypogoal.diversity.divdis import RATIO_WEIGHT, dependence, log_shares

MOST = 0.5  # of unlabelled states that a member may be positive on without a loss


def ensemble_loss(context: Context) -> Tensor:
    """Mutual information of all ordered pairs, plus each member's deviation from a range of shares of positives.

    ``sum_m sum_{i != m} I(y_i; y_m) + sum_m KL(s_m || nearest of [share, 1/2])``, with s_m = mean_n p_m(y|n). DivDis
    expects the same share of every member. But two features that the labels fit need not hold equally often, and a
    member that must be positive on more or fewer states than its feature is a mixture. Here the setting ``share`` is
    the least: what fits all features at once is rarer than each of them.

    Returns:
        float (), in nats, at least 0 up to rounding; 0 for no states.
    """
    if context.unlabelled.shape[1] == 0:
        return context.unlabelled.sum()
    terms = dependence(context)
    shares = log_shares(context)
    least = min(context.positives, MOST)
    nearest = shares[:, 1].detach().exp().clamp(least, MOST)
    priors = torch.stack([1.0 - nearest, nearest], dim=1)
    deviations = shares.exp() * (shares - priors.log())
    terms.append(RATIO_WEIGHT * deviations.sum())
    return torch.stack(terms).sum()
