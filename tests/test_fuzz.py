"""Damaged files of every format, a few of the thousands of ``tests.attacks.fuzz`` (Spec G2)."""

from pathlib import Path

import pytest

from tests.attacks.fuzz import CHANGES, Sandbox, outcome_of

LAST = {"csv": 13}  # case, else the fifth; the first is 1, since case 0 takes seconds


@pytest.fixture
def box(corridor_run: Path, tmp_path: Path) -> Sandbox:
    return Sandbox(corridor_run, tmp_path)


@pytest.mark.parametrize("name", CHANGES)
def test_every_case_is_read_or_refused(box: Sandbox, name: str) -> None:
    """Spec G2: nothing but ``UserError`` of one line, and nothing outside the output is touched."""
    outcomes = {outcome_of(box, name, case) for case in range(1, LAST.get(name, 5) + 1)}
    assert "refused" in outcomes and outcomes <= {"accepted", "refused"}
