"""What a training step will take is measured on the real network, and holds for batches that were not tried."""

import re
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from hypogoal.core import preflight
from hypogoal.core.errors import UserError
from hypogoal.dataset import Collected, States, write_dataset
from hypogoal.hypotheses.config import EnsembleConfig, TrainEnsembleConfig
from hypogoal.hypotheses.networks import at_once
from hypogoal.hypotheses.trial import step_cost
from hypogoal.needs import ensemble_needs

MAY_DIFFER = 1.3  # times
BATCH = 32


def noise(*shape: int) -> NDArray[np.uint8]:
    return np.random.default_rng(0).integers(0, 256, shape, dtype=np.uint8)


@pytest.mark.parametrize(
    "config",
    [
        EnsembleConfig(batch_size=BATCH),
        EnsembleConfig(batch_size=BATCH, schedule="sequential"),
        EnsembleConfig(batch_size=BATCH, network="tiles", view="agent-crop", jitter=2, augment="grey"),
        EnsembleConfig(batch_size=BATCH, members=1),
    ],
    ids=["separate", "sequential", "windows", "one member"],
)
def test_two_small_batches_say_what_a_large_one_takes(config: EnsembleConfig) -> None:
    """Spec G1: for every way to train, as much as was measured where the true batch was tried."""
    states = noise(8, 56, 56, 3)
    small, whole = (step_cost(states, config, seconds) for seconds in (0.0, 60.0))
    said, measured = (cost.memory + BATCH * cost.memory_each for cost in (small, whole))
    assert measured / MAY_DIFFER < said < MAY_DIFFER * measured
    assert small.seconds + small.seconds_each > 0


def test_members_and_numbers_count() -> None:
    """Spec G1: members with networks of their own take that much each; observations may be numbers."""
    numbers = np.random.default_rng(0).normal(size=(8, 12)).astype(np.float32)
    three, six = (step_cost(numbers, EnsembleConfig(members=count, batch_size=2)) for count in (3, 6))
    assert six.weights == 2 * three.weights > 0


def test_what_does_not_fit_is_refused_with_what_would(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Spec G1: a smaller batch and smaller pictures are named, where they fit; nothing that does not."""
    pictures, labels = noise(8, 240, 320, 3), np.arange(4)[:, None] % 2 == 0
    labelled, unlabelled = States(pictures[:4], labels), States(pictures[4:], labels[:, :0])
    write_dataset(
        tmp_path / "data.h5",
        Collected((240, 320, 3), ("goal",), labelled, unlabelled, labelled),
        domain="imported",
        config={},
        seed=0,
    )
    for name, text in (("max", 1_500_000_000), ("current", 0), ("stat", "file 0\n")):
        (tmp_path / f"memory.{name}").write_text(str(text))
    monkeypatch.setattr(preflight, "_folders", lambda: [tmp_path])
    data = tmp_path / "data.h5"

    def needs(config: TrainEnsembleConfig) -> preflight.Needs:
        return ensemble_needs(data, [data], config, steps=10, workers=1, device="cpu")

    with pytest.raises(UserError, match="not enough memory") as refused:
        preflight.preflight("train-ensemble", tmp_path / "out", needs(TrainEnsembleConfig()))
    assert "--resize 160" in str(refused.value)
    named = re.search(r"--set batch_size=(\d+)", str(refused.value))
    assert named
    (tmp_path / "memory.max").write_text("1600000000")  # this process has grown meanwhile
    preflight.preflight("train-ensemble", tmp_path / "out", needs(TrainEnsembleConfig(batch_size=int(named[1]))))


def test_large_states_are_looked_at_a_few_at_once() -> None:
    """64 pictures of 480 x 640 took 1.5 GB inside a member; of small ones as many as ever."""
    assert [at_once(64, shape) for shape in ((84, 84, 4), (480, 640, 3), (9000, 9000, 3))] == [64, 18, 1]
