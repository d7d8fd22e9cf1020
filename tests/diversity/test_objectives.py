"""Diversity objectives against values worked by hand, and the laws each of them must keep (Spec C1, C2)."""

import math
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import torch
from torch import Tensor

from hypogoal.core.errors import UserError
from hypogoal.diversity import ENTRY_POINTS, Context, Objective, load_objective
from hypogoal.hypotheses.fit import disagreement_of
from tests.logits import confident, context_of

PAIRED = ("dbat", "mutual-information", "none")
DIVERSE = [name for name in PAIRED if name != "none"]
EXTREME = (20.0, 100.0, 1e4)


def pair_loss_of(name: str) -> Callable[[Tensor, Tensor], Tensor]:
    """The pair loss of an objective that has one."""
    pair_loss = load_objective(name).pair_loss
    assert pair_loss is not None
    return pair_loss


def ensemble_loss(name: str, context: Context) -> float:
    """The loss of an objective of the whole ensemble."""
    loss = load_objective(name).ensemble_loss
    assert loss is not None
    return loss(context).item()


def logits_of(*probabilities: float) -> Tensor:
    """Logits (N, 2) of members that say "reached" with these probabilities."""
    p = torch.tensor(probabilities, dtype=torch.float64)
    return torch.stack([torch.log1p(-p), torch.log(p)], dim=-1)


@pytest.mark.parametrize("name", DIVERSE)
def test_descending_the_loss_makes_agreeing_members_disagree(name: str) -> None:
    """Spec C2: not only the value, its gradient too pushes members apart."""
    pair_loss = pair_loss_of(name)
    fixed = confident(1, 1, 0, 0, gap=2.0)
    moved = (fixed + 0.05 * torch.tensor([[0.0, 0.3], [0.0, -0.3], [0.2, 0.0], [-0.2, 0.0]])).requires_grad_()
    optimiser = torch.optim.SGD([moved], lr=1.0)
    for _ in range(400):
        optimiser.zero_grad()
        pair_loss(fixed, moved).backward()
        optimiser.step()
    p, q = fixed.softmax(-1)[:, 1], moved.detach().softmax(-1)[:, 1]
    before = (2 * p * (1 - p)).mean()
    after = (p * (1 - q) + (1 - p) * q).mean()
    assert after > before + 0.1


def test_dbat_by_hand() -> None:
    """Eq. (1), Spec C2: -log(.9 x .8 + .1 x .2) = -log .74; mean with -log(.5) on a second state."""
    loss = pair_loss_of("dbat")(logits_of(0.9, 0.5), logits_of(0.2, 0.7))
    assert loss.item() == pytest.approx((-math.log(0.74) - math.log(0.5)) / 2)


def test_mutual_information_by_hand() -> None:
    """Spec C1: two states, p_a = (.9, .1), p_b = (.8, .2): joint [[.37, .13], [.13, .37]], marginals .5."""
    joint = [(0.9 * 0.8 + 0.1 * 0.2) / 2, (0.9 * 0.2 + 0.1 * 0.8) / 2]
    expected = 2 * sum(j * math.log(j / 0.25) for j in joint)
    loss = pair_loss_of("mutual-information")(logits_of(0.9, 0.1), logits_of(0.8, 0.2))
    assert loss.item() == pytest.approx(expected)


def test_mutual_information_at_its_ends() -> None:
    """Spec C1: log 2 for members that always agree or always contradict, 0 for independent or constant."""
    pair_loss = pair_loss_of("mutual-information")
    member = confident(1, 1, 0, 0, gap=200.0)
    for other, expected in (
        (confident(1, 1, 0, 0, gap=200.0), math.log(2)),
        (confident(0, 0, 1, 1, gap=200.0), math.log(2)),
        (confident(1, 0, 1, 0, gap=200.0), 0.0),
        (confident(1, 1, 1, 1, gap=200.0), 0.0),
    ):
        assert pair_loss(member, other).item() == pytest.approx(expected, abs=1e-6)


@pytest.mark.parametrize("gap", EXTREME)
def test_dbat_pushes_sure_members_apart_however_sure_they_are(gap: float) -> None:
    """Spec C2: no log 0, no vanished gradient. Members that agree with gap g have a loss of g - log 2."""
    a, b = confident(1, 0, gap=gap).requires_grad_(), confident(1, 0, gap=gap).requires_grad_()
    loss = pair_loss_of("dbat")(a, b)
    loss.backward()
    assert loss.item() == pytest.approx(gap - math.log(2), rel=1e-5)
    assert a.grad is not None
    torch.testing.assert_close(a.grad, torch.tensor([[-0.25, 0.25], [0.25, -0.25]]))
    torch.testing.assert_close(a.grad, b.grad)


