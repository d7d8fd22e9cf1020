"""The laws of a diversity objective, as tests for its author (Spec C1, C2; see ``hypogoal.diversity``)."""

from collections.abc import Iterator
from dataclasses import replace
from functools import partial
from typing import Any

import torch
from torch import Tensor

from hypogoal.diversity import Context, Objective
from hypogoal.testing.verdict import Verdict, promise, run

EXTREME = (20.0, 100.0, 1e4)  # logit gaps: from 17, a float32 probability is exactly 0 or 1
SURE, AGREED = 10.0, ((1, 0), (1, 1), (0, 0))  # logit gap and classes of members that agree
LEAST_GRADIENT = 1e-6
LOG_SPACE = "Compute from log_softmax"


def check_objective(objective: Objective) -> Iterator[Verdict]:
    """Whether a diversity objective, see :func:`hypogoal.diversity.load_objective`, obeys the laws of training."""
    laws = [shape_of_pairs if objective.pair_loss else shape, empty_sets, order_does_not_matter]
    laws += [disagreement_lowers_it] if objective.pair_loss else []
    laws += [finite_at_extreme_logits, gradient_does_not_vanish]
    return run((law.__name__.removesuffix("_of_pairs").replace("_", " "), partial(law, objective)) for law in laws)


def confident(*classes: int, gap: float = 6.0) -> Tensor:
    """Logits (N, 2) of a member that is confident of these classes."""
    sign = 2.0 * torch.tensor(classes, dtype=torch.float32) - 1.0
    return torch.stack([-sign * gap / 2, sign * gap / 2], dim=-1)


def shape_of_pairs(objective: Objective) -> str:
    """Leading axes are a batch."""
    objective.losses(context_of())
    assert objective.pair_loss
    a, b = torch.randn(2, 5, 7, 2, generator=torch.Generator().manual_seed(3), dtype=torch.float64)
    loss = objective.pair_loss(a, b)
    text = f"logits (5, 7, 2) give a loss {tuple(loss.shape)}"
    promise(loss.shape == (5,), text, "Give (5,): a mean over the states, axis -2.")
    alone = torch.allclose(loss[2], objective.pair_loss(a[2], b[2]))
    promise(alone, "a pair's loss depends on the others in the batch", "Treat leading axes one by one.")
    return "(..., N, 2) gives (...,)"


def shape(objective: Objective) -> str:
    """One number, for any number of members in training and frozen ones."""
    for members, frozen in ((1, 0), (2, 0), (3, 0), (1, 2), (2, 1)):
        (loss,) = objective.losses(context_of(members, frozen=frozen))
        text = f"{members} members and {frozen} frozen ones give {loss.tolist()}"
        promise(loss.shape == () and bool(loss.isfinite()), text, "Give one finite number, a tensor ().")
    return "one number for 1 to 3 members, frozen ones among them"


def disagreement_lowers_it(objective: Objective) -> str:
    """The trap of Spec C2: Eq. (1) as printed rewards agreement."""
    assert objective.pair_loss
    member = confident(1, 1, 0, 0)
    agreeing, half = (float(objective.pair_loss(member, other)) for other in (member, confident(1, 0, 1, 0)))
    text = f"members that agree everywhere have {agreeing:.4g}, members that differ on half of the states {half:.4g}"
    promise(half < agreeing, text, "The loss must be lower where they differ: has a sign been lost?")
    return f"{agreeing:.4g} agreeing, {half:.4g} differing on half of the states"


