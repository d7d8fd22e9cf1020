"""The data file: whole or refused in one line (Spec A1, A8, G2)."""

from pathlib import Path

import h5py
import numpy as np
import pytest
from command_line import refuses, run
from toy_data import write

from hypogoal.core.errors import UserError
from hypogoal.data import Collected, States, open_dataset, write_dataset


def test_what_was_written_is_read(tmp_path: Path) -> None:
    """Spec A1: three sets, a label column per sub-goal, origins; unlabelled states without labels."""
    path = write(tmp_path / "data.h5")
    dataset = open_dataset(path)
    assert dataset.sub_goals == ("one", "two") and dataset.domain == "toy" and dataset.config == {"a": 1}
    assert dataset.labelled("one").observations.shape == (7, 4, 5, 3)
    np.testing.assert_array_equal(dataset.labelled("one").observations, dataset.labelled("two").observations)
    assert (dataset.labelled("one").labels != dataset.labelled("two").labels).any()
    np.testing.assert_array_equal(dataset.heldout("two").origins["layout_seed"], np.arange(7))
    with h5py.File(path) as file:
        assert set(file["unlabelled"]) == {"observations", "origin"}
    with pytest.raises(UserError, match="unknown sub-goal"):
        dataset.labelled("three")


def test_a_file_that_is_open_elsewhere_is_not_damaged(tmp_path: Path) -> None:
    """Spec G2: nothing is known to be wrong with it, so nobody is told to collect it again."""
    fcntl = pytest.importorskip("fcntl")
    path = write(tmp_path / "data.h5")
    with path.open("rb") as other:
        fcntl.flock(other, fcntl.LOCK_EX)  # as HDF5 does for who writes
        assert "Collect" not in refuses("is open in another program", "show", path)
    run("verify", path)


def test_some_heldout_states_are_of_both_classes_and_as_in_the_file(tmp_path: Path) -> None:
    """So many of each class, or all there are, of every part of the file."""
    rng = np.random.default_rng(0)
    images = rng.integers(0, 256, size=(3_000, 4, 5, 3), dtype=np.uint8)
    labels = np.stack([rng.random(3_000) < 0.02, np.zeros(3_000, np.bool_)], axis=1)
    states = States(images, labels, {"layout_seed": np.arange(3_000)})
    write_dataset(
        tmp_path / "data.h5",
        Collected((4, 5, 3), ("rare", "never"), states, states, states),
        domain="",
        config={},
        seed=0,
    )
    dataset = open_dataset(tmp_path / "data.h5")
    some = dataset.some_heldout("rare", 40)
    rows = some.origins["layout_seed"]
    np.testing.assert_array_equal(some.observations, images[rows])
    np.testing.assert_array_equal(some.labels, labels[rows, 0])
    assert some.labels.sum() == (~some.labels).sum() == 40 and rows[0] < 300 and rows[-1] > 2_700
    assert len(dataset.some_heldout("never", 40).labels) == 40
    assert dataset.some_heldout("rare", 10_000).labels.sum() == labels[:, 0].sum()
