"""No diversity: members differ only by their initial weights."""

from torch import Tensor


def pair_loss(
    logits_a: Tensor,
    logits_b: Tensor,
) -> Tensor:
    """0, but a function of both members, so that it can be differentiated like the others.

    Takes two members' logits (..., N, 2) on N unlabelled states; returns float (...,), 0 with gradients of 0.
    """
    differences = logits_a - logits_b
    return (differences * 0.0).sum(dim=(-2, -1))
