"""Diversity objectives against values worked by hand, and the laws each of them must keep (Spec C1, C2)."""

from __future__ import annotations

import math
from pathlib import Path

import pytest
import torch
from torch import Tensor

from hypogoal.core.errors import UserError
from hypogoal.diversity import ENTRY_POINTS, OBJECTIVES, load_objective

DIVERSE = [name for name in OBJECTIVES if name != "none"]
EXTREME = (20.0, 100.0, 1e4)


def logits_of(*probabilities: float) -> Tensor:
    """Logits (N, 2) of members that say "reached" with these probabilities."""
    p = torch.tensor(probabilities, dtype=torch.float64)
    return torch.stack([torch.log1p(-p), torch.log(p)], dim=-1)


def confident(*classes: int, gap: float = 6.0) -> Tensor:
    """Logits (N, 2) of members that are sure of these classes."""
    sign = 2.0 * torch.tensor(classes, dtype=torch.float32) - 1.0
    return torch.stack([-sign * gap / 2, sign * gap / 2], dim=-1)


def test_the_objectives_are_those_of_the_spec() -> None:
    """Spec C1."""
    assert OBJECTIVES == ("dbat", "divdis", "none")


@pytest.mark.parametrize("name", DIVERSE)
def test_disagreement_on_unlabelled_states_lowers_the_loss(name: str) -> None:
    """Spec C2: the trap. Eq. (1) as printed would reward agreement.

    The two members differ on half of the states, where both dbat and mutual information must be lower.
    """
    pair_loss = load_objective(name)
    member = confident(1, 1, 0, 0)
    agreeing, disagreeing = confident(1, 1, 0, 0), confident(1, 0, 1, 0)
    assert pair_loss(member, disagreeing) < pair_loss(member, agreeing) - 0.3


@pytest.mark.parametrize("name", DIVERSE)
def test_descending_the_loss_makes_agreeing_members_disagree(name: str) -> None:
    """Spec C2: not only the value, its gradient too pushes members apart."""
    pair_loss = load_objective(name)
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
    loss = load_objective("dbat")(logits_of(0.9, 0.5), logits_of(0.2, 0.7))
    assert loss.item() == pytest.approx((-math.log(0.74) - math.log(0.5)) / 2)


def test_dbat_is_lowest_where_all_states_are_disputed() -> None:
    """Eq. (1): sure members that contradict each other everywhere have loss 0, agreeing ones a large loss."""
    pair_loss = load_objective("dbat")
    yes, no = confident(1, 1, gap=40.0), confident(0, 0, gap=40.0)
    assert pair_loss(yes, no).item() == pytest.approx(0.0, abs=1e-6)
    assert pair_loss(yes, yes).item() == pytest.approx(40.0 - math.log(2), abs=1e-4)


def test_divdis_by_hand() -> None:
    """Spec C1: two states, p_a = (.9, .1), p_b = (.8, .2): joint [[.37, .13], [.13, .37]], marginals .5."""
    joint = [(0.9 * 0.8 + 0.1 * 0.2) / 2, (0.9 * 0.2 + 0.1 * 0.8) / 2]
    expected = 2 * sum(j * math.log(j / 0.25) for j in joint)
    loss = load_objective("divdis")(logits_of(0.9, 0.1), logits_of(0.8, 0.2))
    assert loss.item() == pytest.approx(expected)


def test_divdis_at_its_ends() -> None:
    """Spec C1: log 2 for members that always agree or always contradict, 0 for independent or constant."""
    pair_loss = load_objective("divdis")
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
    loss = load_objective("dbat")(a, b)
    loss.backward()
    assert loss.item() == pytest.approx(gap - math.log(2), rel=1e-5)
    assert a.grad is not None
    torch.testing.assert_close(a.grad, torch.tensor([[-0.25, 0.25], [0.25, -0.25]]))
    torch.testing.assert_close(a.grad, b.grad)


