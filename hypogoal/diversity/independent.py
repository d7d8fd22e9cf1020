"""Members that are independent, each with its own share of positives: DivDis with a range of shares."""

import torch
from torch import Tensor

from hypogoal.diversity import Context
from hypogoal.diversity.divdis import RATIO_WEIGHT, dependence, log_shares

MOST = 0.5  # the largest share of unlabelled states on which a member may be positive without a loss


def ensemble_loss(context: Context) -> Tensor:
    """Return the mutual information of all ordered pairs, plus deviations from a range of shares of positives.

    The loss is ``sum_m sum_{i != m} I(y_i; y_m) + sum_m KL(s_m || nearest of [share, 1/2])``, with s_m = mean_n
    p_m(y|n). The second term is each member's deviation from the range. DivDis expects the same share of positives of
    every member. But two features that the labels fit need not hold equally often, and a member that must be positive
    on more or fewer states than its feature is a mixture. So in this objective the setting ``share`` is the smallest
    share of the range: a state that fits all features at once is rarer than a state that fits any one feature.

    Returns:
        float (), in nats, at least 0 up to rounding. The loss is 0 if there are no states.
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
