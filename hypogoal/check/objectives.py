"""The laws of a diversity objective (Spec C1, C2; see ``hypogoal.diversity``)."""

from collections.abc import Iterator
from dataclasses import replace

import torch
from torch import Tensor

from hypogoal.check.verdict import Verdict, promise, verdicts
from hypogoal.diversity import Context, Objective, load_objective
from hypogoal.hypotheses.fit import disagreement_of

CASES = (  # members, unlabelled states, frozen members, and how far apart logits are
    (1, 7, 0, 1.0),
    (3, 7, 0, 1.0),
    (2, 7, 2, 1.0),
    (3, 0, 0, 1.0),
    (3, 7, 0, 20.0),  # from 17, a float32 probability is exactly 0 or 1
    (3, 7, 0, 100.0),
    (3, 7, 0, 1e4),
)
SURE = 10.0
LEAST_GRADIENT = 1e-6
LOG_SPACE = "Compute from log_softmax (logsumexp, logaddexp), not from probabilities."


def check_objective(objective: Objective | str) -> Iterator[Verdict]:
    """Whether a diversity objective, or that of a name, obeys the laws of training."""
    if isinstance(objective, str):
        objective = load_objective(objective)
    laws = [finite, order, gradients]
    if objective.pair_loss:
        laws.append(disagreement)
    return verdicts(laws, objective)


def finite(objective: Objective) -> None:
    """One number for each pair, or for all members; also without states, and where probabilities are 0 or 1."""
    for case in CASES:
        loss, gradient = _derived(objective, context_of(*case))
        members, states, frozen, gap = case
        text = f"{members} members, {frozen} frozen ones, {states} states, logits {gap:g} apart: {loss.item():.4g}"
        kept = loss.isfinite() & gradient.isfinite().all()
        promise(
            kept,
            f"{text}, or a gradient that is not finite",
            f"Divide by max(N, 1). {LOG_SPACE}",
        )


def order(objective: Objective) -> None:
    """Members, and states, may change places."""
    context = context_of()
    labelled, unlabelled = context.labelled.flip(0), context.unlabelled.flip(0, 1)
    turned = replace(context, labelled=labelled, unlabelled=unlabelled)
    loss, other = disagreement_of(objective, context), disagreement_of(objective, turned)
    text = "the loss changes when members, and states, change places"
    promise(
        torch.allclose(loss, other),
        text,
        "Make it symmetric, for example by means.",
    )


def gradients(objective: Objective) -> None:
    """Every member gets one."""
    _, gradient = _derived(objective, context_of())
    least = gradient.abs().amax(dim=(1, 2)).min()
    promise(
        least >= LEAST_GRADIENT,
        f"a member gets a gradient of {least:.1g}",
        f"Do not detach it. {LOG_SPACE}",
    )


def disagreement(objective: Objective) -> None:
    """A pair that differs loses less, and sure members that agree come apart; Eq. (1) as printed rewards agreement."""
    assert objective.pair_loss
    member = confident(1, 1, 0, 0).requires_grad_()
    agreeing = objective.pair_loss(member, member.detach())
    differing = objective.pair_loss(member, confident(1, 0, 1, 0))
    text = f"{agreeing:.4g} where two members agree, {differing:.4g} where they differ on half of the states"
    promise(
        differing < agreeing,
        text,
        "The loss must be lower where they differ: has a sign been lost?",
    )
    (gradient,) = torch.autograd.grad(agreeing, member)
    largest = gradient.abs().max()
    promise(
        largest >= LEAST_GRADIENT,
        f"sure members that agree get a gradient of {largest:.1g}",
        LOG_SPACE,
    )


def confident(*classes: int, gap: float = SURE) -> Tensor:
    """Logits (N, 2) of a member that is sure of these classes."""
    positive = gap * (torch.tensor(classes) - 0.5)
    return torch.stack([-positive, positive], dim=-1)


def context_of(members: int = 3, states: int = 7, frozen: int = 0, gap: float = 1.0) -> Context:
    """Random members on 6 labelled and ``states`` unlabelled states; ``gap`` is the deviation of their logits."""
    generator = torch.Generator().manual_seed(3)
    labelled = gap * torch.randn(members, 6, 2, generator=generator)
    unlabelled = gap * torch.randn(members + frozen, states, 2, generator=generator)
    trained = unlabelled[:members].clone()
    labels = torch.tensor([0, 1, 0, 1, 1, 0])
    return Context(labels, labelled.requires_grad_(), trained.requires_grad_(), unlabelled[members:], 0.25)


def _derived(objective: Objective, context: Context) -> tuple[Tensor, Tensor]:
    """The loss, and its gradient by all logits, (K, B + N, 2); 0 by those that it does not depend on."""
    logits = (context.labelled, context.unlabelled)
    loss = disagreement_of(objective, context) + 0 * sum(part.sum() for part in logits)
    return loss, torch.cat(torch.autograd.grad(loss, logits), dim=1)
