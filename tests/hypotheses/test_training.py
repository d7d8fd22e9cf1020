"""Training: the toy where diversity is needed, both schedules, determinism, NaN (Spec C1-C4, C6, G1-G3)."""

import copy
from dataclasses import replace

import numpy as np
import pytest
import torch
from numpy.typing import NDArray
from torch.nn.functional import cross_entropy

from hypogoal.core.errors import NumericalError, UserError
from hypogoal.core.seeding import seed_for, torch_generator
from hypogoal.diversity import OBJECTIVES, Objective, dbat
from hypogoal.hypotheses import batches, fit
from hypogoal.hypotheses.batches import TrainingStates
from hypogoal.hypotheses.config import EnsembleConfig
from hypogoal.hypotheses.ensemble import Ensemble
from hypogoal.hypotheses.thresholds import thresholds
from hypogoal.hypotheses.training import EnsembleTraining, train

TOY = EnsembleConfig(members=2, steps=50, learning_rate=1e-3, batch_size=32, diversity_weight=0.03)


def toy_states(easy: NDArray[np.bool_], hard: NDArray[np.bool_], seed: int) -> NDArray[np.uint8]:
    """Images of 6x6 cells of 8x8 pixels: the easy feature lights half of them, the hard one tints two."""
    rng = np.random.default_rng(seed)
    cells = np.full((len(easy), 6, 6, 3), 40, dtype=np.uint8)
    cells[np.arange(len(easy)), rng.integers(6, size=len(easy)), rng.integers(6, size=len(easy))] = 70
    cells[easy, :3] = 200
    cells[hard, 4, 3:5, 2] = 150
    return cells.repeat(8, axis=1).repeat(8, axis=2)


def toy(seed: int = 0) -> tuple[NDArray[np.uint8], NDArray[np.bool_], NDArray[np.uint8]]:
    """Labelled states in which both features say the same, unlabelled ones in which they are independent."""
    labels = np.arange(64) % 2 == 0
    free = np.arange(128)
    return toy_states(labels, labels, seed), labels, toy_states(free % 2 == 0, free % 4 < 2, seed + 1)


def assert_same(state: dict[str, torch.Tensor], other: dict[str, torch.Tensor]) -> None:
    """The same weights, bit by bit."""
    assert state.keys() == other.keys()
    assert [name for name, value in state.items() if not torch.equal(value, other[name])] == []


def follows(ensemble: Ensemble) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """How often each member (K,) goes with the easy, and with the hard feature where the two contradict."""
    easy = np.arange(100) % 2 == 0
    says = ensemble.predict(toy_states(easy, ~easy, seed=9)) > 0.5
    return (says == easy[:, None]).mean(axis=0), (says == ~easy[:, None]).mean(axis=0)


@pytest.mark.parametrize("schedule", ["simultaneous", "sequential"])
def test_diversity_finds_the_feature_that_is_hidden(schedule: str) -> None:
    """Spec C1, C4: without diversity every member takes the easy feature; with D-BAT one takes the other."""
    observations, labels, unlabelled = toy()
    config = TOY.model_copy(update={"schedule": schedule})
    alike = train(observations, labels, unlabelled, config.model_copy(update={"diversity": "none"}), seed=1)
    diverse = train(observations, labels, unlabelled, config, seed=1)
    for ensemble in (alike, diverse):
        assert ((ensemble.predict(observations) > 0.5) == labels[:, None]).mean() > 0.95, "all explain the labels"
    assert (follows(alike)[0] > 0.9).all()
    easy, hard = follows(diverse)
    assert easy.max() > 0.9
    assert hard.max() > 0.9


def test_the_log_tells_accuracy_and_disagreement_by_hand() -> None:
    """Two members: one right of two labelled states, one of both; they differ on one of four unlabelled states."""
    positive, negative = [0.0, 1.0], [1.0, 0.0]
    losses = fit.Losses(
        labelled=torch.tensor([0.2, 0.4]),
        disagreement=torch.tensor(0.5),
        taught=torch.tensor([1.0, 3.0]),
        loss=torch.tensor(0.7),
        classes=torch.tensor([1, 0]),
        on_labelled=torch.tensor([[positive, positive], [positive, negative]]),
        on_unlabelled=torch.tensor([[positive, negative, negative, negative], [negative] * 4]),
    )
    wanted = {"loss": 0.7, "labelled": 0.3, "diversity": 0.5, "accuracy": 0.75, "teacher": 2.0, "disagreement": 0.25}
    assert losses.numbers() == pytest.approx(wanted)
    alone = replace(losses, taught=None, on_labelled=losses.on_labelled[:1], on_unlabelled=losses.on_unlabelled[:1])
    assert alone.numbers().keys() == wanted.keys() - {"teacher", "disagreement"}


