"""Eq. (1): members agree with the labels of labelled states, and disagree with each other on unlabelled states.

The words of the loop:

- A *member* h_i is one of the K networks in training. Its logits (negative, positive) of a state give
  p_i = softmax(logits)[positive], the member's probability that the sub-goal holds in the state.
- A *batch*, which all members share, has B labelled states x with classes y, half of them positive, and B unlabelled
  states u. Positives, negatives and unlabelled states are each drawn in shuffled passes. The labelled and the
  unlabelled half pass the members together. BatchNorm standardises each half by the mean and variance of that half
  (``batches.plain_forward``).
- The *labelled loss* of a member is CE_i = sum_b w[y_b] (-log p_i(y_b | x_b)) / sum_b w[y_b], with p_i(1 | x) = p_i and
  p_i(0 | x) = 1 - p_i. The class weights w are 0.5 and 0.5 on DoorKey (Table 3), where the labelled loss is the plain
  mean. On Montezuma the weights are 0.8 for y = 0 and 0.2 for y = 1 (Table 1).
- The *disagreement* of two members is d(h_i, h_m). For D-BAT, d is the mean over the u of
  -log(p_i (1 - p_m) + (1 - p_i) p_m), which is low where the two members differ.
- The *weight* is alpha, the setting ``diversity_weight``: 1e-4 on DoorKey, 3e-4 on Montezuma.
- A *frozen* member f was trained before the members in training (``schedule=sequential``). A frozen member gets no
  gradient.
- A *step* is a batch, its loss, and one update of all members by Adam. Adam adds ``l2_weight`` times each weight to the
  gradient of that weight.

Eq. (1) is computed as a sum over members, not a mean::

    loss = sum_i CE_i + alpha ( sum_i sum_{m != i} d(h_i, h_m) + sum_i sum_f d(f, h_i) )

The double sum has each pair twice, and the gradient of a pair reaches both members of the pair. The case i = m is left
out, because disagreement with itself would push a member to p = 1/2. An objective of the whole ensemble replaces the
whole bracket. The bracket is 0 if alpha is 0, if the objective is ``none``, or if an objective of pairs meets a single
member.

Beyond the paper, a *teacher* with scores s of unlabelled states adds
sum_i mean_u min(|s_i(u)|, 1) (-log p_i(s_i(u) > 0 | u)) to the loss, without a weight of its own.
"""

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from itertools import combinations, product

import torch
from torch import Tensor, nn
from torch.nn.functional import cross_entropy

from hypogoal.core.adam import Adam
from hypogoal.core.arrays import tensor
from hypogoal.diversity import Context, Objective, load_objective
from hypogoal.hypotheses.batches import Numbers, TrainingStates
from hypogoal.hypotheses.config import LABELS, EnsembleConfig


@dataclass(frozen=True)
class Losses:
    """The losses of one step, and the logits from which they were computed. All tensors are detached."""

    labelled: Tensor  # (K,), each member's loss on labelled states
    disagreement: Tensor  # (), before multiplication with its weight
    taught: Tensor | None  # (K,), each member's loss on a teacher's scores
    loss: Tensor  # (), the weighted sum
    classes: Tensor  # (B,), the classes of the labelled states
    on_labelled: Tensor  # (K, B, 2), logits of labelled states
    on_unlabelled: Tensor  # (K, N, 2), logits of unlabelled states, where N may be 0

    def numbers(self) -> dict[str, float]:
        """Return numbers for a log, by name.

        The numbers are the losses, the members' mean accuracy on labelled states, and the share of unlabelled states on
        which members differ.
        """
        numbers = {
            "loss": self.loss.item(),
            "labelled": self.labelled.mean().item(),
            "diversity": self.disagreement.item(),
            "accuracy": (self.on_labelled.argmax(2) == self.classes).float().mean().item(),
        }
        if self.taught is not None:
            numbers["teacher"] = self.taught.mean().item()
        positive = self.on_unlabelled.argmax(2).bool()
        if len(positive) > 1 and positive.numel():
            differ = positive.any(0) & ~positive.all(0)
            numbers["disagreement"] = differ.float().mean().item()
        return numbers


