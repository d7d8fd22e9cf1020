"""The data file: whole or refused in one line (Spec A1, A8, G2)."""

import subprocess
import sys
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest

from hypogoal.cli import main
from hypogoal.core.errors import UserError
from hypogoal.core.hdf5 import set_attribute
from hypogoal.dataset import Collected, States, open_dataset, write_dataset
from hypogoal.inspection import faults_of


def write(path: Path) -> Path:
    rng = np.random.default_rng(0)

    def states(count: int) -> States:
        images = rng.integers(0, 256, size=(count, 4, 5, 3), dtype=np.uint8)
        return States(images, rng.random((count, 2)) < 0.5, {"layout_seed": np.arange(count)})

    collected = Collected((4, 5, 3), ("one", "two"), states(7), states(5), states(6))
    write_dataset(path, collected, domain="toy", config={"a": 1}, seed=3)
    return path


def test_what_was_written_is_read(tmp_path: Path) -> None:
    """Spec A1: three sets, a label column per sub-goal, origins; unlabelled states without labels."""
    path = write(tmp_path / "data.h5")
    dataset = open_dataset(path)
    assert dataset.sub_goals == ("one", "two") and dataset.domain == "toy" and dataset.config == {"a": 1}
    assert dataset.labelled("one").observations.shape == (7, 4, 5, 3)
    np.testing.assert_array_equal(dataset.labelled("one").observations, dataset.labelled("two").observations)
    assert (dataset.labelled("one").labels != dataset.labelled("two").labels).any()
    np.testing.assert_array_equal(dataset.heldout("two").origins["layout_seed"], np.arange(6))
    with h5py.File(path) as file:
        assert set(file["unlabelled"]) == {"observations", "origin"}
    with pytest.raises(UserError, match="unknown sub-goal"):
        dataset.labelled("three")


@pytest.mark.parametrize(
    ("attribute", "value", "words"),
    [
        ("format", 99, "newer"),
        ("format", "x", "not a hypogoal data file"),
        ("format", 1, "earlier"),
        ("complete", False, "not complete"),
        ("domain", None, "not a hypogoal data file"),
        ("sub_goals", "{", "not a hypogoal data file"),
        ("observation_shape", '"x"', "not a hypogoal data file"),
        ("config", None, "not a hypogoal data file"),
    ],
)
def test_foreign_and_damaged_attributes(tmp_path: Path, attribute: str, value: Any, words: str) -> None:
    """Spec G2: one clear line."""
    path = write(tmp_path / "data.h5")
    with h5py.File(path, "a") as file:
        file.attrs.pop(attribute, None)
        if value is not None:
            set_attribute(file, attribute, value)
    with pytest.raises(UserError, match=words) as caught:
        open_dataset(path)
    assert "\n" not in str(caught.value)


def test_missing_parts_and_other_files(tmp_path: Path) -> None:
    """Spec G2: a file that lost a dataset, an empty file, a text."""
    path = write(tmp_path / "data.h5")
    with h5py.File(path, "a") as file:
        del file["heldout/two/labels"]
    with pytest.raises(UserError, match="no readable 'heldout/two/labels'"):
        open_dataset(path).heldout("two")
    (tmp_path / "text.h5").write_text("hello")
    with pytest.raises(UserError, match="truncated or not HDF5"):
        open_dataset(tmp_path / "text.h5")


def test_a_file_that_was_cut_off_is_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Spec G2: wherever it ends, one line says to collect it again."""
    path = write(tmp_path / "data.h5")
    data = path.read_bytes()
    for length in np.random.default_rng(0).integers(0, len(data), size=40):
        path.write_bytes(data[:length])
        assert main(["verify", str(path)]) == 2
        said = capsys.readouterr()
        assert said.err == "" and said.out.endswith(f"is truncated or not HDF5: {path}. Collect it again.\n")


def test_a_file_that_is_open_elsewhere_is_not_damaged(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Spec G2: nothing is known to be wrong with it, so nobody is told to collect it again."""
    fcntl = pytest.importorskip("fcntl")
    path = write(tmp_path / "data.h5")
    with path.open("rb") as other:
        fcntl.flock(other, fcntl.LOCK_EX)  # as HDF5 does for who writes
        assert main(["show", str(path)]) == 2
        line = capsys.readouterr().err
        assert "is open in another program" in line and "Collect" not in line
    assert main(["verify", str(path)]) == 0


@pytest.mark.parametrize("name", ["labelled/two/labels", "labelled/one/origin/layout_seed", "heldout/one/observations"])
def test_a_changed_byte_is_found(tmp_path: Path, name: str) -> None:
    """Spec A8, G2: a label or origin, too, though any byte may stand there; files without checksums are read."""
    path = write(tmp_path / "data.h5")
    with h5py.File(path, "r+") as file:
        plain = file["unlabelled/origin/layout_seed"][()]
        del file["unlabelled/origin/layout_seed"]
        file["unlabelled/origin/layout_seed"] = plain  # as of an earlier version
        chunk = file[name].id.get_chunk_info(0)
    assert faults_of(path) == []
    whole = path.read_bytes()
    place = chunk.byte_offset + chunk.size // 2
    path.write_bytes(whole[:place] + bytes([whole[place] ^ 1]) + whole[place + 1 :])
    assert name in " ".join(faults_of(path))


@pytest.mark.parametrize(
    "first",
    [
        "import gymnasium, hypogoal",
        "import hypogoal, gymnasium",
        "import hypogoal; from gymnasium import spaces",
        "import hypogoal, importlib.util; assert importlib.util.find_spec('gymnasium')",
        "import hypogoal; hypogoal.load_ensemble",
        "import hypogoal; hypogoal.GymnasiumDomain",
        "import hypogoal; hypogoal.SubgoalReward",
        "import hypogoal.domains.doorkey",
        "import hypogoal.domains.montezuma",
    ],
)
def test_the_environment_is_registered_in_a_fresh_interpreter(first: str) -> None:
    """Spec B1: the README's example works where nothing else was imported, and whatever first wants Gymnasium."""
    code = f"{first}; import gymnasium; print(gymnasium.make('hypogoal/DoorKey-8x8-v0').observation_space.shape)"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert done.stdout.strip() == "(64, 64, 3)", done.stderr


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