@pytest.mark.parametrize("name", OBJECTIVES)
@pytest.mark.parametrize("gap", EXTREME)
@pytest.mark.parametrize("classes", [((1, 0), (1, 0)), ((1, 0), (0, 1)), ((1, 1), (1, 1)), ((1, 1), (0, 0))])
def test_no_nan_at_extreme_logits(name: str, gap: float, classes: tuple[tuple[int, ...], ...]) -> None:
    """Spec C2: probabilities that round to exactly 0 and 1 give a finite loss and a finite gradient."""
    a, b = (confident(*one, gap=gap).requires_grad_() for one in classes)
    loss = load_objective(name)(a, b)
    loss.backward()
    assert loss.isfinite().all()
    assert a.grad is not None
    assert b.grad is not None
    assert a.grad.isfinite().all()
    assert b.grad.isfinite().all()


def test_divdis_at_probabilities_of_exactly_zero_and_one() -> None:
    """Spec C2: logits of minus infinity are exact zeros; mutual information is defined there."""
    sure = torch.tensor([[0.0, -torch.inf], [-torch.inf, 0.0]])
    assert load_objective("divdis")(sure, sure).item() == pytest.approx(math.log(2))
    assert load_objective("divdis")(sure[:1], sure[:1]).item() == 0.0


@pytest.mark.parametrize("name", OBJECTIVES)
def test_members_are_interchangeable(name: str) -> None:
    """Spec C2: the order of the two members and of the states does not matter; leading axes are a batch."""
    generator = torch.Generator().manual_seed(3)
    a, b = torch.randn(2, 5, 7, 2, generator=generator, dtype=torch.float64) * 4
    pair_loss = load_objective(name)
    loss = pair_loss(a, b)
    assert loss.shape == (5,)
    torch.testing.assert_close(loss, pair_loss(b, a))
    order = torch.randperm(7, generator=generator)
    torch.testing.assert_close(loss, pair_loss(a[:, order], b[:, order]))
    torch.testing.assert_close(loss[2], pair_loss(a[2], b[2]))


@pytest.mark.parametrize("name", OBJECTIVES)
@pytest.mark.parametrize("shape", [(0, 2), (3, 0, 2), (0, 5, 2)])
def test_empty_sets_give_zero(name: str, shape: tuple[int, ...]) -> None:
    """Spec C2: no unlabelled states, or no pairs (K = 1), is a loss of 0 or of no entries, never NaN."""
    a, b = torch.zeros(shape, requires_grad=True), torch.zeros(shape, requires_grad=True)
    loss = load_objective(name)(a, b)
    loss.sum().backward()
    assert loss.shape == shape[:-2]
    assert (loss == 0).all()


@pytest.mark.parametrize("name", DIVERSE)
def test_gradients_are_those_of_the_loss(name: str) -> None:
    """Spec C2: autograd against finite differences, in double precision."""
    generator = torch.Generator().manual_seed(5)
    a, b = (torch.randn(4, 2, generator=generator, dtype=torch.float64).requires_grad_() for _ in range(2))
    assert torch.autograd.gradcheck(load_objective(name), (a, b))


def test_none_is_zero_and_can_be_differentiated() -> None:
    """Spec C1."""
    a = torch.tensor([[1.0, 2.0]], requires_grad=True)
    loss = load_objective("none")(a, a.detach())
    loss.backward()
    assert loss.item() == 0.0
    torch.testing.assert_close(a.grad, torch.zeros(1, 2))


def test_an_unknown_objective_is_one_clear_line() -> None:
    """Spec G2."""
    with pytest.raises(UserError, match=r"unknown diversity objective: dbta\. Choose one of dbat, divdis, none"):
        load_objective("dbta")


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
    assert load_objective("far-apart")(torch.zeros(3, 2), torch.ones(3, 2)).item() == -1.0
    with pytest.raises(UserError, match="cannot be loaded"):
        load_objective("bad")
