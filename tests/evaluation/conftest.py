"""Runs with ladders that several files read."""

from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path

import pytest
from command_line import run, trusting
from ladder_run import write_run
from shared_runs import built_once


def _evaluated(write: Callable[[Path], None], folder: Path) -> None:
    write(folder)
    with trusting():
        run("evaluate", folder, "-q")
        run("report", folder)


@pytest.fixture(scope="session")
def built_ladders(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Path]:
    """What ``ladders`` hands out."""
    yield from built_once(tmp_path_factory, "ladders", partial(_evaluated, write_run))


@pytest.fixture
def ladders(built_ladders: Path) -> Iterator[Path]:
    """N of 1, 2, 3 (3: every ladder), two seeds, three methods; options at N=2 on two ladders, oracles beside.

    Evaluated and drawn, to be read only; its domain is trusted meanwhile.
    """
    with trusting():
        yield built_ladders


@pytest.fixture
def small_ladders(tmp_path: Path) -> Iterator[Path]:
    """What tests that change something need of it: N of 2, one seed, two methods, the oracle; not evaluated."""
    folder = tmp_path / "small"
    write_run(folder, numbers=(2,), seeds=(0,), methods=("cnn", "dbat"))
    with trusting():
        yield folder
