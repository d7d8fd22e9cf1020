"""A control for D-BAT without pairs of different members: each member is paired with itself."""

from torch import Tensor

from hypogoal.diversity import Context
from hypogoal.diversity.dbat import pair_loss


def ensemble_loss(context: Context) -> Tensor:
    """Return ``sum_m (K - 1) l(m, m)``, where ``l`` is D-BAT's pair loss.

    In Eq. (1), that replaces each l(a, b) by half of l(a, a) + l(b, b). The loss is lowest if every member is undecided
    (p = 1/2) on every unlabelled state. So the loss rewards no difference between members, and what D-BAT gains over
    this control comes from pairing. A single member has a weight of 1.

    Returns:
        float (), at least 0, in nats. The loss is 0 if there are no states.
    """
    logits = context.unlabelled
    members = len(logits) + len(context.frozen)
    with_itself = pair_loss(logits, logits)
    return max(members - 1, 1) * with_itself.sum()
