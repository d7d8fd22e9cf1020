"""No diversity: members differ only by their initial weights."""

from torch import Tensor


def pair_loss(logits_a: Tensor, logits_b: Tensor) -> Tensor:
    """Spec C1: 0, but a function of both members, so that it can be differentiated like the others.

    Takes two members' logits (..., N, 2) on N unlabelled states; returns float (...,), 0 with gradients of 0.
    """
    sums = logits_a.sum(dim=(-2, -1)) + logits_b.sum(dim=(-2, -1))
    return sums.nan_to_num(0.0, 0.0, 0.0) * 0.0
