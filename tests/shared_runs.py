"""Runs that many tests read: made by commands, once for all processes of the test run, and left as they are."""

import os
import shutil
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest
from command_line import FIXED, run, settings
from filelock import FileLock

from tests import mixed

FEW_STEPS = " ".join(settings("members=2", "steps=10", "workers=1", *FIXED))
FEW = "--set members=2 --set workers=1 --set steps=20"
GOALS = "--set sub_goals=collect-red-key,open-red-door"
DOORKEY = "--set max_episode_steps=64 --set layout_seed=100"
PLAY = f"--set steps=2048 {DOORKEY}"
CONTROL = f"--set steps=1024 {DOORKEY}"
SHORT = "--set environments=4 --set warm_up=50 --set steps=400 --set max_episode_steps=30"
VISITED = "--set save_visited=5"

# Output -> the command that makes it; what stages need comes before them. The ensemble with which agents are learned
# is neither the only one nor the first.
DOORKEY_RUN = {
    "data.h5": "collect doorkey --set heldout_layouts=1 --set unlabelled_seeds=1",
    "another": f"train-ensemble {{run}}/data.h5 {FEW} --set sub_goals=open-red-door --seed 1",
    "ensemble": f"train-ensemble {{run}}/data.h5 {FEW} {GOALS}",
    "ensemble-none": f"train-ensemble {{run}}/data.h5 {FEW} --set sub_goals=open-red-door --set diversity=none"
    " --set threshold=unlabelled-split",
    "options": f"train-options {{run}}/ensemble --set steps=1024 {DOORKEY}",
    "meta": f"train-meta {{run}}/ensemble --options {{run}}/options {PLAY}",
    "meta-random": f"train-meta {{run}}/ensemble {CONTROL} --set chooser=random",
    "meta-oracle": f"train-meta {{run}}/ensemble {CONTROL} --set termination=oracle",
    "ppo": f"train-baseline doorkey {PLAY}",
}
CORRIDOR_RUN = {
    "data.h5": "collect own_domain:DOMAIN --set copies=9",
    "ensemble": f"train-ensemble {{run}}/data.h5 {FEW_STEPS}",
    "options": f"train-options {{run}}/ensemble {SHORT}",
    "options-more": f"train-options {{run}}/ensemble {SHORT} {VISITED}",
    "meta": f"train-meta {{run}}/ensemble {SHORT}",
    "meta-more": f"train-meta {{run}}/ensemble {SHORT} {VISITED}",
    "other": f"train-meta {{run}}/ensemble {SHORT} --seed 1 --set layout_seed=101",
    "random": f"train-meta {{run}}/ensemble {SHORT} --set chooser=random",
    "oracle": f"train-meta {{run}}/ensemble {SHORT} --set termination=oracle",
    "ppo": "train-baseline own_domain:ODD --set steps=128 --set max_episode_steps=20",
    "audit": f"audit {{run}}/ensemble --domain own_domain:DOMAIN --sub-goal left-end {SHORT}"
    " --set restart_options=false",
}


def command(commands: dict[str, str], folder: Path, name: str) -> list[str]:
    """The words of the command that makes one of a run's outputs in ``folder``."""
    words = [word.format(run=folder) for word in commands[name].split()]
    return [*words, "--out", str(folder / name), "-q"]


def make(commands: dict[str, str], folder: Path) -> None:
    """The whole run, evaluated and drawn."""
    for name in commands:
        run(*command(commands, folder, name))
    run("evaluate", folder, "-q")
    run("report", folder)


def make_mixed(folder: Path) -> None:
    """States that somebody recorded, in which a door is open or not, and what is made of them."""
    np.savez(folder / "states.npz", **mixed.arrays())
    run("import", folder / "states.npz", "--out", folder / "data.h5", "--sub-goal", mixed.GOAL, "-q")
    few = settings("steps=60", "members=2", "batch_size=12", "learning_rate=1e-3", *FIXED)
    run("train-ensemble", folder / "data.h5", "--out", folder / "ensemble", "-q", *few)
    run("audit", folder / "ensemble", "--out", folder / "audit")


def built_once(factory: pytest.TempPathFactory, name: str, build: Callable[[Path], None]) -> Iterator[Path]:
    """The folder that ``build`` fills, which the first process makes that wants it; no test may change it."""
    root = factory.getbasetemp()
    if "PYTEST_XDIST_WORKER" in os.environ:
        root = root.parent  # of all processes
    folder, complete = root / name, root / f"{name}.complete"
    with FileLock(root / f"{name}.lock"):
        if not complete.exists():
            shutil.rmtree(folder, ignore_errors=True)
            folder.mkdir()
            build(folder)
            complete.touch()
    before = _state_of(folder)
    yield folder
    assert _state_of(folder) == before, f"a test changed {name}, which others read"


def _state_of(folder: Path) -> dict[Path, tuple[int, int]]:
    """Each file's size and when it was changed."""
    state = {}
    for path in folder.rglob("*"):
        if path.is_file():
            about = path.stat()
            state[path] = about.st_size, about.st_mtime_ns
    return state
