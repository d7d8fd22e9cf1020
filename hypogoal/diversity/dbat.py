"""D-BAT: diversity by disagreement (Pagliardini et al. 2022), the objective of the paper's Eq. (1)."""

import torch
from torch import Tensor


def pair_loss(
    logits_a: Tensor,
    logits_b: Tensor,
) -> Tensor:
    """Return the second term of Eq. (1), the mean of ``-log(p_a (1 - p_b) + (1 - p_a) p_b)`` over unlabelled states.

    Eq. (1) as printed multiplies the probabilities of matching classes, which literally rewards agreement. D-BAT's term
    is the log probability that two members, each drawing a class from its own p, draw different classes. The loss is
    computed from log-softmax. From probabilities, a logit gap of 20 would already give log 0 and a gradient of NaN. The
    loss is lower where the members disagree, 0 for N = 0, and symmetric in a and b.

    Args:
        logits_a: float (..., N, 2), the logits of one member on N unlabelled states; column 1 is positive.
        logits_b: float (..., N, 2), the logits of another member on the same states.

    Returns:
        The loss, float (...,), at least 0, in nats.

    Source: Eq. (1) and arXiv:2202.04414 (D-BAT).
    """
    log_a = torch.log_softmax(logits_a, dim=-1)
    log_b = torch.log_softmax(logits_b, dim=-1)
    no_a, yes_a = log_a.unbind(-1)
    no_b, yes_b = log_b.unbind(-1)
    differ = torch.logaddexp(yes_a + no_b, no_a + yes_b)
    states = max(differ.shape[-1], 1)
    return -differ.sum(dim=-1) / states
