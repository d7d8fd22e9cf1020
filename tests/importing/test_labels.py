"""Tables of labels of a data file (Spec B6)."""

import re
from pathlib import Path

import numpy as np
import pytest
from command_line import refuses, run

from hypogoal.data import open_dataset
from hypogoal.observations import digest
from tests.mixed import GOAL


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