def context_of(
    members: int = 3, states: int = 7, frozen: int = 0, *, gap: float = 1.0, dtype: Any = torch.float64
) -> Context:
    """A differentiable batch of random members: 6 labelled and ``states`` unlabelled states.

    ``gap`` is the standard deviation of the logits; members agree on half of the unlabelled states.
    """
    generator = torch.Generator().manual_seed(3)

    def normal(*size: int) -> Tensor:
        return torch.randn(*size, generator=generator, dtype=dtype)

    unlabelled = gap * normal(members + frozen, states, 2)
    unlabelled[1:, : states // 2] = unlabelled[:1, : states // 2]
    return Context(
        torch.tensor([0, 1, 0, 1, 1, 0]),
        (gap * normal(members, 6, 2)).requires_grad_(),
        unlabelled[:members].clone().requires_grad_(),
        unlabelled[members:],
        0.25,
    )


def rearranged(context: Context, members: Tensor, states: Tensor) -> Context:
    """The batch with its members and its unlabelled states in another order."""
    return replace(
        context,
        labelled=context.labelled[members],
        unlabelled=context.unlabelled[members][:, states],
        frozen=context.frozen[:, states],
    )


def empty_sets(objective: Objective) -> str:
    """No unlabelled states."""
    context = context_of(states=0)
    loss = objective.losses(context).sum()
    _differentiate(loss, context)
    fits = loss == 0 if objective.pair_loss else loss.isfinite()
    promise(bool(fits), f"no unlabelled states give {loss.item()}", "Divide by max(N, 1).")
    return f"no unlabelled states give {loss.item():.3g}"


def order_does_not_matter(objective: Objective) -> str:
    """Of the members, and of the states."""
    context = context_of()
    loss = objective.losses(context).sum()
    same = torch.allclose(loss, objective.losses(rearranged(context, torch.tensor([2, 0, 1]), torch.arange(7))).sum())
    promise(same, "the loss changes when the members change places", "Make it symmetric, for example by a mean.")
    other = rearranged(context, torch.arange(3), torch.tensor([3, 6, 0, 5, 1, 2, 4]))
    same = torch.allclose(loss, objective.losses(other).sum())
    promise(same, "the loss depends on the order of the states", "Use a mean over states.")
    return "members and states are interchangeable"


def finite_at_extreme_logits(objective: Objective) -> str:
    """Probabilities that round to exactly 0 and 1."""
    for gap in EXTREME:
        context = context_of(gap=gap, dtype=torch.float32)
        loss = objective.losses(context).sum()
        finite = all(bool(number.isfinite().all()) for number in (loss, *_differentiate(loss, context)))
        text = f"at logits {gap:g} apart the loss is {loss.item():.4g}, or its gradient not finite"
        promise(finite, text, f"{LOG_SPACE} (logsumexp, logaddexp), not from probabilities.")
    return f"logits up to {EXTREME[-1]:g} apart"


def gradient_does_not_vanish(objective: Objective) -> str:
    """Each of three members gets a gradient.

    Of a pair, confident members that agree must also be pushed apart. An objective that compares members across states,
    such as mutual information, has no gradient if each predicts one class for all states, so one of three cases
    suffices.
    """
    context = context_of()
    gradients = _differentiate(objective.losses(context).sum(), context)
    largest = [max(float(by_member[member].abs().max()) for by_member in gradients) for member in range(3)]
    text = f"member {largest.index(min(largest))} gets a gradient of {min(largest):.1g}"
    promise(min(largest) >= LEAST_GRADIENT, text, "Do not detach it, and compute from log_softmax.")
    if objective.pair_loss:
        agreed = [torch.stack([confident(*classes, gap=SURE)] * 2).requires_grad_() for classes in AGREED]
        sure = max(float(torch.autograd.grad(objective.pair_loss(*pair), pair)[0].abs().max()) for pair in agreed)
        text = f"members that agree with logits {SURE:g} apart get a gradient of {sure:.1g}"
        promise(sure >= LEAST_GRADIENT, text, f"{LOG_SPACE}: from probabilities nothing of it is left.")
    return f"at least {min(largest):.2g} for each member"


def _differentiate(loss: Tensor, context: Context) -> list[Tensor]:
    """Gradients by all parts of a context, 0 for those that the loss does not depend on."""
    leaves = [context.labelled, context.unlabelled]
    if not loss.requires_grad:
        return [torch.zeros_like(leaf) for leaf in leaves]
    return list(torch.autograd.grad(loss, leaves, allow_unused=True, materialize_grads=True))