def fit(
    members: Sequence[nn.Sequential],
    frozen: Sequence[nn.Sequential],
    states: TrainingStates,
    batches: Iterable[tuple[Numbers, Numbers]],
    optimiser: Adam,
    config: EnsembleConfig,
    taught: Tensor | None = None,
) -> Iterator[Losses]:
    """Train members by Eq. (1), one step for each batch, and yield the losses after each step.

    Args:
        members: the members in training, in training mode.
        frozen: the members that were trained earlier.
        states: the states, with their classes.
        batches: for each step, the indices of the labelled states (B,) and of the unlabelled states (N,).
        optimiser: the optimiser of the members' weights.
        config: the settings. Used are the diversity objective with its weight and share, the class weights and
            ``unlabelled_bn``.
        taught: a teacher's scores of all unlabelled states, float (K, M).
    """
    objective = objective_of(config)
    class_weights = torch.tensor([config.class_weight_negative, config.class_weight_positive], device=states.device)
    frozen_logits = states.frozen_logits(frozen if objective else [])  # (F, M, 2)
    positives = config.share if config.share != LABELS else float(states.labels.mean())
    compared = objective is not None or taught is not None
    for labelled, unlabelled in batches:
        classes = states.targets(labelled)
        if compared:
            on_labelled, on_unlabelled = states.logits(members, labelled, unlabelled, counted=config.unlabelled_bn)
        else:
            on_labelled, on_unlabelled = states.logits(members, labelled)  # (K, B, 2) and (K, 0, 2)
            if config.unlabelled_bn and len(unlabelled):
                with torch.no_grad():
                    states.logits(members, unlabelled=unlabelled)  # for BatchNorm's running statistics
        numbers = tensor(unlabelled, states.device)
        context = Context(classes, on_labelled, on_unlabelled, frozen_logits[:, numbers], positives)

        labelled_losses = torch.stack([cross_entropy(logits, classes, class_weights) for logits in on_labelled])
        disagreement = disagreement_of(objective, context)
        loss = labelled_losses.sum() + config.diversity_weight * disagreement  # Eq. (1)
        of_teacher = None
        if taught is not None:
            of_teacher = taught_losses(on_unlabelled, taught[:, numbers])
            loss = loss + of_teacher.sum()

        optimiser.zero_grad()
        loss.backward()
        optimiser.step()
        yield Losses(
            labelled_losses.detach(),
            disagreement.detach(),
            None if of_teacher is None else of_teacher.detach(),
            loss.detach(),
            classes,
            on_labelled.detach(),
            on_unlabelled.detach(),
        )


def objective_of(config: EnsembleConfig) -> Objective | None:
    """Return the diversity objective, or None if it has no effect.

    The objective has no effect if its weight is 0, if it is ``none``, or if it compares pairs and there is a single
    member.
    """
    objective = load_objective(config.diversity)
    if config.diversity_weight > 0 and objective.acts(config.members):
        return objective
    return None


def disagreement_of(objective: Objective | None, context: Context) -> Tensor:
    """Return the bracket of Eq. (1), float ().

    The bracket is the double sum over pairs of members, or what an objective of the whole ensemble gives. The bracket
    is 0 if ``objective`` is None or if there is no pair.
    """
    members = context.unlabelled
    if objective is None:
        return members.new_zeros(())
    if objective.ensemble_loss is not None:
        return objective.ensemble_loss(context)
    assert objective.pair_loss is not None
    losses = [2.0 * objective.pair_loss(first, second) for first, second in combinations(members, 2)]
    losses += [objective.pair_loss(earlier, member) for member, earlier in product(members, context.frozen)]
    if not losses:
        return members.new_zeros(())
    return torch.stack(losses).sum(0)  # over pairs only, so a pair_loss that gives several numbers fails in backward()


def taught_losses(logits: Tensor, scores: Tensor) -> Tensor:
    """Return each member's loss on a teacher's scores, float (K,), from logits (K, N, 2) and scores (K, N).

    A member should predict positive where its score is above 0. A score of 1 or more, on either side of 0, weighs as
    much as a label. A smaller score weighs in proportion.
    """
    errors = cross_entropy(logits.mT, (scores > 0).long(), reduction="none")
    weights = scores.abs().clamp(max=1.0)
    return (errors * weights).mean(1)
