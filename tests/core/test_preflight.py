"""Before a stage starts: what it needs, and whether it is there (Spec G1)."""

from pathlib import Path

import pytest

from hypogoal.core import preflight
from hypogoal.core.errors import UserError
from hypogoal.core.preflight import Needs


def test_needs_are_said_or_refused_with_numbers(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Spec G1: one line on stderr; too much memory or disk is refused before anything is made."""
    out = tmp_path / "a" / "b"
    preflight.preflight("collect", out, Needs(1e6, 2e6))
    assert capsys.readouterr().err.startswith("collect: needs about 1.0 MB of memory (")
    preflight.preflight("collect", out, Needs(1e6, 2e6), quiet=True)
    assert capsys.readouterr().err == ""
    with pytest.raises(UserError, match=r"not enough memory: about 1000\.0 TB needed, \d"):
        preflight.preflight("collect", out, Needs(1e15, 1))
    with pytest.raises(UserError, match=r"not enough disk: about 1000\.0 TB needed, \d"):
        preflight.preflight("collect", out, Needs(1, 1e15))
    assert list(tmp_path.iterdir()) == []


def test_nothing_is_needed_for_what_is_complete(tmp_path: Path) -> None:
    """Spec A6, G1: --resume keeps it on a full disk too; to make it again takes what it takes."""
    out = tmp_path / "out"
    out.mkdir()
    preflight.preflight("collect", out, Needs(1e15, 1e15), resume=True)
    with pytest.raises(UserError, match="not enough memory"):
        preflight.preflight("collect", out, Needs(1e15, 1e15))
    with pytest.raises(UserError, match="not enough memory"):
        preflight.preflight("collect", tmp_path / "other", Needs(1e15, 1e15), resume=True)


@pytest.mark.parametrize(("limit", "free"), [("3000000", 1_500_000), ("max", None), ("9" * 18, None)])
def test_a_control_group_allows_less(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, limit: str, free: int | None
) -> None:
    """Spec G1, G4: in a container or a cluster job its limit counts, the cache of files aside."""
    for name, text in (("memory.max", limit), ("memory.current", "2000000"), ("memory.stat", "anon 9\nfile 500000\n")):
        (tmp_path / name).write_text(text)
    monkeypatch.setattr(preflight, "_folders", lambda: [tmp_path, tmp_path / "none"])
    if free is None:
        assert abs((preflight.free_memory() or 0) - (preflight._amount("/proc/meminfo", "MemAvailable:") or 0)) < 2**30
    else:
        assert preflight.free_memory() == free


def test_where_nothing_is_known_nothing_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Spec G1: not every system says how much memory is free."""
    monkeypatch.setattr(preflight, "free_memory", lambda: None)
    preflight.preflight("collect", tmp_path / "a", Needs(1e15, 1))


def test_what_the_process_has_itself_is_not_needed_twice(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Spec G1, G4: a cell whose job was given what it needs starts there, whatever it has of that already."""
    held = bytearray(b"x" * 50_000_000)
    own = preflight.own_memory()
    assert own > len(held)
    limit = own + 300_000_000
    for name, text in (("memory.max", limit), ("memory.current", own), ("memory.stat", "file 0\n")):
        (tmp_path / name).write_text(str(text))
    monkeypatch.setattr(preflight, "_folders", lambda: [tmp_path])
    preflight.preflight("collect", tmp_path / "a", Needs(limit - 20_000_000, 1))
    with pytest.raises(UserError, match="not enough memory"):
        preflight.preflight("collect", tmp_path / "a", Needs(limit + 20_000_000, 1))
