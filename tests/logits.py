"""Logits of members, for the tests of objectives."""

import torch
from torch import Tensor

from hypogoal.diversity import Context


def context_of(members: int = 3, states: int = 7, frozen: int = 0, gap: float = 1.0) -> Context:
    """Random members on 6 labelled and ``states`` unlabelled states; ``gap`` is the deviation of their logits."""
    generator = torch.Generator().manual_seed(3)
    labelled = gap * torch.randn(members, 6, 2, generator=generator)
    unlabelled = gap * torch.randn(members + frozen, states, 2, generator=generator)
    trained = unlabelled[:members].clone()
    labels = torch.tensor([0, 1, 0, 1, 1, 0])
    return Context(labels, labelled.requires_grad_(), trained.requires_grad_(), unlabelled[members:], 0.25)


def confident(*classes: int, gap: float = 6.0) -> Tensor:
    """Logits (N, 2) of members that are sure of these classes."""
    sign = 2.0 * torch.tensor(classes, dtype=torch.float32) - 1.0
    return torch.stack([-sign * gap / 2, sign * gap / 2], dim=-1)
