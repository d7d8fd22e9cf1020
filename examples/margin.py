"""A diversity objective of one's own: see docs/own-domain.md. Check it: hypogoal check --diversity margin:pair_loss"""

from torch import Tensor
from torch.nn.functional import softplus


def pair_loss(logits_a: Tensor, logits_b: Tensor) -> Tensor:
    """The softened product of two members' margins: lower where their signs differ. (..., N, 2) twice -> (...,)."""
    margin_a, margin_b = (logits[..., 1] - logits[..., 0] for logits in (logits_a, logits_b))
    return softplus(margin_a * margin_b).sum(dim=-1) / max(margin_a.shape[-1], 1)
