"""What can be saved of a cut-off data file (Spec G2): whole groups, the original kept."""

import json
from pathlib import Path
from types import SimpleNamespace

import h5py
import numpy as np
import pytest
from toy_data import write

from hypogoal.cli import main
from hypogoal.core.errors import UserError
from hypogoal.dataset import open_dataset
from hypogoal.repair import _last_byte, repair


def part_begins(path: Path, name: str) -> int:
    """The first byte of a dataset's values."""
    with h5py.File(path) as file:
        return int(file[name].id.get_chunk_info(0).byte_offset)


def test_a_cut_off_file_keeps_its_whole_groups(tmp_path: Path) -> None:
    """Spec G2: cut within the held-out states: labelled ones come back bit by bit; the file as it was is kept."""
    path = write(tmp_path / "data.h5", states=40)
    whole = open_dataset(path).labelled("two")
    data = path.read_bytes()[: part_begins(path, "heldout/one/observations") + 10]
    path.write_bytes(data)
    with pytest.raises(UserError, match=r"truncated or not HDF5.*--repair"):
        open_dataset(path)
    saved = repair(path)
    assert saved.kept == ("labelled/one", "labelled/two") and saved.original.read_bytes() == data
    dataset = open_dataset(path)
    assert dataset.lost == ("unlabelled", "heldout/one", "heldout/two") and dataset.domain == "toy"
    back = dataset.labelled("two")
    np.testing.assert_array_equal(back.observations, whole.observations)
    np.testing.assert_array_equal(back.labels, whole.labels)
    np.testing.assert_array_equal(back.origins["layout_seed"], whole.origins["layout_seed"])
    assert dataset.counts()["labelled"]["one"]["states"] == 40 and dataset.counts()["unlabelled"] == 0
    with h5py.File(path) as file:  # still one dataset on disk for both
        assert file["labelled/one/observations"] == file["labelled/two/observations"]
    with pytest.raises(UserError, match="no readable 'heldout/one/observations'"):
        dataset.heldout("one")
    assert sorted(file.name for file in tmp_path.iterdir()) == ["data.h5", "data.h5.damaged"]


def test_a_file_that_is_open_elsewhere_is_not_damaged(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Spec G2: nothing is known to be wrong with it, so nothing is repaired or moved."""
    fcntl = pytest.importorskip("fcntl")
    path = write(tmp_path / "data.h5", states=4)
    with path.open("rb") as other:
        fcntl.flock(other, fcntl.LOCK_EX)  # as HDF5 does for who writes
        for arguments in (["show"], ["verify", "--repair"]):
            assert main([*arguments, str(path)]) == 2
            line = capsys.readouterr().err
            assert "is open in another program" in line and "--repair" not in line
    assert [file.name for file in tmp_path.iterdir()] == ["data.h5"] and main(["verify", str(path)]) == 0


def test_every_cut_is_repaired_or_refused(tmp_path: Path) -> None:
    """Spec G2: wherever the file ends, what is saved is what was there, and the original stays."""
    whole = write(tmp_path / "whole.h5", states=12)
    want = open_dataset(whole).labelled("one").observations
    data = whole.read_bytes()
    rng = np.random.default_rng(0)
    repaired = 0
    for length in rng.integers(0, len(data), size=40):
        path = tmp_path / "cut.h5"
        path.write_bytes(data[:length])
        try:
            saved = repair(path)
        except UserError as error:
            refused = str(error)
        else:
            refused = ""
        if refused:
            assert path.read_bytes() == data[:length] and "\n" not in refused
            continue
        repaired += 1
        np.testing.assert_array_equal(open_dataset(path).labelled("one").observations, want)
        assert saved.original.read_bytes() == data[:length]
    assert repaired > 5


def test_a_killed_collection_is_repaired(tmp_path: Path) -> None:
    """Spec G1, G2: flushed groups of a file without its mark are whole."""
    path = write(tmp_path / "data.h5", states=10)
    with h5py.File(path, "a") as file:
        del file.attrs["complete"], file["unlabelled"]
    assert repair(path).lost == ("unlabelled",)
    assert open_dataset(path).heldout("one").labels.shape == (10,)


def test_the_command(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Spec G2: a whole file is left alone; what was lost stays a fault, exit code 2; text is refused."""
    path = write(tmp_path / "data.h5", states=12)
    assert main(["verify", str(path)]) == 0
    assert main(["verify", str(path), "--repair"]) == 2
    assert "nothing to repair" in capsys.readouterr().err
    path.write_bytes(path.read_bytes()[: part_begins(path, "unlabelled/observations")])
    assert main(["verify", str(path), "--repair", "--json"]) == 2
    about = json.loads(capsys.readouterr().out)
    assert about["lost"] == ["unlabelled"] and about["original"].endswith("data.h5.damaged")
    assert about["faults"] == [f"{path}: unlabelled was cut off, the rest was saved"]
    (tmp_path / "text").write_text("hello")
    assert main(["verify", str(tmp_path / "text"), "--repair"]) == 2
    assert "not HDF5" in capsys.readouterr().err


def test_chunks_are_looked_at_once_each(tmp_path: Path) -> None:
    """Spec G2: HDF5 finds the one of a number by counting from the first, so 60,000 of them took hours."""
    with h5py.File(tmp_path / "chunks.h5", "w") as file:
        made = file.create_dataset("x", data=np.ones(300, "u1"), chunks=(1,))
        ends = [info.byte_offset + info.size for info in map(made.id.get_chunk_info, range(300))]
        without_numbers = SimpleNamespace(get_num_chunks=made.id.get_num_chunks, chunk_iter=made.id.chunk_iter)
        assert _last_byte(SimpleNamespace(chunks=made.chunks, id=without_numbers)) == max(ends)