@pytest.mark.parametrize("name", PAIRED)
@pytest.mark.parametrize("shape", [(0, 2), (3, 0, 2), (0, 5, 2)])
def test_empty_sets_give_zero(name: str, shape: tuple[int, ...]) -> None:
    """Spec C2: no unlabelled states, or no pairs (K = 1), is a loss of 0 or of no entries, never NaN."""
    a, b = torch.zeros(shape, requires_grad=True), torch.zeros(shape, requires_grad=True)
    loss = pair_loss_of(name)(a, b)
    loss.sum().backward()
    assert loss.shape == shape[:-2]
    assert (loss == 0).all()


def batch(*members: Tensor, frozen: Tensor | None = None, **changes: Any) -> Context:
    """A context of members' logits (N, 2) on unlabelled states; what else it has is random."""
    unlabelled = torch.stack(members)
    context = context_of(len(members), unlabelled.shape[1])
    none = unlabelled.new_zeros(0, *unlabelled.shape[1:])
    return replace(context, unlabelled=unlabelled, frozen=none if frozen is None else frozen, **changes)


def test_dbat_unpaired_by_hand() -> None:
    """Each member with itself, K - 1 times: -log 2 p (1 - p), mean over states."""
    one, other = logits_of(0.9, 0.5), logits_of(0.2, 0.7)
    expected = -(math.log(0.18) + math.log(0.5) + math.log(0.32) + math.log(0.42)) / 2
    assert ensemble_loss("dbat-unpaired", batch(one, other)) == pytest.approx(expected)
    assert ensemble_loss("dbat-unpaired", batch(one, other, other)) == pytest.approx(
        2 * (expected - (math.log(0.32) + math.log(0.42)) / 2)
    )
    alone = -(math.log(0.18) + math.log(0.5)) / 2
    assert ensemble_loss("dbat-unpaired", batch(one)) == pytest.approx(alone)
    assert ensemble_loss("dbat-unpaired", batch(one, frozen=other[None])) == pytest.approx(alone)


def test_dbat_unpaired_weighs_as_dbat_does() -> None:
    """Between members that are all the same it is D-BAT's sum, and so is its gradient."""
    for name in ("dbat-unpaired", "dbat"):
        logits = logits_of(0.9, 0.4, 0.2).expand(4, 3, 2).clone().requires_grad_()
        loss = disagreement_of(load_objective(name), replace(context_of(4, 3), unlabelled=logits))
        (gradient,) = torch.autograd.grad(loss, logits)
        if name == "dbat-unpaired":
            expected = (loss, gradient)
    torch.testing.assert_close((loss, gradient), expected)


def test_divdis_by_hand() -> None:
    """Mutual information in both orders, and each member's share of yes, .5 and .75, against .25 of the labelled."""
    one, other = logits_of(0.9, 0.1), logits_of(0.9, 0.6)
    shares = [0.5 * math.log(0.5 / 0.25) + 0.5 * math.log(0.5 / 0.75), 0.75 * math.log(3) + 0.25 * math.log(1 / 3)]
    pair = float(pair_loss_of("mutual-information")(one, other))
    assert ensemble_loss("divdis", batch(one, other, positives=0.25)) == pytest.approx(2 * pair + sum(shares))
    assert ensemble_loss("divdis", batch(one, frozen=other[None], positives=0.25)) == pytest.approx(pair + shares[0])


def test_independent_by_hand() -> None:
    """Shares of .5 and .75: between .25 and a half nothing is lost, above it as much as it is from a half."""
    one, other = logits_of(0.9, 0.1), logits_of(0.9, 0.6)
    pair = float(pair_loss_of("mutual-information")(one, other))
    above = 0.75 * math.log(0.75 / 0.5) + 0.25 * math.log(0.25 / 0.5)
    assert ensemble_loss("independent", batch(one, other, positives=0.25)) == pytest.approx(2 * pair + above)
    assert ensemble_loss("independent", batch(logits_of(0.2, 0.2), positives=0.25)) == pytest.approx(
        0.2 * math.log(0.2 / 0.25) + 0.8 * math.log(0.8 / 0.75)
    )
    assert ensemble_loss("independent", batch(one, positives=0.8)) == pytest.approx(0.0), "a half will do"


