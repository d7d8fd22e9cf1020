"""The data file: whole or refused in one line (Spec A1, A8, G2)."""

import json
import os
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest
from command_line import fails, refuses, run
from toy_data import SHAPE, write

from hypogoal.core.errors import UserError
from hypogoal.core.hdf5 import fixed, opened
from hypogoal.data import Collected, States, open_dataset, write_dataset

OBSERVATIONS, LABELS = "labelled/one/observations", "labelled/one/labels"
CRASH = """
import h5py, os, sys
file = h5py.File(sys.argv[1], "w", libver="latest")
file["values"] = [1, 2, 3]
file.flush()
os._exit(1)
"""
WRITE = """
import sys
from pathlib import Path
import numpy as np
from hypogoal.data import Collected, States, write_dataset
goals = ("one", "two", "three", "four")
states = States(np.zeros((3, 4, 5, 3), np.uint8), np.eye(3, 4, dtype=np.bool_), {})
collected = Collected((4, 5, 3), goals, states, states, states)
write_dataset(Path(sys.argv[1]), collected, domain="toy", config={}, seed=0)
"""
Damage = Callable[[h5py.File], Any]


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
        assert file[OBSERVATIONS].id == file["labelled/two/observations"].id
    with pytest.raises(UserError, match="unknown sub-goal"):
        dataset.labelled("three")


@pytest.mark.parametrize(
    ("name", "labels", "words"),
    [
        ("../../x", [[True], [False]], "usable as file names"),
        ("a?", [[True], [False]], "usable as file names"),
        ("one", [["True"], ["False"]], "labels are not truth values"),  # NumPy turns 'False' into True
    ],
)
def test_what_is_not_written(tmp_path: Path, name: str, labels: list[Any], words: str) -> None:
    """Spec G2: names become files and groups; nothing is left behind."""
    states = States(np.zeros((2, *SHAPE), np.uint8), np.array(labels))
    collected = Collected(SHAPE, (name,), states, states, states)
    with pytest.raises(UserError, match=words):
        write_dataset(tmp_path / "data.h5", collected, domain="", config={}, seed=0)
    assert not [*tmp_path.iterdir()]


ZEROS = np.zeros((2, 3), np.float32)
UNSORTED = np.zeros((2, 3), [("b", "<f4"), ("a", "|u1")])


@pytest.mark.parametrize(
    ("labelled", "others"),
    [
        (np.zeros((2, 3)), np.zeros((2, 3))),
        (np.zeros((2, 3), ">f4"), np.zeros((2, 3), ">f4")),
        (UNSORTED, UNSORTED),
        (np.zeros((2, 3), np.uint8), ZEROS),
        (np.zeros((2, 4), np.float32), ZEROS),
    ],
)
def test_observations_that_could_not_be_read_are_not_written(tmp_path: Path, labelled: Any, others: Any) -> None:
    """Spec G2: their types and shapes; the author of the domain learns what to give."""
    labels = np.array([True, False])
    sets = [States(observations, labels) for observations in (labelled, others, others)]
    with pytest.raises(UserError, match="domain's labelled observations cannot be stored"):
        write_dataset(tmp_path / "data.h5", Collected((3,), ("one",), *sets), domain="", config={}, seed=0)
    assert not [*tmp_path.iterdir()]


@pytest.mark.parametrize("shape", [(1,), (), (1, 1)])
def test_a_single_number_has_a_name(tmp_path: Path, shape: tuple[int, ...]) -> None:
    states = States(np.zeros((2, *shape), np.float32), np.array([True, False]))
    collected = Collected(shape, ("one",), states, states, states)
    write_dataset(tmp_path / "data.h5", collected, domain="", config={}, seed=0)
    assert open_dataset(tmp_path / "data.h5").features() == ["x[0]"]


def attribute(name: str, value: Any) -> Damage:
    def damage(file: h5py.File) -> None:
        file.attrs[name] = fixed(value) if isinstance(value, str) else value

    return damage


def instead(name: str, **about: Any) -> Damage:
    """Another dataset in place of one; without any the name is missing."""

    def damage(file: h5py.File) -> None:
        del file[name]
        if about:
            file.create_dataset(name, **about)

    return damage


