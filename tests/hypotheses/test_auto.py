"""``diversity_weight=auto``: the rule, what is held out, what is told, breaks; members that are no hypotheses."""

import json
from pathlib import Path

import h5py
import numpy as np
import pytest
from command_line import refuses, run
from numpy.typing import NDArray
from PIL import Image
from test_training import assert_same, follows, toy, toy_states

import hypogoal
from hypogoal.core.artefacts import Artefact
from hypogoal.core.checkpoints import Checkpoints
from hypogoal.hypotheses import weighing
from hypogoal.hypotheses.auto import AutoTraining
from hypogoal.hypotheses.config import TrainEnsembleConfig
from hypogoal.hypotheses.scores import idle_members, mean_disagreement
from hypogoal.hypotheses.views import StateOrigins
from hypogoal.hypotheses.weighing import WEIGHTS, held_out, information_of, lowest_kept

AUTO = TrainEnsembleConfig(members=2, steps=50, learning_rate=1e-3, batch_size=32, restarts=2)
HALF = np.arange(64) % 2 == 0


def trained(config: TrainEnsembleConfig = AUTO, groups: NDArray[np.int64] | None = None) -> AutoTraining:
    """Trained on the toy, in which labels fit an easy and a hard feature."""
    observations, labels, unlabelled = toy()
    origins = StateOrigins({} if groups is None else {"group": groups})
    training = AutoTraining(observations, labels, unlabelled, config, 1, origins=origins)
    for _ in training.steps():
        pass
    return training


def test_the_largest_weight_is_taken_that_members_bear() -> None:
    """Weights above it lose held-out labels; with it members own both features; it costs what was told at most."""
    training = trained()
    *larger, chosen = training.tried
    assert chosen.kept and chosen.accuracy >= training.lowest and not any(tried.kept for tried in larger)
    assert [tried.weight for tried in training.tried] == [*WEIGHTS[: len(training.tried)]]
    assert training.weight == chosen.weight > 1e-3
    easy, hard = follows(training.ensemble)
    assert easy.max() > 0.9 and hard.max() > 0.9
    assert training.step <= training.cost(1, len(training.tried))
    odd = trained(AUTO.model_copy(update={"steps": 5, "restarts": 4, "diversity_weight": 0.01}))
    assert odd.step == odd.most == odd.cost(0, 0) == 5 + 3 * 2 + 5


def test_of_whole_ensembles_the_one_stays_that_tells_most() -> None:
    """Simultaneous members: each restart is trained to its end, and none is trained again."""
    fixed = {"schedule": "simultaneous", "diversity_weight": 0.01, "steps": 20}
    training = trained(AUTO.model_copy(update={**fixed, "restarts": 3}))
    assert training.step == training.most == 3 * 20
    starts = training.snapshot()["outcomes"]
    told = [start["information"] for start in starts]
    assert len({*told}) == 3
    probabilities = training.ensemble.predict(toy()[2])
    assert np.mean([information_of(member) for member in probabilities.T]) == pytest.approx(max(told))
    [_, *others] = starts
    for seed, start in zip((1, *(other["seed"] for other in others)), starts, strict=True):
        observations, labels, unlabelled = toy()
        alone = AutoTraining(observations, labels, unlabelled, AUTO.model_copy(update={**fixed, "restarts": 1}), seed)
        for _ in alone.steps():
            pass
        one = alone.ensemble.predict(unlabelled)
        assert np.mean([information_of(member) for member in one.T]) == pytest.approx(start["information"])


def test_the_final_members_have_all_labels() -> None:
    """With the weight that was chosen, from the start that was chosen, they are what a fixed weight gives."""
    training = trained()
    again = trained(AUTO.model_copy(update={"diversity_weight": training.weight}))
    assert not again.tried
    assert_same(again.ensemble.state_dict(), training.ensemble.state_dict())


