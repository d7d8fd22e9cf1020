"""Members on observations that are no pictures (Spec C2, C5, F2)."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from hypogoal.core.errors import UserError
from hypogoal.hypotheses.config import EnsembleConfig
from hypogoal.hypotheses.deep_lift import attributed, mean_state
from hypogoal.hypotheses.ensemble import Ensemble, read_ensemble, write_ensemble
from hypogoal.hypotheses.stacked import StackedMembers
from hypogoal.hypotheses.training import train

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
