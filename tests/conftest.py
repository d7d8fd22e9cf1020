"""One thread per process, as the stages do it: two threads with a busy neighbour are ten times slower."""

import gc
import os
import shutil
import signal
from collections.abc import Iterator
from functools import partial
from pathlib import Path

os.environ["OMP_NUM_THREADS"] = "1"
if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:  # started in the background: tests of Ctrl-C would wait for ever
    signal.signal(signal.SIGINT, signal.default_int_handler)

import pytest
import shared_runs
import torch
from command_line import run, trusting

from hypogoal.core.own_code import VARIABLE

torch.set_num_threads(1)
gc.set_threshold(100_000)  # as in a command, see hypogoal/__main__.py

# Files that take half a minute and more, the longest first: begun last, one would keep a single worker busy at the end.
LONGEST = (
    "test_reference",
    "test_evaluate_report",
    "test_agents",
    "test_ladder_run",
    "test_sweep",
    "test_mixed",
    "test_montezuma_sub_goals",
    "test_cli",
    "test_examples",
    "test_baseline",
    "test_resuming",
    "test_start_states",
    "test_loop",
    "test_docs",
    "test_pages",
    "test_package",
)


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """The longest files first; the rest as they are."""
    places = {name: place for place, name in enumerate(LONGEST)}
    items.sort(key=lambda item: places.get(item.path.stem, len(LONGEST)))


@pytest.fixture(scope="session", autouse=True)
def short_evaluations() -> Iterator[None]:
    """Evaluations explain 5 states of the gallery instead of 20, and let agents play a quarter of the episodes."""
    from hypogoal.evaluation import frozen, saliency

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(saliency, "EXPLAINED", 5)
        patch.setattr(frozen, "EPISODES", 2)
        patch.setattr(frozen, "STEPS", 100)
        yield


@pytest.fixture(autouse=True)
def nothing_typed_before() -> None:
    """Each test as in a process of its own: nothing was typed that allows code which files name."""
    from hypogoal.core import own_code

    own_code._allowed.clear()


@pytest.fixture
def trusted(monkeypatch: pytest.MonkeyPatch) -> None:
    """The user allows the code that files name."""
    monkeypatch.setenv(VARIABLE, "1")


@pytest.fixture
def small_gru(monkeypatch: pytest.MonkeyPatch) -> None:
    """The paper's option networks with a GRU of 32 units instead of 512: 10.5 M parameters each say no more."""
    from hypogoal.options.paper_network import PaperQNetwork

    monkeypatch.setattr(PaperQNetwork, "HIDDEN", 32)


@pytest.fixture(scope="session")
def tiny_run(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Path]:
    """A run of every stage on DoorKey, to be read only: ``shared_runs.DOORKEY_RUN`` says what is in it."""
    yield from shared_runs.built_once(tmp_path_factory, "tiny", partial(shared_runs.make, shared_runs.DOORKEY_RUN))


@pytest.fixture(scope="session")
def mixed_run(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Path]:
    """Imported states of two cameras and numbers, of one sub-goal, hypotheses and their audit, to be read only."""
    yield from shared_runs.built_once(tmp_path_factory, "mixed", shared_runs.make_mixed)


@pytest.fixture
def tiny_copy(tiny_run: Path, tmp_path: Path) -> Path:
    """The same, to be changed."""
    return shutil.copytree(tiny_run, tmp_path / "tiny")


@pytest.fixture(scope="session")
def built_corridor(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Path]:
    """What ``corridor_run`` hands out."""

    def build(folder: Path) -> None:
        with trusting():
            shared_runs.make(shared_runs.CORRIDOR_RUN, folder)
        other = shutil.copytree(folder, folder.with_name("corridor-other"), dirs_exist_ok=True)
        run("compare", folder, other, "--out", folder / "comparison")

    yield from shared_runs.built_once(tmp_path_factory, "corridor", build)


@pytest.fixture
def corridor_run(built_corridor: Path) -> Iterator[Path]:
    """A run of every stage on the corridor, which is cheap, to be read only; its domain is trusted meanwhile."""
    with trusting():
        yield built_corridor


@pytest.fixture
def corridor_copy(corridor_run: Path, tmp_path: Path) -> Path:
    """The same, to be changed."""
    return shutil.copytree(corridor_run, tmp_path / "corridor")
