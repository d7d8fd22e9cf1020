"""Views: one of one's own, and the standard of numbers; what members see (Spec C2, C5, F2, G1, G2)."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from own_view import Moved, Settings
from test_training import TOY, toy

from hypogoal.core.errors import UserError
from hypogoal.core.seeding import rng_for, torch_generator
from hypogoal.hypotheses.batches import TrainingStates
from hypogoal.hypotheses.config import EnsembleConfig
from hypogoal.hypotheses.deep_lift import attributed, mean_state
from hypogoal.hypotheses.ensemble import Ensemble, read_ensemble, write_ensemble
from hypogoal.hypotheses.stacked import StackedMembers
from hypogoal.hypotheses.training import train
from hypogoal.hypotheses.views import View

OWN = TOY.model_copy(update={"steps": 3, "view": "own_view:Moved", "view_settings": ("jitter=3",)})


pytestmark = pytest.mark.usefixtures("trusted")


def members_of(view: View) -> Ensemble:
    return Ensemble("tiles", (48, 48, view.shape[2]), 1, torch_generator(0, "weights"), view)


def test_it_learns_and_comes_back_from_disk(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Spec A8: what it learned lies beside the members' weights; nobody's code runs because a file names it."""
    observations, labels, unlabelled = toy()
    ensemble = train(observations, labels, unlabelled, OWN, seed=0)
    seen = ensemble.see(observations)
    shade = int(observations.mean())
    assert seen.shape == (64, 42, 42, 3)
    np.testing.assert_array_equal(seen, np.maximum(observations[:, 3:-3, 3:-3], shade) - shade)
    ensemble.thresholds.copy_(torch.from_numpy(np.array([0.25, 0.75], dtype=np.float32)))
    write_ensemble(tmp_path, "goal", ensemble)
    config = OWN.model_dump(mode="json") | {"sub_goals": ["goal"]}
    config |= {"observation_shape": [48, 48, 3], "observation_dtype": "uint8"}
    back = read_ensemble(tmp_path, config, "goal")
    np.testing.assert_array_equal(back.predict(observations), ensemble.predict(observations))
    np.testing.assert_array_equal(back.predictions(observations), ensemble.predictions(observations))
    with pytest.raises(UserError, match="the weights do not fit the"):
        read_ensemble(tmp_path, config | {"view": "full"}, "goal")
    monkeypatch.delenv("HYPOGOAL_TRUST")
    with pytest.raises(UserError, match="a file names code of its own as its view: own_view:Moved"):
        read_ensemble(tmp_path, config, "goal")


def test_changes_are_made_in_training_alone() -> None:
    """In evaluation mode states are what members see; in training each is changed on its own, as the view says."""
    images = np.arange(48 * 48, dtype=np.uint32).astype(np.uint8).reshape(1, 48, 48, 1).repeat(40, axis=0)
    view = Moved((48, 48, 1), Settings())
    states = TrainingStates(images, np.arange(40) < 3, images, members_of(view), {})
    states.begin(0)
    network = torch.nn.Sequential(torch.nn.Flatten())  # its outputs are its inputs
    plain, none = states.logits([network.eval()], np.arange(40))
    np.testing.assert_allclose(plain.view(40, 44, 44, 1).numpy(), view.see(images) / 255, atol=1e-7)
    assert none.shape == (1, 0, 44 * 44)
    changed, elsewhere = states.logits([network.train()], np.arange(40), np.arange(40))
    for group, logits in (("labelled", changed), ("unlabelled", elsewhere)):
        expected = view.change(view.to_change(images), rng_for(0, "changes", group))
        np.testing.assert_array_equal(logits.view(40, 44, 44, 1).numpy(), expected)
        assert len(np.unique(expected[:, 0, 0])) > 30


