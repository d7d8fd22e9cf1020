"""A control for D-BAT without pairs: each member is paired with itself."""

from torch import Tensor

from hypogoal.diversity import Context
from hypogoal.diversity.dbat import pair_loss


def ensemble_loss(context: Context) -> Tensor:
    """``sum_m (K - 1) l(m, m)`` with D-BAT's pair loss ``l``: in Eq. (1), half of l(a, a) + l(b, b) for each l(a, b).

    It is lowest if every member is undecided (p = 1/2) on every unlabelled state, so it rewards no difference between
    members. What D-BAT gains over it comes from pairing. A single member has a weight of 1.

    Returns:
        float (), at least 0, in nats; 0 for no states.
    """
    logits = context.unlabelled
    members = len(logits) + len(context.frozen)
    with_itself = pair_loss(logits, logits)
    return max(members - 1, 1) * with_itself.sum()
