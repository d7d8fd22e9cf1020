"""The laws of a diversity objective (see ``hypogoal.diversity``)."""

from collections.abc import Iterator

import torch
from torch import Tensor

from hypogoal.check.verdict import Verdict, promise, verdicts
from hypogoal.diversity import Context, Objective, load_objective
from hypogoal.hypotheses.fit import disagreement_of

CASE = "members, unlabelled states, frozen members, how far apart logits are"
CASES = (
    (1, 7, 0, 1.0),
    (2, 7, 2, 1.0),
    (3, 0, 0, 1.0),
    (3, 7, 0, 20.0),  # from 17, a float32 probability is exactly 0 or 1
    (3, 7, 0, 1e4),
)
LEAST_GRADIENT = 1e-6
LOG_SPACE = "Compute from log_softmax (logsumexp, logaddexp), not from probabilities."


def check_objective(objective: Objective | str) -> Iterator[Verdict]:
    """Check whether a diversity objective, given itself or by its name, obeys the laws of training."""
    if isinstance(objective, str):
        objective = load_objective(objective)
    laws = [finite, gradients]
    if objective.pair_loss:
        laws.append(disagreement)
    return verdicts(laws, objective)


def finite(objective: Objective) -> None:
    """The loss and its gradient are finite, also without states, and where probabilities are 0 or 1."""
    for case in CASES:
        loss, gradient = _derived(objective, *case)
        fault = f"{loss.item():.4g}, or a gradient that is not finite, with {case}: {CASE}"
        is_finite = loss.isfinite() & gradient.isfinite().all()
        promise(is_finite, fault, f"Divide by max(N, 1). {LOG_SPACE}")


def gradients(objective: Objective) -> None:
    """Every member gets a gradient, from the other members or from members that were trained before."""
    least = 0.0
    for frozen in (0, 2) if objective.ensemble_loss else (0,):
        _, gradient = _derived(objective, 3, 7, frozen, 1.0)
        least = max(least, gradient.abs().amax(dim=(1, 2)).min().item())
    fault = f"a member gets a gradient of {least:.1g}"
    promise(
        least >= LEAST_GRADIENT,
        fault,
        f"Use all members, none detached. {LOG_SPACE}",
    )


def disagreement(objective: Objective) -> None:
    """A pair that differs loses less than a pair that agrees, although Eq. (1) as printed rewards agreement."""
    assert objective.pair_loss
    sure = torch.tensor([[-5.0, 5.0], [5.0, -5.0]])  # logits of a member that is sure of one class, and of the other
    member = sure[[0, 0, 1, 1]]
    agreeing = objective.pair_loss(member, member)
    differing = objective.pair_loss(member, sure[[0, 1, 0, 1]])
    fault = f"{agreeing:.4g} where two members agree, {differing:.4g} where they differ on half of the states"
    promise(
        differing < agreeing,
        fault,
        "The loss must be lower where they differ: has a sign been lost?",
    )


def _derived(objective: Objective, members: int, states: int, frozen: int, gap: float) -> tuple[Tensor, Tensor]:
    """Return the loss of random members, and its gradient by their logits, (K, 6 + N, 2).

    There are 6 labelled and N = ``states`` unlabelled states. ``gap`` is the deviation of logits. The gradient is 0 by
    logits that the loss does not depend on.
    """
    generator = torch.Generator().manual_seed(3)
    logits = gap * torch.randn(members + frozen, 6 + states, 2, generator=generator)
    trained = logits[:members].requires_grad_()
    labelled, unlabelled = trained.split([6, states], dim=1)
    labels = torch.tensor([0, 1, 0, 1, 1, 0])
    context = Context(labels, labelled, unlabelled, logits[members:, 6:], 0.25)
    loss = disagreement_of(objective, context)
    [gradient] = torch.autograd.grad(loss + 0 * trained.sum(), trained)
    return loss, gradient