def test_independent_members_may_differ_in_how_often_they_are_positive() -> None:
    """Features that hold on 1/6 and on 1/2 of the states: DivDis pulls both members to its share, this does not."""
    colour = torch.arange(12) % 6 == 0
    shape = torch.arange(12) % 2 == (torch.arange(12) >= 6)
    members = [confident(*feature.tolist(), gap=20.0) for feature in (colour, shape)]
    assert ensemble_loss("independent", batch(*members, positives=0.1)) == pytest.approx(0.0, abs=1e-6)
    assert ensemble_loss("divdis", batch(*members, positives=1 / 3)) > 0.1


def test_divdis_moves_members_that_are_positive_everywhere() -> None:
    """Where mutual information has no gradient, the ratio term has one."""
    logits = confident(1, 1, 1, 1, gap=2.0).expand(2, 4, 2).clone().requires_grad_()
    for name, least, most in (("mutual-information", 0.0, 1e-6), ("divdis", 0.1, 10.0)):
        context = replace(batch(*logits), unlabelled=logits, positives=0.01)
        loss = disagreement_of(load_objective(name), context)
        (gradient,) = torch.autograd.grad(loss, logits)
        assert least <= float(gradient[..., 1].sum()) <= most


def test_the_double_sum_by_hand() -> None:
    """Eq. (1), Spec C4: each pair in training counts in both orders, pairs with frozen members once."""
    logits = torch.stack([torch.full((1, 2), float(value)) for value in (1, 2, 4)])
    objective = Objective("distance", pair_loss=lambda a, b: (a - b).abs().mean())
    context = context_of(3, 1)
    for trained, frozen, expected in ((3, 0, 2 * (1 + 3 + 2)), (1, 2, 1 + 3), (2, 1, 2 * 1 + 3 + 2), (1, 0, 0)):
        seen = replace(context, unlabelled=logits[:trained], frozen=logits[trained : trained + frozen])
        assert disagreement_of(objective, seen).item() == expected


def test_a_function_of_one_argument_is_of_the_whole_ensemble(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """Spec C1."""
    code = (
        "def pull(one, other):\n    return (one - other).abs().mean((-2, -1))\nnothing = 3\n"
        "def spread(context):\n    return -context.unlabelled.std(0).mean()\n"
    )
    (tmp_path / "of_ensembles.py").write_text(code)
    monkeypatch.syspath_prepend(str(tmp_path))
    monkeypatch.setenv("HYPOGOAL_TRUST", "1")
    context = context_of()
    loss = disagreement_of(load_objective("of_ensembles:spread"), context)
    assert loss.item() == pytest.approx(-context.unlabelled.std(0).mean().item())
    pull, (one, other, third) = load_objective("of_ensembles:pull"), context.unlabelled
    assert pull.pair_loss is not None
    pairs = pull.pair_loss(one, other) + pull.pair_loss(one, third) + pull.pair_loss(other, third)
    assert disagreement_of(pull, context).item() == pytest.approx(2 * pairs.item())
    with pytest.raises(UserError, match=r"a diversity objective: of_ensembles:nothing\. Give a pair_loss\(logits_a"):
        load_objective("of_ensembles:nothing")


def test_another_package_adds_its_own_objective(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """Spec C1: an installed distribution with an entry point is found by name."""
    folder = tmp_path / "own-1.0.dist-info"
    folder.mkdir()
    (folder / "METADATA").write_text("Metadata-Version: 2.1\nName: own\nVersion: 1.0\n")
    names = "far-apart = own_objective\nbad = own_objective:nothing\n"
    (folder / "entry_points.txt").write_text(f"[{ENTRY_POINTS}]\n{names}")
    code = "def pair_loss(a, b):\n    return -(a - b).abs().mean((-2, -1))\n"
    (tmp_path / "own_objective.py").write_text(code)
    monkeypatch.syspath_prepend(str(tmp_path))
    assert pair_loss_of("far-apart")(torch.zeros(3, 2), torch.ones(3, 2)).item() == -1.0
    with pytest.raises(UserError, match="cannot be loaded"):
        load_objective("bad")
