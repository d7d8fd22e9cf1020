"""Contradictory labels, and tables of labels of a data file (Spec B3, B6)."""

from __future__ import annotations

import re
import shutil
from pathlib import Path

import numpy as np
import pytest
from command_line import fails, refuses, run, settings

from hypogoal.core.errors import UserError
from hypogoal.data import open_dataset
from hypogoal.observations import digest
from tests import mixed
from tests.importing.states import arrays, assembled, pictures, save_pictures


def warned_of(**changes: np.ndarray) -> list[str]:
    return assembled(arrays(**changes))[1]


def test_pictures_with_both_labels_are_counted_and_two_named(tmp_path: Path) -> None:
    """Spec B6: of files by their names, of arrays by their rows, of each sub-goal; the import goes on."""
    folder = save_pictures(tmp_path / "at-right")
    for name in ("01", "03", "05"):
        shutil.copy(folder / "positive" / f"{name}.png", folder / "negative" / f"copy-{name}.png")
    said = run("import", folder, "--out", tmp_path / "data.h5", "-q").err
    assert "3 times equal states have both labels of at-right: no member can be right about positive/" in said
    assert " and negative/copy-0" in said
    assert open_dataset(tmp_path / "data.h5").counts()["labelled"]["at-right"] == {"states": 27, "positives": 12}
    images, labels = pictures(40)
    twice = {"observations": np.concatenate([images, images[7:8]]), "labels": np.append(labels, not labels[7])}
    alike = "observations[7] and observations[40]"
    text = f"1 times equal states have both labels of goal: no member can be right about {alike}"
    assert warned_of(**twice) == [text]
    rows = np.random.default_rng(0).normal(size=(76, 5))
    rows[20] = rows[1]
    lines = warned_of(observations=rows[:40], unlabelled=rows[40:60], heldout_observations=rows[60:])
    assert any("both labels of goal: no member can be right about observations[1] and" in line for line in lines)


def test_labelled_and_held_out_pictures_contradict_each_other_too() -> None:
    """Spec B6: a held-out copy is left out, as ever; that its label was another is said."""
    (images, _), (held, known) = pictures(40), pictures(16, 2)
    warned = warned_of(heldout_observations=np.concatenate([held, images[:2]]), heldout_labels=np.append(known, [1, 1]))
    alike = "observations[0] and heldout_observations[16]"
    assert warned == [
        f"1 times equal states have both labels of goal: no member can be right about {alike}",
        "2 of 18 held-out states look like ones to learn from: they are left out",
    ]


@pytest.mark.parametrize("only", [True, False])
def test_a_class_without_a_picture_of_its_own_is_refused(only: bool) -> None:
    """Spec B6, G2: every positive, or negative, a copy of some other."""
    images, labels = pictures(40)
    kept = labels if only else ~labels
    copied = {"observations": np.concatenate([images, images[kept]]), "labels": np.append(labels, ~labels[kept])}
    kind = "positives" if only else "negatives"
    for more in ({}, {"heldout_observations": None, "heldout_labels": None}):
        with pytest.raises(
            UserError, match=f"goal has no {kind} .* without those that have both labels.* Remove the cop"
        ):
            warned_of(**copied, **more)


@pytest.fixture(scope="module")
def data(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("tables")
    np.savez(folder / "states.npz", **mixed.arrays())
    out = folder / "data.h5"
    run("import", folder / "states.npz", "--out", out, "--sub-goal", "open", "-q")
    return out


def table(data: Path, count: int) -> str:
    """The first states labelled, 0 and 1 in turn."""
    states = open_dataset(data).unlabelled()
    rows = [f"{row},{digest(state).hex()},{row % 2 if row < count else ''}" for row, state in enumerate(states)]
    return "\n".join(["row,digest,label", *rows, ""])


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (lambda text: text.replace(",", ";"), "cannot be read (KeyError: 'label')"),
        (lambda text: text.replace("row,digest", "row,sum"), "whose first line names label, digest"),
        (lambda text: text + text.splitlines()[1] + "\n", "or the second of its state"),
        (lambda text: re.sub(r"(?m)^0,....", "0,0000", text), "line 2. Audit an ensemble of these data again"),
        (lambda text: text.replace(",1\n", ",yes\n"), "a label is neither 1 nor 0"),
        (lambda text: text.replace(",1\n", ",\n").replace(",0\n", ",\n"), "the table has no label yet"),
        (lambda _: "", "the table has no label yet"),
        (lambda text: text + "A" * 200_000, "cannot be read"),
    ],
)
def test_a_table_of_other_states_is_one_line(data: Path, tmp_path: Path, change, said: str) -> None:
    (tmp_path / "table.csv").write_text(change(table(data, 8)))
    refuses(said, "import", data, "--label", f"open={tmp_path / 'table.csv'}", "--out", tmp_path / "more.h5", "-q")


def test_a_table_saved_by_a_spreadsheet_is_read(data: Path, tmp_path: Path) -> None:
    marks = tmp_path / "table.csv"
    marks.write_bytes(table(data, 4).replace("\n", "\r\n").encode("utf-8-sig"))
    run("import", data, "--label", f"open={marks}", "--out", tmp_path / "more.h5", "-q")
    before, after = open_dataset(data), open_dataset(tmp_path / "more.h5")
    np.testing.assert_array_equal(after.unlabelled(), before.unlabelled()[4:])
    states = after.labelled("open")
    np.testing.assert_array_equal(states.observations[-4:], before.unlabelled()[:4])
    assert states.labels[-4:].tolist() == [False, True, False, True]
    refuses("labels data of one sub-goal", "import", data, "--label", f"shut={marks}", "--out", tmp_path / "x.h5")


def test_it_is_said_when_no_unlabelled_state_is_left(data: Path, tmp_path: Path) -> None:
    """The labels are kept: members without diversity, or with other unlabelled states, can be trained on them."""
    marks, out = tmp_path / "table.csv", tmp_path / "all.h5"
    marks.write_text(table(data, len(open_dataset(data).unlabelled())))
    line = run("import", data, "--label", f"open={marks}", "--out", out, "-q").err
    assert "no unlabelled state is left in all.h5: members cannot be made to differ" in line
    train = ["train-ensemble", out, "--out", tmp_path / "ensemble", "-q", *settings("steps=2")]
    fails(*train)
    run(*train, "--set", "diversity=none")
