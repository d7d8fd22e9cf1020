"""What the code computes is what release 0.23.0 computed: tests/reference, whose README.md says how it was made."""

import os
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
from reference import tables
from reference.parts import CLOSE, LOOSE, LOOSE_ELSEWHERE, PARTS

REFERENCE = Path(__file__).parent / "reference"
MACHINE = tables.machine()
SAYS = 4_000  # characters at the end of the output that are shown


def expected_here(name: str) -> str:
    """Why a part does not hold on this machine; empty if it does."""
    recorded = tables.record()[name]["machine"]
    if not PARTS[name].traced or recorded == MACHINE:
        return ""
    return f"a trace, exact only where numbers are rounded alike: recorded on {recorded}, this is {MACHINE}"


def cases() -> list[object]:
    return [pytest.param(name, marks=[pytest.mark.slow] if PARTS[name].slow else []) for name in tables.record()]


@pytest.fixture(scope="module")
def made(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Callable[[str], Path]]:
    """The tables of the parts that were chosen, made by one process since they share data and ensembles."""
    folder = tmp_path_factory.mktemp("reference")
    here = [item for item in request.session.items if item.path == Path(__file__)]
    names = [item.callspec.params["name"] for item in here if hasattr(item, "callspec")]
    wanted = [name for name in names if not expected_here(name)]
    environment = {**os.environ, "PYTHONPATH": str(Path(__file__).parents[1])}
    words = [sys.executable, str(REFERENCE / "make.py"), "--to", str(folder), *wanted]
    done = subprocess.run(words, env=environment, capture_output=True, text=True, check=False)

    def table(name: str) -> Path:
        path = folder / f"{name}.csv.gz"
        assert path.exists(), f"{name} could not be made: {(done.stdout + done.stderr)[-SAYS:]}"
        return path

    return table


@pytest.mark.parametrize("name", cases())
def test_it_is_as_it_was(name: str, made: Callable[[str], Path]) -> None:
    """Arrays by sha256, predictions and losses closely, traces exactly on the machine that they were recorded on."""
    if reason := expected_here(name):
        pytest.skip(f"{name}: {reason}")
    part, recorded = PARTS[name], tables.record()[name]
    elsewhere = LOOSE if name in LOOSE_ELSEWHERE else max(part.tolerance, CLOSE)
    tolerance = part.tolerance if recorded["machine"] == MACHINE else elsewhere
    apart = tables.parting(tables.read(REFERENCE / f"{name}.csv.gz"), tables.read(made(name)), tolerance)
    assert apart is None, f"{name}, made by {recorded['code']}: {apart}"


def test_every_part_is_there() -> None:
    """Each part has its table and its record, and together they are small."""
    tables_there = {path.name.removesuffix(".csv.gz") for path in REFERENCE.glob("*.csv.gz")}
    assert set(PARTS) == set(tables.record()) == tables_there
    assert sum(path.stat().st_size for path in REFERENCE.glob("*.*")) < 900_000


def test_a_difference_is_seen() -> None:
    """The comparison itself: where two tables part, what is gone, what is close enough."""
    old = [("line", "column", "value"), ("2", "loss", "0.25"), ("2", "episodes", "3")]
    assert tables.parting(old, [old[0], ("2", "loss", "0.25001"), old[2]], CLOSE) is None
    apart = tables.parting(old, [*old[:2], ("2", "episodes", "4")], tolerance=1.0)
    assert apart == "1 of 2 values differ, 0 are gone, 0 are new; the first: 2, episodes: 3 before, 4 now"
    apart = tables.parting(old, old[:2], CLOSE)
    assert apart == "0 of 2 values differ, 1 are gone, 0 are new; the first: 2, episodes: 3 before, gone now"
