"""A control for D-BAT that pairs no members: unlabelled states are weak negatives."""

import torch
from torch import Tensor

from hypogoal.diversity import Context


def ensemble_loss(context: Context) -> Tensor:
    """``sum_m (K - 1) mean_n -log p_m(no | n)``: cross entropy of unlabelled states as if all of them were negatives.

    Most states are no sub-goal, so it moves members' thresholds to where they belong without a word on which features
    to use. The weight K - 1 is that of :mod:`hypogoal.diversity.dbat_unpaired`; one member alone has 1.

    Returns:
        float (), at least 0, in nats; 0 for no states.
    """
    logits = context.unlabelled
    no = torch.log_softmax(logits, dim=-1)[..., 0]
    return -max(len(logits) + len(context.frozen) - 1, 1) * no.sum() / max(logits.shape[1], 1)
