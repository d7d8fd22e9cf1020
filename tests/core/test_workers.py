"""Tasks on several cores: how many there may be."""

import pytest

from hypogoal.core.workers import CORES, allowed, cores


def test_no_stage_uses_more_processes_than_it_was_allotted(monkeypatch: pytest.MonkeyPatch) -> None:
    """Spec G4: a cell's own ``workers`` stays within what its sweep gave it; on its own it is what was asked."""
    monkeypatch.delenv(CORES, raising=False)
    assert allowed(4096) == 4096 and allowed(0) == cores()
    monkeypatch.setenv(CORES, "2")
    assert allowed(4096) == 2 and allowed(1) == 1 and allowed(0) == cores() <= 2
