"""NumPy arrays and tables of labels become a data file; what is wrong with them is one line (Spec B3, B6, G2)."""

import re
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest
from command_line import refuses, run

from hypogoal.core.errors import UserError
from hypogoal.data import open_dataset
from hypogoal.importing.assemble import held_out
from hypogoal.observations import digest
from tests.importing.states import arrays, assembled, pictures
from tests.mixed import FRONT, GOAL, STATE
from tests.mixed import arrays as mixed_arrays


def test_several_sub_goals_come_out_as_they_went_in(tmp_path: Path) -> None:
    """Spec B6: labels (N, G), a folder of .npy files, names among the arrays."""
    labels = np.stack([np.arange(40) % 2, np.arange(40) % 3 == 0], axis=1)
    folder = tmp_path / "folder"
    folder.mkdir()
    for name, values in arrays(labels=labels, heldout_labels=np.stack([np.arange(16) % 2] * 2, 1)).items():
        np.save(folder / f"{name}.npy", values)
    data = tmp_path / "data.h5"
    run("import", folder, "--out", data, "--sub-goal", "odd", "--sub-goal", "third", "-q")
    found = open_dataset(data)
    for number, goal in enumerate(("odd", "third")):
        np.testing.assert_array_equal(found.labelled(goal).observations, arrays()["observations"])
        np.testing.assert_array_equal(found.labelled(goal).labels, labels[:, number])
    np.savez(
        tmp_path / "own.npz",
        **arrays(labels=labels, sub_goals=["a", "b"], heldout_observations=None, heldout_labels=None),
    )
    run("import", tmp_path / "own.npz", "--out", data, "--force", "-q")
    assert open_dataset(data).sub_goals == ("a", "b")


def test_cameras_and_numbers_by_key(tmp_path: Path) -> None:
    """Spec B6, H6: arrays by key; pictures are resized each, numbers stay."""
    np.savez(tmp_path / "own.npz", **mixed_arrays())
    data = tmp_path / "data.h5"
    for words, front, wrist in ((["--resize", "32"], (24, 32, 3), (32, 32, 3)), ([], FRONT, (44, 44, 3))):
        run("import", tmp_path / "own.npz", "--out", data, "--force", "-q", *words)
        dtype = open_dataset(data).observation_dtype
        assert (dtype["front"].shape, dtype["wrist"].shape, dtype["state"].shape) == (front, wrist, STATE)
    found = open_dataset(data).unlabelled()
    for key in ("front", "wrist", "state"):
        np.testing.assert_array_equal(found[key], mixed_arrays()[f"unlabelled/{key}"].reshape(found[key].shape))


def test_a_share_is_held_out_where_nothing_else_is_given(tmp_path: Path) -> None:
    """Spec B3: of each class, and it is said that this tells nothing of other contexts."""
    np.savez(tmp_path / "own.npz", **arrays(heldout_observations=None, heldout_labels=None))
    data = tmp_path / "data.h5"
    said = run("import", tmp_path / "own.npz", "--out", data, "--heldout", "0.25", "-q")
    assert "says nothing about other contexts" in said.err
    counts = open_dataset(data).counts()
    assert counts["heldout"]["sub-goal"] == {"states": 10, "positives": 5}
    assert counts["labelled"]["sub-goal"] == {"states": 30, "positives": 15}


def test_a_share_is_held_out_of_many_small_groups_too() -> None:
    """Spec B3: what is too little of one combination of labels goes on to the next; never all of one, never nothing."""
    labels = np.array([[bit >> goal & 1 for goal in range(6)] for bit in range(64)] * 2, dtype=np.bool_)
    table = pd.DataFrame({"group": "", "look": map(str, range(128))})
    chosen = held_out(labels, table, 0.2, seed=0)
    assert chosen.sum() == 26
    assert len({tuple(row) for row in labels[~chosen].tolist()}) == 64
    rare = np.arange(30) == 7
    assert not held_out(rare[:, None], table[:30], 0.9, seed=0)[7]
    with pytest.raises(UserError, match=r"none of 64 labelled states, or groups of them, can be"):
        held_out(labels[:64], table[:64], 0.2, seed=0)


