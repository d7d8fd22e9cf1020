"""``hypogoal check`` of agents' parts, views and teachers: right ones pass, each fault is one line (Spec G2)."""

import pytest
from command_line import fails, run

KEPT = [
    ("--chooser", "First", 4),
    ("--learner", "Straight", 4),
    ("--termination", "Twice", 4),
    ("--view", "Whole", 3),
    ("--teacher", "shade", 1),
]


@pytest.mark.parametrize(("option", "part", "laws"), KEPT)
def test_parts_that_keep_the_contract_pass(option: str, part: str, laws: int) -> None:
    told = run("check", option, f"odd_parts:{part}").out.splitlines()
    assert len(told) == laws and all(line.startswith("ok   ") for line in told)


def test_what_may_surprise_is_a_warning() -> None:
    told = run("check", "--termination", "odd_parts:Never").out.splitlines()
    assert "warn plays: no option reached its sub-goal in 240 steps" in told


BROKEN = [
    ("--chooser", "Abstract", "plays: this chooser lacks choose"),
    ("--chooser", "Fractions", "plays: choose gave float64 (4,): Fractions. Give int64 (4,), from 0 to 3."),
    ("--chooser", "Last", "of which not all are offered: Last. Choose where 'offered' is true."),
    ("--chooser", "Beyond", "plays: choose gave 4 to 4"),
    ("--chooser", "Forgetful", "plays: learn gave None: Forgetful. Return a dict"),
    ("--chooser", "Moody", "again: options"),
    ("--chooser", "Turning", "Name in CHANGING all that changes."),
    ("--chooser", "Unnamed", "resumes: your code raised AttributeError: 'Unnamed' object has no attribute 'memory'"),
    ("--learner", "Negative", "plays: greedy gave -1 to 2: Negative. Give int64 (4,), from 0 to 6."),
    ("--learner", "Unsaved", "is kept: table is another one when loaded"),
    ("--termination", "Counts", "plays: reached gave int64 (4,)"),
    ("--view", "Unready", "object has no attribute 'shape': odd_parts.py, class Unready"),
    ("--view", "Few", "takes 2 positional arguments but 3 were given: Few.__init__"),
    ("--view", "OneRow", "trains: the view shows uint8 (1, 48, 48, 3) of 2 states"),
    ("--view", "Blackened", "trains: the view changes the observations"),
    ("--view", "ByBatch", "shows: a state alone and among others differ"),
    ("--view", "Mean", "is kept: what it learned is not loaded. Keep it in parameters or buffers."),
    ("--view", "Half", "trains: the view changes a batch to uint8 (16, 24, 48, 3)"),
    ("--view", "Bright", "trains: the view changes a batch to float32 (16, 48, 48, 3), at most 2"),
    ("--view", "Always", "shows: without a generator a batch is not what members see"),
    ("--view", "AnyState", "trains: the view gave 1 pools and the share 0.5"),
    ("--view", "Share", "trains: the view gave 1 pools and the share 1"),
    ("--teacher", "turned", "trains: the teacher gave scores float64 (2048, 2)"),
    ("--teacher", "words", "trains: the teacher gave no scores (could not convert string to float: "),
    ("--teacher", "blackens", "trains: the teacher changes what it gets"),
    ("--teacher", "moody", "differs when trained again"),
    ("--teacher", "nobody", "trains: the teacher cannot be loaded"),
]


@pytest.mark.parametrize(("option", "part", "fault"), BROKEN)
def test_each_fault_is_one_line(option: str, part: str, fault: str) -> None:
    """The last line says which law, what and what to do; the exit code is 2."""
    told = fails("check", option, f"odd_parts:{part}")
    last = told.out.splitlines()[-1]
    assert last.startswith("FAIL ") and fault in last and told.err == "", last
