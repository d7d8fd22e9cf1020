"""Damaged and hostile files of every format, a few of the thousands of ``tests.attacks.fuzz`` (Spec G2)."""

import random

import pytest

from tests.attacks.fuzz import FORMATS, Sandbox

CASES = range(1, 16)  # case 0 trains, which takes seconds


@pytest.fixture(scope="module")
def box(tmp_path_factory: pytest.TempPathFactory):
    with pytest.MonkeyPatch.context() as patch:
        root = tmp_path_factory.mktemp("fuzz")
        patch.chdir(root)
        yield Sandbox(root)


@pytest.mark.parametrize("name", FORMATS)
def test_every_case_is_read_or_refused(box: Sandbox, name: str) -> None:
    """Spec G2: no exception but ``UserError`` of one printable line, and nothing outside the output is touched."""
    outcomes = set()
    for case in CASES:
        box.fresh()
        outcomes.add(FORMATS[name](box, random.Random(f"test {name} {case}"), case))
        assert box.look() == box.before, case
    assert False in outcomes, "nothing was refused: are the files damaged at all?"


def test_a_crash_would_be_seen(box: Sandbox, monkeypatch: pytest.MonkeyPatch) -> None:
    """The harness itself: an exception that is no UserError escapes."""
    box.fresh()
    monkeypatch.setattr("hypogoal.options.tables.read_text", lambda *_: [][0])
    with pytest.raises(IndexError):
        FORMATS["tables"](box, random.Random(1), 1)


def test_the_whole_run_is_accepted(box: Sandbox) -> None:
    """The harness itself: what it damages was whole."""
    from hypogoal.inspection import faults_of

    box.fresh()
    assert faults_of(box.case) == []