def test_methods_see_the_same_labelled_states_changed_the_same_way(monkeypatch: pytest.MonkeyPatch) -> None:
    """Decision 38: methods of one seed share what is random, whatever each does with unlabelled states."""
    seen: list[list[np.ndarray]] = []
    change = Moved.change

    def recorded(self: Moved, batch: np.ndarray, rng: np.random.Generator | None) -> np.ndarray:
        images = change(self, batch, rng)
        if rng is not None:
            seen[-1].append(images)
        return images

    monkeypatch.setattr(Moved, "change", recorded)
    for changes in ({}, {"diversity": "none"}, {"diversity": "none", "unlabelled_bn": False}):
        seen.append([])
        train(*toy(), OWN.model_copy(update=changes), seed=0)
    assert [len(method) for method in seen] == [6, 6, 3]
    labelled = [seen[0][::2], seen[1][::2], seen[2]]
    np.testing.assert_array_equal(labelled[0], labelled[1])
    np.testing.assert_array_equal(labelled[0], labelled[2])
    assert not np.array_equal(seen[0][0], seen[0][2])


@pytest.mark.parametrize(("kinds", "each"), [([0, 1, 2], (8, 8)), ([4], (24, 24)), ([0, 1, 2, 4, 8], (4, 5))])
def test_pools_of_positives_take_turns(kinds: list[int], each: tuple[int, int]) -> None:
    """8 positives of each of three kinds and 40 negatives in 64; other numbers spread evenly."""
    labels = np.arange(400) < 100
    of = np.where(labels, np.resize(kinds, 400), -1)
    of[:50] = kinds[0]  # more of the first kind than of the others
    images = np.zeros((400, 48, 48, 3), dtype=np.uint8)
    view = Moved((48, 48, 3), Settings())
    states = TrainingStates(images, labels, images[:100], members_of(view), {"kind": of})
    total = np.zeros(len(kinds), dtype=int)
    for labelled, unlabelled in states.batches(EnsembleConfig(batch_size=64, steps=20), 0):
        assert len(labelled) == len(unlabelled) == 64
        assert labels[labelled].sum() == 24
        counts = np.array([(of[labelled] == kind).sum() for kind in kinds])
        assert (counts.min(), counts.max()) == each
        assert len(set(labelled.tolist())) > 50
        total += counts
    assert np.ptp(total) <= 1


@pytest.mark.parametrize(
    ("changes", "line"),
    [
        ({"view": "own_view:Missing"}, "the view cannot be loaded: AttributeError"),
        ({"view": "window"}, "unknown view: window"),
        ({"view": "own_view:Settings"}, "this is no view: own_view:Settings"),
        ({"view_settings": ("jiter=3",)}, "own_view:Moved has no setting: jiter. Did you mean 'jitter'"),
        ({"view_settings": ("jitter=9",)}, "value not allowed: jitter='9' in own_view:Moved. Allowed: 0 .. 8"),
        ({"view": "own_view:Wrong"}, r"the view shows uint8 \(2, 41, 42, 3\) of 2 states: .* Show uint8 \(2, 42, 42"),
        ({"view": "own_view:OfNumbers", "view_settings": ()}, "the view is of float32, these observations are uint8"),
    ],
)
def test_what_does_not_fit_is_one_line(changes: dict[str, object], line: str) -> None:
    """Spec G2."""
    observations, labels, unlabelled = toy()
    with pytest.raises(UserError, match=line):
        train(observations, labels, unlabelled, OWN.model_copy(update=changes), seed=0)


def test_every_pool_has_an_order_of_its_own() -> None:
    """Else the same places of two pools, which may belong together, would always meet in a batch."""
    labels, kind = np.arange(64) < 32, np.arange(64) % 2
    images = np.zeros((64, 48, 48, 3), dtype=np.uint8)
    view = Moved((48, 48, 3), Settings())
    states = TrainingStates(images, labels, images, members_of(view), {"kind": kind})
    ((drawn, _),) = states.batches(EnsembleConfig(batch_size=64, steps=1), 0)
    positives = drawn[:24]
    even, odd = positives[kind[positives] == 0], positives[kind[positives] == 1]
    assert len(even) == len(odd) == 12
    assert even.tolist() != (odd - 1).tolist()