def test_a_group_is_held_out_whole_or_not_at_all(tmp_path: Path) -> None:
    """Spec B3: by an array of their names; unlabelled states of held-out groups are left out."""
    given = arrays(heldout_observations=None, heldout_labels=None)
    given |= {"take": np.arange(40) // 4, "unlabelled_take": np.arange(20) % 10}
    np.savez(tmp_path / "own.npz", **given)
    data = tmp_path / "data.h5"
    run("import", tmp_path / "own.npz", "--out", data, "--group", "take", "-q")
    found = open_dataset(data)
    rows = {state.tobytes(): row for row, state in enumerate(given["observations"])}
    held = {rows[state.tobytes()] // 4 for state in found.heldout("sub-goal").observations}
    learned = {rows[state.tobytes()] // 4 for state in found.labelled("sub-goal").observations}
    assert len(held) == 2 and held | learned == set(range(10)) and not held & learned
    assert len(found.unlabelled()) == 20 - 2 * len(held)
    labelled = found.labelled("sub-goal")
    takes = [rows[state.tobytes()] // 4 for state in labelled.observations]
    assert len({*zip(takes, labelled.origins["group"].tolist(), strict=True)}) == len({*takes})
    refuses("no such array: tape", "import", tmp_path / "own.npz", "--out", tmp_path / "x.h5", "--group", "tape")
    with pytest.raises(UserError, match="none of 40 labelled states, or groups of them, can be held out"):
        assembled(given | {"take": np.zeros(40)}, "take")


def test_arrays_that_are_not_read_are_said() -> None:
    given = arrays(rewards=np.zeros(3))
    assert {*assembled(given | {"labels/front": np.zeros(40)})[1]} == {"array 'labels/front'", "array 'rewards'"}


def test_held_out_states_that_are_known_are_left_out() -> None:
    """Spec B3: members are not judged by what they learned; how many were left out is said."""
    (images, _), (others, _), (held, known) = pictures(40), pictures(20, 1), pictures(16, 2)
    mixed = arrays(
        heldout_observations=np.concatenate([images[:3], held, others[:4]]),
        heldout_labels=np.concatenate([[0, 1, 0], known, [0, 1, 0, 1]]),
    )
    collected, said = assembled(mixed)
    assert said[0].startswith("7 of 23 heldout states look like labelled or unlabelled ones")
    np.testing.assert_array_equal(collected.heldout.observations, held)
    np.testing.assert_array_equal(collected.heldout.labels[:, 0], known)
    with pytest.raises(UserError, match=r"no heldout states: .* 40 of 40 heldout states look like"):
        assembled(mixed | {"heldout_observations": images, "heldout_labels": arrays()["labels"]})


def test_equal_states_with_both_labels_are_told() -> None:
    """Spec B6: labelled or held out, two named; a class that has no state of its own is refused."""
    (images, labels), (held, known) = pictures(40), pictures(16, 2)
    line = "1 times equal states have both labels of goal: no member can be right about observations[{}] and {}[{}]"
    twice = {"observations": np.concatenate([images, images[8:9]]), "labels": np.append(labels, True)}
    assert assembled(arrays(**twice))[1][0] == line.format(8, "observations", 40)
    late = {"heldout_observations": np.concatenate([held, images[8:9]]), "heldout_labels": np.append(known, True)}
    assert assembled(arrays(**late))[1][0] == line.format(8, "heldout_observations", 16)
    for kind, chosen in (("positives", labels), ("negatives", ~labels)):
        every = np.concatenate([images, images[chosen]]), np.append(labels, ~labels[chosen])
        with pytest.raises(UserError, match=f"goal has no {kind} .* without those .* both labels.* Remove the cop"):
            assembled(arrays(observations=every[0], labels=every[1]))


def test_what_looks_alike_is_held_out_together() -> None:
    """Spec B3: from the unlabelled states too."""
    (images, labels), (others, _) = pictures(20), pictures(10, 1)
    given = {"observations": np.tile(images, (3, 1, 1, 1)), "labels": np.tile(labels, 3)}
    collected, said = assembled(given | {"unlabelled": np.concatenate([others, images])})
    sets = [collected.labelled, collected.unlabelled, collected.heldout]
    known = [{image.tobytes() for image in one.observations} for one in sets]
    assert [len(one.labels) for one in sets] == [48, 26, 12] and [len(one) for one in known] == [16, 26, 4]
    assert not (known[0] | known[1]) & known[2]
    assert said[1].startswith("4 of 30 unlabelled states look like heldout ones")
    with pytest.raises(UserError, match=r"no unlabelled states: .* 12 of 12 unlabelled states look like heldout ones"):
        assembled(given | {"unlabelled": collected.heldout.observations})


COUNTS = {"observations": 40, "unlabelled": 20, "heldout_observations": 16}  # what arrays() has
WRONG: list[tuple[dict[str, Any], str]] = [
    ({"unlabelled": None}, "no unlabelled states"),
    ({"labels": None}, "labels of 40 labelled states and 1 sub-goals are not 0 or 1 for each"),
    ({"observations/state": np.zeros((39, 4), np.float32)}, "39 states of 'state', 40 of others: observations"),
    ({"observations/a.b": np.zeros((40, 2)), "observations/a/b": np.ones((40, 2))}, "two keys have one name"),
    ({f"{name}/x": np.zeros((count, 2)) for name, count in COUNTS.items()}, "can be file names"),
    ({"observations": np.zeros((40, 5), complex)}, "these are neither pictures nor numbers: observations"),
    ({"unlabelled": np.zeros((20, 5), "M8[s]")}, "these are neither pictures nor numbers: unlabelled"),
    ({"observations": np.array(5)}, "labels of 1 labelled states"),
    ({"unlabelled/arm": np.zeros((20, 4), np.float32)}, "episodes have different observations"),
    (
        {"observations/state": np.full((40, 4), np.nan)},
        "state have values .* not finite: 4 columns, such as 0, 1, 2, 3",
    ),
    ({"observations/front": np.zeros((40, 3, 48, 48), np.uint8)}, r"observations\[0\] front have their channels"),
    ({"observations": pictures(40)[0] / 255}, "could be pictures or numbers: float64"),
    ({"features": np.array(["a"])}, "1 names of features do not fit"),
    ({"observations": pictures(40)[0].transpose(0, 3, 1, 2)}, r"frames, first.*import --stack"),
    ({"unlabelled": np.zeros((60, 12, 48, 48), np.uint8)}, r"frames, first: uint8 \(12, 48, 48\)"),
    ({"observations": np.zeros((40, 0), np.uint8)}, "neither pictures nor numbers"),
    ({"unlabelled": np.zeros((5, 9, 9, 3), np.uint8)}, "states differ in size or type"),
    ({"unlabelled": pictures(0)[0]}, "there are no unlabelled states"),
    ({"labels": np.arange(40) % 3}, "are not 0 or 1 for each: int64"),
    ({"labels": np.zeros(40)}, "has no positives among 40 labelled states"),
    ({"labels": np.ones(40)}, "has no negatives among 40 labelled states"),
    ({"labels": np.stack([np.arange(40) % 2] * 2, 1)}, "and 1 sub-goals are not 0 or 1 .* --sub-goal NAME for each"),
]


@pytest.mark.parametrize(("changes", "message"), WRONG)
def test_what_is_wrong_with_arrays_is_one_line(changes: dict[str, Any], message: str) -> None:
    """Spec G2: names, shapes, types, label values; arrays by key are checked as one is."""
    by_key = any("/" in name and not name.endswith("/x") for name in changes)
    given = mixed_arrays() | changes if by_key else arrays(**changes)
    with pytest.raises(UserError, match=message):
        assembled(given)


def test_files_that_numpy_does_not_write_are_one_line(tmp_path: Path) -> None:
    """Spec G2: no zip file, a damaged one, a pickle, a pointer of Git LFS, none at all; nothing is written."""
    file, out = tmp_path / "own.npz", tmp_path / "data.h5"
    np.savez(file, **arrays())
    whole = bytearray(file.read_bytes())
    whole[2000:4000] = bytes(2000)
    pickle = tmp_path / "pickle.npz"
    np.savez(pickle, labels=np.array([None] * 40))
    folder = tmp_path / "folder"
    folder.mkdir()
    for name, values in arrays().items():
        np.save(folder / f"{name}.npy", values)
        (folder / f"._{name}.npy").write_bytes(b"Mac OS X")
    (folder / "notes.txt").write_text("x")
    assert "not read: 1 .txt" in run("import", folder, "--out", tmp_path / "folder.h5", "-q").err
    (folder / "labels.npy").write_bytes(b"no array")
    refuses("labels.npy", "import", folder, "--out", out)
    pointer = b"version https://git-lfs.github.com/spec/v1\noid sha256:4d7a2146\n"
    for data, said in (
        (b"PK" + b"x" * 100, "this cannot be read"),
        (bytes(whole), "this cannot be read"),
        (pickle.read_bytes(), "allow_pickle=False"),
        (pointer, "git lfs pull"),
    ):
        file.write_bytes(data)
        refuses(said, "import", file, "--out", out)
    refuses("no such file or folder", "import", tmp_path / "nowhere.npz", "--out", out)
    refuses("arrays and pictures have --sub-goal NAME", "import", pickle, "--out", out, "--label", "a=rewards")


@pytest.fixture
def data(mixed_run: Path) -> Path:
    return mixed_run / "data.h5"


def table(data: Path, count: int) -> str:
    """The first states labelled, 0 and 1 in turn."""
    states = open_dataset(data).unlabelled()
    rows = [f"{row},{digest(state).hex()},{row % 2 if row < count else ''}" for row, state in enumerate(states)]
    return "\n".join(["row,digest,label", *rows, ""])


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (lambda text: text.replace(",", ";"), "cannot be read (ValueError: Usecols do not match columns"),
        (lambda text: text.replace("row,digest", "row,sum"), "whose first line names label, digest"),
        (lambda text: text + text.splitlines()[1] + "\n", "Give states of these data, each once"),
        (lambda text: re.sub(r"(?m)^0,....", "0,0000", text), "audit an ensemble of these data again"),
        (lambda text: text.replace(",1\n", ",yes\n"), "cannot be read (KeyError: 'yes')"),
        (lambda _: "", "cannot be read"),
    ],
)
def test_a_table_of_other_states_is_one_line(data: Path, tmp_path: Path, change, said: str) -> None:
    (tmp_path / "table.csv").write_text(change(table(data, 8)))
    refuses(said, "import", data, "--label", f"{GOAL}={tmp_path / 'table.csv'}", "--out", tmp_path / "more.h5", "-q")


def test_a_table_saved_by_a_spreadsheet_is_read(data: Path, tmp_path: Path) -> None:
    marks = tmp_path / "table.csv"
    marks.write_bytes(table(data, 4).replace("\n", "\r\n").encode("utf-8-sig"))
    run("import", data, "--label", f"{GOAL}={marks}", "--out", tmp_path / "more.h5", "-q")
    before, after = open_dataset(data), open_dataset(tmp_path / "more.h5")
    np.testing.assert_array_equal(after.unlabelled(), before.unlabelled()[4:])
    states = after.labelled(GOAL)
    np.testing.assert_array_equal(states.observations[-4:], before.unlabelled()[:4])
    assert states.labels[-4:].tolist() == [False, True, False, True]
    refuses("labels data of one sub-goal", "import", data, "--label", f"shut={marks}", "--out", tmp_path / "x.h5")


def test_equal_states_get_one_label(tmp_path: Path) -> None:
    others, _ = pictures(3, seed=1)
    places = [0, 1, 1, 2, 1]
    np.savez(tmp_path / "own.npz", **arrays(unlabelled=others[places]))
    run("import", tmp_path / "own.npz", "--out", tmp_path / "data.h5", "--sub-goal", "on", "-q")
    marks = tmp_path / "table.csv"
    marks.write_text(f"digest,label\n{digest(others[1]).hex()},1\n{digest(others[0]).hex()},0\n")
    said = run("import", tmp_path / "data.h5", "--label", f"on={marks}", "--out", tmp_path / "more.h5", "-q").err
    assert "4 states are labelled now, 1 are not" in said
    after = open_dataset(tmp_path / "more.h5")
    np.testing.assert_array_equal(after.unlabelled(), others[2:])
    states = after.labelled("on")
    np.testing.assert_array_equal(states.observations[-4:], others[[1, 1, 1, 0]])
    assert states.labels[-4:].tolist() == [True, True, True, False]
