"""What is printed: lines, amounts, tables; a reader that has enough."""

import os
import subprocess
import sys

import pytest
from rich.table import Table

from hypogoal.core.errors import UserError
from hypogoal.core.terminal import amount, drawn


def test_amounts_have_a_singular() -> None:
    assert [amount(count, "cell") for count in (0, 1, 2, 1_000)] == ["0 cells", "1 cell", "2 cells", "1,000 cells"]


def test_an_error_is_one_line_of_signs_that_can_be_printed() -> None:
    """Spec G2: it may quote a file."""
    assert str(UserError("kind \x1b[2J", "a\nb  c", "Do.")) == "kind ?[2J: a b  c. Do."


def test_a_table_as_text_is_shown_nowhere_else(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """The same text in a terminal with colours and in a pipe; brackets are text."""
    table = Table("a", "b")
    table.add_row("1", "[bold]")
    plain = drawn(table, 40)
    assert "│ 1 │ [bold]" in plain
    monkeypatch.setenv("FORCE_COLOR", "1")
    assert drawn(table, 40) == plain and capsys.readouterr().out == ""


@pytest.mark.skipif(os.name == "nt", reason="pipes of a POSIX shell")
def test_a_reader_that_has_enough() -> None:
    """As of any other program, before ``| head``: nothing is said."""
    reading, writing = os.pipe()
    os.close(reading)
    command = [sys.executable, "-m", "hypogoal", "config", "train-meta"]
    done = subprocess.run(command, stdout=writing, stderr=subprocess.PIPE, check=False)
    os.close(writing)
    assert (done.returncode, done.stderr) == (1, b"")