def test_a_single_member_is_the_plain_cnn() -> None:
    """Spec C1: K = 1 has no pairs, needs no unlabelled states, and learns."""
    observations, labels, unlabelled = toy()
    config = TOY.model_copy(update={"members": 1})
    training = EnsembleTraining(observations, labels, unlabelled[:0], config, 0)
    assert all(losses.disagreement == 0 for _, losses in training.steps())
    predicted = training.ensemble.predict(observations)
    assert predicted.shape == (64, 1)
    assert ((predicted[:, 0] > 0.5) == labels).all()


@pytest.mark.parametrize("schedule", ["simultaneous", "sequential"])
def test_the_same_seed_gives_the_same_bytes(schedule: str) -> None:
    """Spec G1: and another seed other ones; the global random state is neither read nor moved."""
    observations, labels, unlabelled = toy()
    config = TOY.model_copy(update={"steps": 3, "schedule": schedule})
    torch.manual_seed(1)
    first = train(observations, labels, unlabelled, config, seed=3).state_dict()
    drawn = torch.rand(1)
    torch.manual_seed(1)
    assert torch.equal(drawn, torch.rand(1))
    second = train(observations, labels, unlabelled, config, seed=3).state_dict()
    other = train(observations, labels, unlabelled, config, seed=4).state_dict()
    assert_same(first, second)
    assert not torch.equal(first["members.0.0.weight"], other["members.0.0.weight"])


def test_members_start_the_same_whatever_the_ensemble() -> None:
    """Spec C1: a single CNN is the first member of an ensemble without diversity: a fair comparison."""
    observations, labels, unlabelled = toy()
    config = TOY.model_copy(update={"steps": 4, "diversity": "none"})
    three = train(observations, labels, unlabelled, config.model_copy(update={"members": 3}), seed=3)
    one = train(observations, labels, unlabelled, config.model_copy(update={"members": 1}), seed=3)
    np.testing.assert_allclose(three.predict(observations)[:, :1], one.predict(observations), atol=1e-6)


@pytest.mark.parametrize("diversity", OBJECTIVES)
def test_the_loss_is_that_of_equation_1(diversity: str) -> None:
    """Eq. (1): the sum of labelled losses + weight x sum over ordered pairs, at every step."""
    observations, labels, unlabelled = toy()
    config = TOY.model_copy(update={"members": 3, "steps": 4, "diversity": diversity, "diversity_weight": 0.5})
    steps = [
        (step, losses.numbers())
        for step, losses in EnsembleTraining(observations, labels, unlabelled, config, 0).steps()
    ]
    assert [step for step, _ in steps] == [1, 2, 3, 4]
    for _, numbers in steps:
        assert numbers["loss"] == pytest.approx(3 * numbers["labelled"] + 0.5 * numbers["diversity"], rel=1e-5)
        assert (numbers["diversity"] != 0) == (diversity != "none")


@pytest.mark.parametrize("schedule", ["simultaneous", "sequential"])
def test_a_look_leaves_no_trace(schedule: str) -> None:
    """The members looked at on the way are those of a shorter training, the last those of one without looks.

    Spec C4: one after the other, a member does not move once it is trained, nor before.
    """
    observations, labels, unlabelled = toy()
    config = TOY.model_copy(update={"steps": 6, "schedule": schedule})
    training = EnsembleTraining(observations, labels, unlabelled, config, 0)
    looked = []
    for _ in training.steps():
        training.ensemble.predict(unlabelled)
        looked.append(copy.deepcopy(training.ensemble.state_dict()))
    assert_same(looked[-1], train(observations, labels, unlabelled, config, 0).state_dict())
    if schedule == "simultaneous":
        assert_same(
            looked[3], train(observations, labels, unlabelled, config.model_copy(update={"steps": 4}), 0).state_dict()
        )
        return
    for name, last in looked[-1].items():
        if name.startswith("members."):
            begun, first = looked[0][name], looked[5][name]
            second = name.startswith("members.1.")
            assert (torch.equal(begun, first), torch.equal(first, last)) == (second, not second), name


