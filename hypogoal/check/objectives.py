"""The five laws of a diversity objective (Spec C1, C2; see ``hypogoal.diversity``)."""

from collections.abc import Iterator
from dataclasses import replace

import torch
from torch import Tensor

from hypogoal.check.verdict import Verdict, promise, verdicts
from hypogoal.diversity import Context, Objective
from hypogoal.hypotheses.fit import disagreement_of

SIZES = ((1, 7, 0), (3, 7, 0), (2, 7, 2), (3, 0, 0))  # members, unlabelled states, frozen members
EXTREME = (20.0, 100.0, 1e4)  # logits so far apart: from 17, a float32 probability is exactly 0 or 1
SURE = 10.0
LEAST_GRADIENT = 1e-6
LOG_SPACE = "Compute from log_softmax (logsumexp, logaddexp), not from probabilities."


def check_objective(objective: Objective) -> Iterator[Verdict]:
    """Whether a diversity objective, see :func:`hypogoal.diversity.load_objective`, obeys the laws of training."""
    laws = [shape, order, extreme_logits, gradients]
    if objective.pair_loss:
        laws.append(disagreement)
    return verdicts(laws, objective)


def shape(objective: Objective) -> str:
    """One number for each pair, or for all members; also without states."""
    for members, states, frozen in SIZES:
        loss = disagreement_of(objective, context_of(members, states, frozen))
        text = f"{members} members, {frozen} frozen members and {states} states give {loss.item()}"
        promise(bool(loss.isfinite()), text, "Give one finite number, a tensor (); divide by max(N, 1).")
    return "one number for 1 to 3 members, with frozen members, without states"


def order(objective: Objective) -> str:
    context = context_of()
    labelled, unlabelled = context.labelled.flip(0), context.unlabelled.flip(0, 1)
    turned = replace(context, labelled=labelled, unlabelled=unlabelled)
    loss, other = disagreement_of(objective, context), disagreement_of(objective, turned)
    text = "the loss changes when members, and states, change places"
    promise(torch.allclose(loss, other), text, "Make it symmetric, for example by means.")
    return "members and states may change places"


def extreme_logits(objective: Objective) -> str:
    for gap in EXTREME:
        loss, gradient = _derived(objective, context_of(gap=gap))
        text = f"at logits {gap:g} apart the loss is {loss.item():.4g}, or its gradient not finite"
        promise(bool(loss.isfinite() & gradient.isfinite().all()), text, LOG_SPACE)
    return f"finite up to logits {EXTREME[-1]:g} apart"


def gradients(objective: Objective) -> str:
    _, gradient = _derived(objective, context_of())
    of_members = gradient.abs().amax(dim=(1, 2))
    least = of_members.min().item()
    text = f"a member gets a gradient of {least:.1g}"
    promise(least >= LEAST_GRADIENT, text, f"Do not detach it. {LOG_SPACE}")
    return f"at least {least:.2g} for each member"


def disagreement(objective: Objective) -> str:
    """Of a pair: Eq. (1) as printed rewards agreement (the trap of Spec C2), and sure members must come apart."""
    assert objective.pair_loss
    member = confident(1, 1, 0, 0).requires_grad_()
    agreeing = objective.pair_loss(member, member.detach())
    differing = objective.pair_loss(member, confident(1, 0, 1, 0))
    text = f"{agreeing:.4g} where two members agree, {differing:.4g} where they differ on half of the states"
    lower = bool(differing < agreeing)
    promise(lower, text, "The loss must be lower where they differ: has a sign been lost?")
    (gradient,) = torch.autograd.grad(agreeing, member)
    largest = gradient.abs().max().item()
    fault = f"sure members that agree get a gradient of {largest:.1g}"
    promise(largest >= LEAST_GRADIENT, fault, LOG_SPACE)
    return text


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
    """The loss, and its gradient by all logits, (K, B + N, 2)."""
    loss = disagreement_of(objective, context)
    logits = (context.labelled, context.unlabelled)
    parts = torch.autograd.grad(loss, logits, allow_unused=True, materialize_grads=True)
    return loss, torch.cat(parts, dim=1)