FAR = np.array([1e4, 3.0, -0.01, 7.0], np.float32)  # numbers of quite different sizes, the last of which never changes


def states(count: int, seed: int, shape: tuple[int, ...] = (4,)) -> tuple[np.ndarray, np.ndarray]:
    """Positive where the third number is above its mean."""
    numbers = np.random.default_rng(seed).normal(FAR, [500, 0.1, 0.002, 0], (count, 4)).astype(np.float32)
    return numbers.reshape(count, *shape), numbers[:, 2] > FAR[2]


def trained(shape: tuple[int, ...] = (4,), seed: int = 0, **settings: Any) -> Ensemble:
    (seen, labels), (others, _) = states(300, 1, shape), states(200, 2, shape)
    config = EnsembleConfig(**{"members": 2, "diversity_weight": 0.0, **settings})  # type: ignore[arg-type]
    return train(seen, labels, others, config, seed)


@pytest.mark.parametrize("shape", [(4,), (2, 2), (2, 1, 2)])
def test_members_learn_numbers_of_any_size_and_shape(shape: tuple[int, ...], tmp_path: Path) -> None:
    """Spec C5, A8: by default in the steps that pictures take; stored and read they say the same."""
    ensemble, (seen, labels) = trained(shape), states(1000, 3, shape)
    assert ensemble.network == "mlp" and "float32" in repr(ensemble)
    assert ((ensemble.predictions(seen) == labels[:, None]).mean(0) > 0.93).all()
    np.testing.assert_array_equal(ensemble.predict(seen.astype(np.float64)), ensemble.predict(seen))
    write_ensemble(tmp_path, "up", ensemble)
    about = {"sub_goals": ["up"], "network": "mlp", "members": 2, "observation_shape": list(shape), "view": "full"}
    again = read_ensemble(tmp_path, {**about, "observation_dtype": "float32"}, "up")
    np.testing.assert_array_equal(again.predict(seen), ensemble.predict(seen))
    with pytest.raises(UserError, match="the weights do not fit"):
        read_ensemble(tmp_path, {**about, "observation_dtype": "uint8"}, "up")
    with pytest.raises(UserError, match=r"Give float32 \(N, "):
        ensemble.predict(seen.astype(np.uint8))


def test_all_members_at_once_say_the_same() -> None:
    """Spec D1: of ensembles that standardise numbers otherwise, and of pictures that a plain network sees."""
    ensembles = [trained(steps=5, seed=seed) for seed in (0, 1)]
    ensembles[1].view.mean += 1.0
    seen, _ = states(20, 4)
    alone = np.concatenate([ensemble.log_odds(seen) for ensemble in ensembles], axis=1)
    np.testing.assert_array_equal(StackedMembers(ensembles).log_odds(seen), alone)
    images = np.random.default_rng(0).integers(256, size=(9, 6, 6, 3), dtype=np.uint8)
    plain = Ensemble("mlp", (6, 6, 3), 3, torch.Generator().manual_seed(0)).eval()
    np.testing.assert_allclose(StackedMembers([plain]).log_odds(images), plain.log_odds(images), atol=1e-5)


@pytest.mark.parametrize("shape", [(4,), (2, 1, 2)])
def test_attributions_to_numbers_are_complete(shape: tuple[int, ...]) -> None:
    """Spec F2: they add up to the difference in log-odds; the number that decides gets the most."""
    ensemble, (seen, _) = trained(shape), states(50, 5, shape)
    baseline = mean_state(ensemble.see(seen))
    assert baseline.shape == shape and baseline.dtype == np.float32
    found = attributed(ensemble, ensemble.see(seen), baseline)
    assert found.values.shape == (50, 2, *shape) and found.completeness_error().max() < 1e-9
    mean = np.abs(found.values).mean(0).reshape(2, 4)
    assert (mean.argmax(1) == 2).all() and (mean[:, 3] == 0).all()