@pytest.mark.parametrize(
    "changed",
    [
        {},
        {"schedule": "simultaneous"},
        {"diversity": "divdis"},
        {"diversity": "independent"},
        {"diversity": "divdis", "members": 1},
        {"restarts": 1},
    ],
    ids=["sequential", "simultaneous", "divdis", "independent", "one member", "one start"],
)
def test_breaks_leave_no_trace_in_a_search(changed: dict[str, object], tmp_path: Path) -> None:
    """Spec G1: broken in each of its trainings, it tries, chooses and ends as if it had not been."""
    observations, labels, unlabelled = toy()
    config = AUTO.model_copy(update={"steps": 6, **changed})
    unbroken = AutoTraining(observations, labels, unlabelled, config, 0)
    total = sum(1 for _ in unbroken.steps())
    checkpoints = Checkpoints(tmp_path / "search.safetensors")
    for last in (2, total // 3, total // 2, total - 5):
        training = AutoTraining(observations, labels, unlabelled, config, 0, saved=checkpoints.load())
        for _ in training.steps():
            if training.step == last:
                checkpoints.save(training.snapshot())
                break
    training = AutoTraining(observations, labels, unlabelled, config, 0, saved=checkpoints.load())
    for _ in training.steps():
        pass
    assert (training.step, training.summary()) == (total, unbroken.summary())
    assert_same(training.ensemble.state_dict(), unbroken.ensemble.state_dict())


def test_the_tolerance_is_a_standard_error() -> None:
    """By hand: 32 of 32 and 32 of 32 right: q = 33/34, s = .0211; of 2 members the worse one counts."""
    right = np.ones((64, 2), np.bool_)
    assert lowest_kept(right, HALF) == pytest.approx(1 - 0.0211, abs=1e-4)
    right[:8, 1] = False  # 4 of each class: .875, q = 29/34
    s = np.sqrt(2 * (29 / 34) * (5 / 34) / 32) / 2
    assert lowest_kept(right, HALF) == pytest.approx(0.875 - s)


def test_a_quarter_of_each_class_is_held_out_and_groups_whole() -> None:
    groups = np.arange(64) // 4  # each has both classes
    for of_states in (None, groups):
        [held], remark = held_out(HALF, of_states, 0)
        assert not remark and HALF[held].sum() == (~HALF)[held].sum() == 8
    assert all(held[groups == group].all() or not held[groups == group].any() for group in groups)
    assert not np.array_equal(held_out(HALF, None, 1)[0][0], held_out(HALF, None, 2)[0][0])


@pytest.mark.parametrize(("positives", "folds"), [(20, 4), (8, 4), (7, 0)])
def test_few_labels_are_held_out_in_turn_or_tell_nothing(positives: int, folds: int) -> None:
    labels = np.arange(100) < positives
    held, remark = held_out(labels, None, 0)
    assert len(held) == folds and bool(remark) == (folds == 0)
    if held:
        assert np.array_equal(np.sum(held, axis=0), np.ones(100)), "each state is held out once"
    else:
        assert remark == "7 labels of a class are too few to choose the diversity weight by, so it is 0.0001"


def test_too_few_groups_are_told() -> None:
    """Three recordings cannot be held out in quarters: single states are, which a user must know."""
    [_], remark = held_out(HALF, np.arange(64) % 3, 0)
    assert remark.startswith("too few groups have both classes")
    assert trained(AUTO.model_copy(update={"steps": 2}), np.arange(64) % 3).summary()["remark"] == remark


def test_a_weight_that_makes_members_constant_is_passed_over(monkeypatch: pytest.MonkeyPatch) -> None:
    """Whatever the labels say: the only weights on offer keep them, and one makes a member say no everywhere."""
    usual = AutoTraining._outcome

    def outcome(training: AutoTraining, *rest: object) -> dict[str, object]:
        now = training.now
        assert now is not None
        return {**usual(training, *rest), "constant": now.config.diversity_weight == 1e-3}  # type: ignore[arg-type]

    monkeypatch.setattr(weighing, "WEIGHTS", (1e-3, 1e-4))
    monkeypatch.setattr(AutoTraining, "_outcome", outcome)
    first, second = trained().tried
    assert (first.constant, first.kept, second.constant, second.kept) == (True, False, False, True)


def test_a_weight_at_which_members_contradict_each_other_is_passed_over() -> None:
    """Members recognise the labelled place: they keep its labels at any weight and say the contrary elsewhere."""
    observations, labels, unlabelled = toy()
    training = AutoTraining(observations, labels, 255 - unlabelled, AUTO, 1)
    for _ in training.steps():
        pass
    *larger, chosen = training.tried
    passed_over = [tried for tried in larger if tried.accuracy >= training.lowest and tried.contrary]
    assert passed_over and not any(tried.kept for tried in passed_over)
    assert chosen.kept and not chosen.contrary
    assert mean_disagreement(training.ensemble.predictions(255 - unlabelled)) <= 0.5


def test_the_share_is_what_a_member_without_diversity_predicts() -> None:
    """In the toy half of the unlabelled states have the easy feature; labels' own share only where it is asked for."""
    training = trained(AUTO.model_copy(update={"diversity": "divdis"}))
    assert training.share == pytest.approx(0.5, abs=0.1)
    at_once = trained(AUTO.model_copy(update={"diversity": "divdis", "schedule": "simultaneous"}))
    assert at_once.share == pytest.approx(0.5, abs=0.1)
    assert trained(AUTO.model_copy(update={"diversity": "divdis", "share": 0.2, "steps": 2})).share == 0.2
    assert trained(AUTO.model_copy(update={"diversity": "divdis", "share": "labels", "steps": 2})).share == "labels"


def test_members_that_are_no_hypotheses_are_named() -> None:
    rng = np.random.default_rng(0)
    own = rng.random(1000) < 0.5
    nearly = own.copy()
    nearly[:9] ^= True
    layouts = np.arange(1000) % 2
    predictions = np.stack([own, own & False, own | True, nearly, layouts == 1], axis=1)
    assert idle_members(predictions, layouts) == [
        "member 1 predicts negative everywhere",
        "member 2 predicts positive everywhere",
        "member 3 predicts what member 0 does",
        "member 4 tells layouts apart, not states",
    ]
    assert idle_members(np.stack([own, rng.random(1000) < 0.5], axis=1)) == []


def test_the_start_stays_that_tells_most() -> None:
    """In nats, by hand: sure and even log 2; sure of one quarter H(1/4); the same for all nothing; in doubt nothing."""
    sure = np.array([0.0, 1.0] * 50)
    quarter = np.array([1.0, 0.0, 0.0, 0.0] * 25)
    for probabilities, nats in ((sure, np.log(2)), (quarter, 0.5623), (np.ones(100), 0), (np.full(100, 0.5), 0)):
        assert information_of(probabilities) == pytest.approx(nats, abs=1e-4)
    assert information_of(0.6 * sure + 0.2) == pytest.approx(np.log(2) - 0.5004, abs=1e-4)


def test_a_sub_goal_of_one_class_is_refused_before_any_is_trained(tmp_path: Path) -> None:
    """By its name; no other sub-goal's checkpoint makes it advise --resume."""
    observations, labels, unlabelled = toy()
    arrays = {"observations": observations, "unlabelled": unlabelled, "sub_goals": np.array(["one", "two"])}
    np.savez(tmp_path / "a.npz", labels=np.stack([labels, labels], axis=1), **arrays)
    data = tmp_path / "data.h5"
    run("import", tmp_path / "a.npz", "--out", data, "-q")
    with h5py.File(data, "a") as file:
        file["labelled/two/labels"][...] = True
    said = refuses("two has no negatives among", "train-ensemble", data, "--out", tmp_path / "out")
    assert "--resume" not in said


@pytest.mark.slow
def test_a_folder_of_pictures_gets_members_for_both_features(tmp_path: Path) -> None:
    """docs/own-data.md's two commands, PNG and CSV of nothing but labels: the choice is told, and kept."""
    pictures = tmp_path / "door"
    free = np.arange(256)
    labelled, unlabelled = toy_states(HALF, HALF, 0), toy_states(free % 2 == 0, free % 4 < 2, 1)
    for place, states in (("positive", labelled[HALF]), ("negative", labelled[~HALF]), ("unlabelled", unlabelled)):
        (pictures / place).mkdir(parents=True)
        for number, state in enumerate(states):
            Image.fromarray(state).save(pictures / place / f"{number}.png")
    data, ensemble = tmp_path / "data.h5", tmp_path / "ensemble"
    run("import", pictures, "--out", data, "-q")
    checked = run("check", data).out
    assert "ok   hypotheses: door: with diversity_weight=" in checked and "train-ensemble takes some" in checked
    printed, told = run("train-ensemble", data, "--out", ensemble, "--set", "members=2")
    assert "train-ensemble door: at most 7050 steps, 450 of them when the weight is chosen\n" in told
    chosen = Artefact(ensemble).config["chosen"]["door"]
    assert f"door: diversity_weight={chosen['diversity_weight']:g}, by " in printed and "  chosen\n" in printed
    assert json.loads((ensemble / "manifest.json").read_text())["config"]["diversity_weight"] == "auto"
    easy, hard = follows(hypogoal.load_ensemble(ensemble, "door"))
    assert easy.max() > 0.9 and hard.max() > 0.9