# What is wrong with a data file: how it came to that, and the words for it.
DAMAGES: dict[str, tuple[Damage, str]] = {
    "older": (attribute("format", 1), "format 1, this hypogoal reads 2"),
    "foreign": (lambda file: file.attrs.pop("format"), "not a hypogoal data file"),
    "not complete": (attribute("complete", False), "not complete"),
    "no domain": (lambda file: file.attrs.pop("domain"), "'domain'"),
    "sub-goals that are no JSON": (attribute("sub_goals", "{"), "cannot be read"),
    "names that are none": (attribute("sub_goals", json.dumps(["../x"])), "usable as file names"),
    "a type that is none": (attribute("observation_dtype", "int7"), "int7"),
    "floats": (instead(OBSERVATIONS, data=np.zeros((7, *SHAPE))), f"{OBSERVATIONS} is float64"),
    "another shape": (instead(OBSERVATIONS, data=np.zeros((7, 9), np.uint8)), f"{OBSERVATIONS} is uint8 (7, 9)"),
    "no labels": (instead(LABELS), "'labels'"),
    "too few labels": (instead(LABELS, data=np.zeros(3, np.bool_)), "labels of shape (3,) for 7 states"),
}


@pytest.mark.parametrize("case", DAMAGES)
def test_damaged_files(tmp_path: Path, case: str) -> None:
    """Spec A8, G2: found by ``verify``."""
    damage, words = DAMAGES[case]
    path = write(tmp_path / "data.h5", domain="doorkey")
    with h5py.File(path, "a") as file:
        damage(file)
    assert words in fails("verify", path).out


def test_what_hdf5_would_fill_up_is_refused(tmp_path: Path) -> None:
    """Spec G2: a chunk that was never written, a part that is gone; whole parts are read."""
    path = write(tmp_path / "data.h5")
    before = open_dataset(path).unlabelled()
    for name, change in {"whole": None, "gone": "unlink", "unwritten": "chunk"}.items():
        own, part = tmp_path / f"{name}.h5", tmp_path / f"{name}-part.h5"
        own.write_bytes(path.read_bytes())
        with h5py.File(own, "r+") as file, h5py.File(part, "w") as other:
            stored = other.create_dataset("x", before.shape, before.dtype, chunks=(2, *before.shape[1:]))
            stored[: 2 if change == "chunk" else None] = before[: 2 if change == "chunk" else None]
            layout = h5py.VirtualLayout(before.shape, before.dtype)
            layout[:] = h5py.VirtualSource(part.name, "x", before.shape)
            del file["unlabelled/observations"]
            file.create_virtual_dataset("unlabelled/observations", layout)
        if change == "unlink":
            part.unlink()
        if change:
            with pytest.raises(UserError, match="no such file" if change == "unlink" else "lacks values"):
                open_dataset(own).unlabelled()
        else:
            np.testing.assert_array_equal(open_dataset(own).unlabelled(), before)


def test_a_crashed_programs_file_names_h5clear(tmp_path: Path) -> None:
    """Its data are whole: the HDF5 tools take the mark away that it is open for writing."""
    path = tmp_path / "crashed.h5"
    subprocess.run([sys.executable, "-c", CRASH, path], check=False)
    with pytest.raises(UserError, match=f"h5clear -s {path}"), opened(path):
        pass


def test_a_file_that_is_open_elsewhere_is_not_damaged(tmp_path: Path) -> None:
    """Spec G2: nothing is known to be wrong with it, so nobody is told to collect it again."""
    fcntl = pytest.importorskip("fcntl")
    path = write(tmp_path / "data.h5")
    with path.open("rb") as other:
        fcntl.flock(other, fcntl.LOCK_EX)  # as HDF5 does for who writes
        assert "Collect" not in refuses("is open in another program", "show", path)
    run("verify", path)


@pytest.mark.parametrize("name", [LABELS, "labelled/one/origin/layout_seed", "heldout/one/observations"])
def test_a_changed_byte_is_found(tmp_path: Path, name: str) -> None:
    """Spec A8, G2: of a label or origin, too, though any byte may stand there."""
    path = write(tmp_path / "data.h5")
    with h5py.File(path) as file:
        chunk = file[name].id.get_chunk_info(0)
    whole = bytearray(path.read_bytes())
    whole[chunk.byte_offset + chunk.size // 2] ^= 1
    path.write_bytes(whole)
    assert "cannot be read" in fails("verify", path).out


def test_bytes_do_not_depend_on_the_hashes_of_a_process(tmp_path: Path) -> None:
    """Spec G1: where sub-goals share their states."""
    files = [tmp_path / f"{number}.h5" for number in ("1", "2")]
    for file in files:
        command = [sys.executable, "-c", WRITE, str(file)]
        subprocess.run(command, env={**os.environ, "PYTHONHASHSEED": file.stem}, check=True)
    assert files[0].read_bytes() == files[1].read_bytes()