@pytest.mark.parametrize(
    ("weight", "diversity", "unlabelled_bn", "tables"),
    [
        (0.5, "dbat", True, True),
        (0.0, "none", True, False),
        (0.5, "dbat", False, False),
        (0.5, "none", False, True),
        (0.5, "dbat", False, True),
    ],
)
def test_batchnorm_sees_unlabelled_states_whatever_the_diversity(
    weight: float, diversity: str, unlabelled_bn: bool, tables: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Spec C1, C6: the switch decides alone; at learning rate 0 nothing else could move running statistics."""
    if not tables:
        monkeypatch.setattr(batches.patches, "make_tables", lambda *_: None)
    observations, labels, unlabelled = toy()
    changes = {"diversity": diversity, "diversity_weight": weight, "unlabelled_bn": unlabelled_bn}
    config = TOY.model_copy(update={"steps": 2, "learning_rate": 0.0} | changes)
    states = [
        train(observations, labels, others, config, seed=0).state_dict() for others in (unlabelled, 255 - unlabelled)
    ]
    for name in ("members.0.1", "members.1.5"):
        assert torch.equal(*(state[f"{name}.running_mean"] for state in states)) != unlabelled_bn
        assert states[0][f"{name}.num_batches_tracked"] == (4 if unlabelled_bn else 2)


@pytest.mark.parametrize("unlabelled_bn", [True, False])
def test_a_step_is_that_of_the_plain_loop(unlabelled_bn: bool) -> None:
    """Eq. (1), Spec C3, C6: a loop over members in NCHW, labelled and unlabelled apart, ends with the same weights."""
    observations, labels, unlabelled = toy()
    config = TOY.model_copy(update={"members": 3, "steps": 5, "diversity_weight": 0.5, "unlabelled_bn": unlabelled_bn})
    found = train(observations, labels, unlabelled, config, seed=0)
    plain = Ensemble("doorkey", observations.shape[1:], 3, torch_generator(0, "weights"))
    networks = [member for member in plain.members if isinstance(member, torch.nn.Sequential)]
    optimiser = torch.optim.Adam(plain.parameters(), lr=config.learning_rate, weight_decay=config.l2_weight)
    states = TrainingStates(observations, labels, unlabelled, plain, {})
    images, elsewhere = (torch.from_numpy(some).permute(0, 3, 1, 2).contiguous() / 255 for some in toy()[::2])
    for mine, others in states.batches(config, seed_for(0, "batches", 0)):
        logits = [network(images[torch.from_numpy(mine)]) for network in networks]
        loss = sum(cross_entropy(one, states.targets(mine), torch.tensor([0.5, 0.5])) for one in logits)
        for network in networks:
            for layer in network:
                if isinstance(layer, torch.nn.BatchNorm2d):
                    layer.momentum = 0.1 if unlabelled_bn else 0.0
        logits = [network(elsewhere[torch.from_numpy(others)]) for network in networks]
        for layer in (layer for network in networks for layer in network):
            if isinstance(layer, torch.nn.BatchNorm2d):
                layer.momentum = 0.1
        loss = loss + 0.5 * sum(dbat.pair_loss(one, other) for one in logits for other in logits if one is not other)
        optimiser.zero_grad()
        torch.as_tensor(loss).backward()
        optimiser.step()
    untrained = Ensemble("doorkey", observations.shape[1:], 3, torch_generator(0, "weights"))
    expected = plain.predict(unlabelled)
    np.testing.assert_allclose(found.predict(unlabelled), expected, atol=2e-3)
    assert np.abs(untrained.predict(unlabelled) - expected).max() > 0.02


def test_thresholds_are_set_after_training(monkeypatch: pytest.MonkeyPatch) -> None:
    """Beyond the paper: a number, the split of unlabelled states, a function of one's own; probabilities stay."""
    monkeypatch.setenv("HYPOGOAL_TRUST", "1")
    observations, labels, unlabelled = toy()
    config = TOY.model_copy(update={"steps": 20})
    plain = train(observations, labels, unlabelled, config, seed=0)
    probabilities = plain.predict(unlabelled)
    np.testing.assert_array_equal(plain.predictions(unlabelled), probabilities > 0.5)

    def by(rule: str) -> Ensemble:
        return train(observations, labels, unlabelled, config.model_copy(update={"threshold": rule}), seed=0)

    split = by("unlabelled-split")
    np.testing.assert_array_equal(split.predict(unlabelled), probabilities)
    positives = split.predictions(unlabelled).mean(axis=0)
    assert ((positives > 0) & (positives < 1)).all()
    np.testing.assert_array_equal(by("0.7").predictions(unlabelled), probabilities > np.float32(0.7))
    lowest = plain.predict(observations[labels]).min(axis=0)
    np.testing.assert_array_equal(by("own_view:lowest").thresholds.numpy(), lowest)
    for rule, line in (
        ("1.5", "unknown threshold: 1.5. Choose one of unlabelled-split, or give module:object"),
        ("own_view:too_many", "the threshold rule gave"),
    ):
        with pytest.raises(UserError, match=line):
            by(rule)
    alone = config.model_copy(update={"members": 1, "threshold": "unlabelled-split"})
    with pytest.raises(UserError, match="unlabelled states are needed"):
        train(observations, labels, unlabelled[:0], alone, seed=0)


def test_the_split_by_hand() -> None:
    """Ten states about -4 and thirty about 3, in logits: the cut is half-way between the nearest two of them."""
    rng = np.random.default_rng(0)
    logits = np.concatenate([np.linspace(-5, -3, 10), np.linspace(2, 4, 30)])
    elsewhere = (1 / (1 + np.exp(-rng.permutation(logits)))).astype(np.float32)[:, None]
    found = thresholds("unlabelled-split", elsewhere[:2], np.array([True, False]), elsewhere)
    np.testing.assert_allclose(np.log(found / (1 - found)), [-0.5], atol=1e-4)
    assert (elsewhere > found).sum() == 30


def test_a_split_of_states_that_are_all_alike() -> None:
    """No warning and no NaN: certain members, equal ones, a single state; a certain one goes on saying yes."""
    certain = np.ones((5, 1), np.float32)
    with np.errstate(all="raise"):
        for elsewhere in (certain, certain * 0, certain * 0.3, certain[:1]):
            found = thresholds("unlabelled-split", certain[:2], np.array([True, False]), elsewhere)
            assert 0 <= found[0] < 1


def test_batches_are_balanced() -> None:
    """Spec C6: Table 3's weights of 0.5 and 0.5 with few positives; every state before any comes again."""
    labels = np.arange(164) < 3
    images = np.zeros((164, 24, 24, 3), dtype=np.uint8)
    ensemble = Ensemble("tiles", (24, 24, 3), 1, torch.Generator())
    states = TrainingStates(images, labels, images[:100], ensemble, {})
    config = EnsembleConfig(batch_size=40, steps=41)
    labelled, unlabelled = (np.stack(drawn) for drawn in zip(*states.batches(config, 0), strict=True))
    assert labelled.shape == unlabelled.shape == (41, 40)
    assert (labels[labelled].sum(axis=1) == 20).all()
    np.testing.assert_array_equal(np.unique(unlabelled.ravel()[:100]), np.arange(100))
    counts = np.bincount(labelled.ravel(), minlength=164)
    assert np.ptp(counts[labels]) <= 1
    assert np.ptp(counts[~labels]) <= 1


def test_class_weights_weigh_the_classes() -> None:
    """Spec C3, C6: weights of 0.95 and 0.05 push the members towards the heavier class."""
    observations, labels, unlabelled = toy()
    rng = np.random.default_rng(0)
    labels = rng.permutation(labels)  # nothing to learn but the prior
    config = TOY.model_copy(update={"members": 1, "steps": 30})
    says = []
    for negative in (0.95, 0.05):
        weighted = config.model_copy(update={"class_weight_negative": negative, "class_weight_positive": 1 - negative})
        says.append(train(observations, labels, unlabelled, weighted, seed=0).predict(unlabelled).mean())
    assert says[0] < 0.4 < 0.6 < says[1]


def test_an_objective_that_gives_nan_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    """Spec G3: at the step at which it broke."""
    observations, labels, unlabelled = toy()
    broken = {"calls": 0}

    def pair_loss(one: torch.Tensor, other: torch.Tensor) -> torch.Tensor:
        broken["calls"] += 1
        loss = (one - other).abs().mean()
        return loss * torch.nan if broken["calls"] == 3 * 4 + 2 else loss

    monkeypatch.setattr(fit, "load_objective", lambda _: Objective("broken", pair_loss=pair_loss))
    with pytest.raises(NumericalError, match="the diversity loss is nan at step 5"):
        train(observations, labels, unlabelled, TOY.model_copy(update={"members": 3}), seed=0)


def test_data_that_cannot_be_learned_from_are_one_clear_line() -> None:
    """Spec G2: one class only, no unlabelled states."""
    observations, labels, unlabelled = toy()
    with pytest.raises(UserError, match="the sub-goal has no positives among 64 labelled states"):
        train(observations, labels & False, unlabelled, TOY, seed=0)
    with pytest.raises(UserError, match="unlabelled states are needed"):
        train(observations, labels, unlabelled[:0], TOY, seed=0)


def test_nan_names_the_member_of_a_later_round() -> None:
    """Spec G3, C4: of members one after the other the second, whose weights are broken, in its first step."""
    config = TOY.model_copy(update={"steps": 2, "schedule": "sequential", "diversity": "none"})
    training = EnsembleTraining(*toy(), config, 0)
    next(training.ensemble.networks[1].parameters()).data.fill_(torch.nan)
    with pytest.raises(NumericalError, match=r"^the labelled loss of member 1 is nan at step 3$"):
        list(training.steps())
