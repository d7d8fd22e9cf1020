"""A control for D-BAT without pairs: unlabelled states are weak negatives."""

import torch
from torch import Tensor

from hypogoal.diversity import Context


def ensemble_loss(context: Context) -> Tensor:
    """``sum_m (K - 1) mean_n -log p_m(negative | n)``: cross entropy of unlabelled states as if all were negatives.

    Most states are negatives, so it calibrates members' probabilities without preferring any features. The weight is
    that of :mod:`hypogoal.diversity.dbat_unpaired`.

    Returns:
        float (), at least 0, in nats; 0 for no states.
    """
    logits = context.unlabelled
    negative = torch.log_softmax(logits, dim=-1)[..., 0]
    return -max(len(logits) + len(context.frozen) - 1, 1) * negative.sum() / max(logits.shape[1], 1)
