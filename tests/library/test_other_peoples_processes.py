"""hypogoal in other people's programs: whatever these set, the bytes are the same; environments by id (Spec B1)."""

import json
import subprocess
import sys
import threading
import warnings
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import AbstractContextManager, ExitStack, contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from own_domain import CorridorDomain

import hypogoal
from hypogoal.domains import find

WITH_WEIGHTS = "*.safetensors"


class Walked(CorridorDomain):
    """A domain that only this program has."""

    name = "corridor-walked"


@pytest.fixture(scope="module")
def data(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Path]:
    """Its states."""
    path = tmp_path_factory.mktemp("data") / "data.h5"
    hypogoal.collect(Walked(), out=path, copies=9, quiet=True)
    yield path
    del find.REGISTERED[Walked.name]


def weights(folder: Path) -> dict[str, bytes]:
    """Of members, options and agent."""
    return {str(path.relative_to(folder)): path.read_bytes() for path in sorted(folder.rglob(WITH_WEIGHTS))}


def train(data: Path, folder: Path) -> dict[str, bytes]:
    """A few steps of an ensemble, of its options and of an agent; the weights."""
    small = {"steps": 3, "workers": 1, "members": 2, "diversity_weight": 1e-4, "restarts": 1}
    ensemble = hypogoal.train_ensemble(data, folder / "ensemble", **small, quiet=True)
    few = {"chooser": "ppo", "steps": 64, "environments": 4, "warm_up": 16, "decisions": 8}
    hypogoal.train_meta(ensemble, folder / "meta", **few, quiet=True)
    return weights(folder)


@pytest.fixture(scope="module")
def plain(data: Path, tmp_path_factory: pytest.TempPathFactory) -> dict[str, bytes]:
    """What comes of it where nothing was set."""
    return train(data, tmp_path_factory.mktemp("plain"))


@contextmanager
def setting(change: Callable[[Any], Any], value: Any, before: Any) -> Iterator[None]:
    """What is set for a whole process, and set back afterwards."""
    change(value)
    try:
        yield
    finally:
        change(before)


@contextmanager
def strict_warnings() -> Iterator[None]:
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        yield


@contextmanager
def drawing_beside() -> Iterator[None]:
    """Another thread draws from the global generators all the time."""
    over = threading.Event()

    def draw() -> None:
        while not over.wait(1e-4):
            torch.rand(3)
            np.random.rand(3)  # noqa: NPY002

    thread = threading.Thread(target=draw)
    thread.start()
    try:
        yield
    finally:
        over.set()
        thread.join()


SETTINGS: dict[str, list[Callable[[], AbstractContextManager[Any]]]] = {
    "type, device, threads": [
        lambda: setting(torch.set_default_dtype, torch.float64, torch.float32),
        lambda: setting(torch.set_default_device, "meta", None),
        lambda: setting(torch.set_num_threads, 2, 1),
    ],
    "no gradients, half precision": [
        torch.no_grad,
        torch.inference_mode,
        lambda: torch.autocast("cpu", torch.bfloat16),
    ],
    "warnings are errors": [lambda: np.errstate(all="raise"), strict_warnings],
    "a thread that draws": [drawing_beside],
}


@pytest.mark.parametrize("name", SETTINGS)
def test_the_callers_settings_change_nothing(name: str, data: Path, plain: dict[str, bytes], tmp_path: Path) -> None:
    """And they hold again afterwards."""
    with ExitStack() as stack:
        for change in SETTINGS[name]:
            stack.enter_context(change())
        before = settings_of_torch()
        assert train(data, tmp_path) == plain
        assert settings_of_torch() == before


def settings_of_torch() -> tuple[Any, ...]:
    return (
        *(torch.get_default_dtype(), torch.empty(0).device, torch.get_num_threads()),
        *(torch.is_grad_enabled(), torch.is_inference_mode_enabled(), torch.is_autocast_enabled("cpu")),
    )


def test_threads_take_turns(data: Path, plain: dict[str, bytes], tmp_path: Path) -> None:
    """Two at once with the same seed give the same."""
    folders = [tmp_path / "one", tmp_path / "other"]
    with ThreadPoolExecutor(2) as pool:
        assert [*pool.map(train, [data, data], folders)] == [plain, plain]


def test_the_callers_generators_go_on_as_they_would(data: Path, tmp_path: Path) -> None:
    """As if there had been no call in between."""
    drawn = []
    for call in (False, True):
        torch.manual_seed(7)
        np.random.seed(7)  # noqa: NPY002
        if call:
            train(data, tmp_path)
        drawn.append((float(torch.rand(())), np.random.rand()))  # noqa: NPY002
    assert drawn[0] == drawn[1]


MADE = "print(gymnasium.make({id!r}).observation_space.shape)"
PLAIN, NAMED = "hypogoal/DoorKey-8x8-v0", "hypogoal.envs:hypogoal/DoorKey-8x8-v0"
CHANGES = """
import json, os, signal, sys, warnings
import torch
handled = signal.SIGINT, signal.SIGTERM
def state():
    process = [*sys.meta_path], {**os.environ}, [*map(signal.getsignal, handled)], torch.random.initial_seed()
    return process, torch.get_num_threads(), torch.get_default_dtype(), torch.is_grad_enabled()
before, filters, modules = state(), [*warnings.filters], {*sys.modules}
import hypogoal
heavy = sorted({"gymnasium", "h5py", "typer"} & ({*sys.modules} - modules))
same = [filters == warnings.filters, before == state()]
hypogoal.OptionEnv
print(json.dumps([*same, before == state(), heavy]))
"""


def printed(code: str) -> str:
    """What a fresh interpreter prints."""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    return done.stdout.strip()


@pytest.mark.parametrize(
    ("imports", "name"),
    [
        ("import gymnasium", NAMED),  # of a process that never imported hypogoal
        ("import gymnasium, hypogoal", PLAIN),
        ("import hypogoal, gymnasium; hypogoal.UserError", PLAIN),
    ],
)
def test_an_environment_is_made_by_its_id(imports: str, name: str) -> None:
    """Gymnasium's ``module:id`` always works, the bare id once hypogoal is imported after Gymnasium, or used."""
    assert printed(f"{imports}\n{MADE.format(id=name)}") == "(64, 64, 3)"


def test_importing_hypogoal_changes_nothing_in_its_users_process() -> None:
    """No finder, variable, handler, filter or setting of torch, then and once its parts are used; nothing is loaded."""
    assert json.loads(printed(CHANGES)) == [True, True, True, []]
