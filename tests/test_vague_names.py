"""The check that counts functions with vague names (``make check``)."""

from pathlib import Path

import pytest

from tests.vague_names import count, main

SOURCE = """
def clear(rows, columns):
    total = sum(row for row in rows)
    return total, columns.told


def argument(told):
    return told


def outer(rows):
    for one in rows:
        print(one)

    def inner(own):
        return own

    return sorted(rows, key=lambda about: about.size)


def message(size):
    what = f"too large ({size})"
    raise UserError(what)
"""


def test_functions_with_vague_arguments_and_locals_are_counted(tmp_path: Path) -> None:
    (tmp_path / "part").mkdir()
    (tmp_path / "part" / "module.py").write_text(SOURCE)
    (tmp_path / "clear.py").write_text("def clear(rows):\n    return rows\n")
    total, vague = count(tmp_path)
    assert total == 6  # inner is one of its own
    assert dict(vague) == {"part/module.py": 4, "clear.py": 0}


def test_above_the_limit_it_fails_and_names_the_worst_files(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "module.py").write_text(SOURCE)
    assert main(tmp_path, limit=0.8) == 0
    assert main(tmp_path, limit=0.7) == 1
    assert "4 in module.py" in capsys.readouterr().out
