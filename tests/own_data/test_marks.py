"""A table that labels states of a data file: whatever is wrong with it is one line, and no file is written."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from command_line import run

from hypogoal.cli import main
from hypogoal.data import open_dataset
from hypogoal.observations import digest
from tests.own_data import mixed

TOKENS = [b"\xef\xbb\xbf", b"\xff\xfe", b"\0", b";", b",", b"\n", b'"', b"-1", b"999999999999", b"1e3", b"x", b"nan"]
TOKENS += ["\u0663".encode(), "\u2028".encode(), b"row", b"", b"A" * 200_000]


@pytest.fixture(scope="module")
def data(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("marks")
    np.savez(folder / "states.npz", **mixed.arrays())
    out = folder / "data.h5"
    run("import", folder / "states.npz", "--out", out, "--sub-goal", "open", "-q")
    return out


def table(data: Path, count: int) -> str:
    """The first states labelled, 0 and 1 in turn."""
    states = open_dataset(data).unlabelled()
    rows = [f"{row},{digest(state).hex()},{row % 2 if row < count else ''}" for row, state in enumerate(states)]
    return "\n".join(["row,digest,label", *rows, ""])


def damaged(text: str, rng: np.random.Generator) -> bytes:
    """The table with bytes put in, cut out or replaced, a line doubled, or other separators."""
    values, lines = bytearray(text.encode()), text.split("\n")
    at, token = int(rng.integers(len(values))), TOKENS[int(rng.integers(len(TOKENS)))]
    kind = int(rng.integers(5))
    if kind == 0:
        values[at : at + int(rng.integers(40))] = token
    elif kind == 1:
        values[at] = int(rng.integers(256))
    elif kind == 2:
        del values[at:]
    elif kind == 3:
        lines.insert(int(rng.integers(len(lines))), lines[int(rng.integers(len(lines)))])
        values = bytearray("\n".join(lines).encode())
    else:
        values = values.replace(b",", (b";", b"\t", b", ")[int(rng.integers(3))])
    return bytes(values)


def test_a_damaged_table_is_read_or_refused(data: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    outcomes = set()
    marks, out = tmp_path / "marks.csv", tmp_path / "more.h5"
    for case in range(60):
        marks.write_bytes(damaged(table(data, 8), np.random.default_rng(case)))
        code = main(["import", str(data), "--label", f"open={marks}", "--out", str(out), "-q"])
        line = capsys.readouterr().err
        outcomes.add(code)
        assert (code, out.exists()) in ((0, True), (2, False)), line
        assert code == 0 or (line.startswith("hypogoal: ") and line.count("\n") == 1), line
        out.unlink(missing_ok=True)
        assert [file.name for file in tmp_path.iterdir()] == ["marks.csv"]
    assert outcomes == {0, 2}


def test_a_table_saved_by_a_spreadsheet_is_read(data: Path, tmp_path: Path) -> None:
    marks = tmp_path / "marks.csv"
    marks.write_bytes(table(data, 4).replace("\n", "\r\n").encode("utf-8-sig"))
    run("import", data, "--label", f"open={marks}", "--out", tmp_path / "more.h5", "-q")
    assert len(open_dataset(tmp_path / "more.h5").unlabelled()) == len(open_dataset(data).unlabelled()) - 4


def test_it_is_said_when_no_unlabelled_state_is_left(data: Path, tmp_path: Path) -> None:
    """The labels are kept: members without diversity, or with other unlabelled states, can be trained on them."""
    marks, out = tmp_path / "marks.csv", tmp_path / "all.h5"
    for count, said in ((len(open_dataset(data).unlabelled()), True), (4, False)):
        marks.write_text(table(data, count))
        words = ["import", str(data), "--label", f"open={marks}", "--out", str(out), "--force", "-q"]
        line = run(*words).err
        assert ("no unlabelled state is left in all.h5: members cannot be made to differ" in line) == said
        assert line.count("\n") == said
    marks.write_text(table(data, len(open_dataset(data).unlabelled())))
    run("import", data, "--label", f"open={marks}", "--out", out, "--force", "-q")
    train = ["train-ensemble", str(out), "--out", str(tmp_path / "ensemble"), "-q", "--set", "steps=2"]
    assert main(train) == 2
    run(*train, "--set", "diversity=none")
