"""Spec B6, G2: code that a file names is not the user's word, in no process and no spelling; nor is a numpy.py."""

import subprocess
import sysconfig
from pathlib import Path

import numpy as np
import pytest
from command_line import fails, run
from toy_data import write

from hypogoal.data import Collected, States, write_dataset
from hypogoal.experiments.records import last_line

ROOT = Path(__file__).resolve().parents[2]
HYPOGOAL = str(Path(sysconfig.get_path("scripts")) / "hypogoal")
SPELLINGS = (
    "collect {own}",
    "train-baseline --agent ppo evilmod:obj",
    "train-ensemble DATA --diversity=evilmod:obj",
    "train-ensemble DATA --set {setting}",
    "train-ensemble DATA --set network=evilmod:obj",
    "train-ensemble DATA --preset theirs.toml",
    "train-ensemble THEIRS",
)
MARK = "import pathlib; pathlib.Path(__file__).with_name('ran-' + __name__).touch(); obj = DOMAIN = 1\n"


def experiment(path: Path, commands: tuple[str, ...], axes: str = "") -> Path:
    """An experiment of these commands, all over the same axes; ``path``."""
    names = "'own', 'setting'" if axes else ""
    cells = [
        f'[[cells]]\nname = "c{number}"\naxes = [{names}]\ncommand = "{command}"\n'
        for number, command in enumerate(commands)
    ]
    path.write_text("\n".join(["format = 1\nevaluate = false", f"axes = {{ {axes} }}", *cells]))
    return path


def images(path: Path, domain: str = "toy") -> Path:
    """States of two sub-goals that the default network takes; ``path``."""
    rng = np.random.default_rng(0)
    labels = np.array([[False, True], [True, False]] * 4)
    states = States(rng.integers(0, 256, (8, 48, 48, 3), dtype=np.uint8), labels, {"layout_seed": np.arange(8)})
    collected = Collected((48, 48, 3), ("one", "two"), states, states, states)
    write_dataset(path, collected, domain=domain, config={}, seed=0)
    return path


@pytest.mark.parametrize("spelling", SPELLINGS)
def test_a_strangers_experiment_runs_none_of_its_code(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, spelling: str
) -> None:
    """Whichever way it is written, with the module in the current folder: one line, and nothing is imported."""
    monkeypatch.chdir(tmp_path)
    (tmp_path / "evilmod.py").write_text(MARK)
    (tmp_path / "theirs.toml").write_text('[train-ensemble]\ndiversity = "evilmod:obj"\n')
    data, theirs = write(tmp_path / "data.h5"), write(tmp_path / "theirs.h5", domain="evilmod:obj")
    words = spelling.replace("DATA", str(data)).replace("THEIRS", str(theirs))
    axes = 'own = ["evilmod:obj"], setting = ["network=evilmod:obj"]'
    printed = fails("sweep", experiment(tmp_path / "stranger.toml", (words,), axes), "--out", "out", "-q")
    logs = [last_line(log) for log in (tmp_path / "out" / "logs").glob("*.log")]
    assert "a file names code of its own as its" in (logs[0] if logs else printed.err)
    assert not [*tmp_path.glob("ran-*")]


def test_what_the_user_gave_or_allowed_is_run_in_cells(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """By --trust and by --set of the sweep; in processes of a cell's own too."""
    monkeypatch.chdir(tmp_path)
    for name in ("margin", "wide_network"):
        (tmp_path / f"{name}.py").write_text((ROOT / "examples" / f"{name}.py").read_text())
    (tmp_path / "corridor.py").write_text(
        "from corridor_env import SUB_GOALS, CorridorEnv\nfrom hypogoal import GymnasiumDomain\n"
        "DOMAIN = GymnasiumDomain(CorridorEnv, SUB_GOALS, "
        "defaults={'train-ensemble': {'network': 'wide_network:wide'}})"
    )
    monkeypatch.setenv("PYTHONPATH", f"{ROOT}:{ROOT / 'tests'}")
    monkeypatch.syspath_prepend(str(ROOT / "tests"))
    data, corridor = images(tmp_path / "data.h5"), images(tmp_path / "corridor.h5", "corridor:DOMAIN")
    few = "--set steps=2 --set members=2 --set workers="
    commands = (
        f"train-ensemble {data} --diversity=margin:pair_loss --set network={{own}} {few}2",
        f"train-ensemble {corridor} {few}1",
    )
    toml = experiment(tmp_path / "own.toml", commands, 'own = ["doorkey"], setting = ["x"]')
    run("sweep", toml, "--out", "out", "-q", "--set", "own=wide_network:wide", "--trust")
    assert len([*tmp_path.glob("out/c?/*/manifest.json")]) == 2


@pytest.mark.parametrize("command", ["sweep", "train-ensemble"])
def test_modules_of_the_current_folder_are_not_run(tmp_path: Path, command: str) -> None:
    """Neither in a cell nor in the processes of a stage that the user starts; a folder called hypogoal is no harm."""
    for name in ("numpy", "queue", "types", "struct", "multiprocessing", "random", "typer", "concurrent"):
        (tmp_path / f"{name}.py").write_text(MARK)
    (tmp_path / "hypogoal").mkdir()  # as beside a clone
    words = ["train-ensemble", str(images(tmp_path / "data.h5"))]
    words += ["--set", "steps=2", "--set", "members=2", "--set", "workers=2", "--out", "out"]
    if command == "sweep":
        collect = "collect doorkey --set heldout_layouts=1 --set unlabelled_seeds=1"
        words = ["sweep", str(experiment(tmp_path / "own.toml", (collect,))), "--out", "out"]
    done = subprocess.run([HYPOGOAL, *words, "-q"], cwd=tmp_path, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr + "".join(log.read_text() for log in tmp_path.glob("out/logs/*.log"))
    assert not [*tmp_path.glob("ran-*")]
    assert [*tmp_path.glob("out/manifest.json"), *tmp_path.glob("out/c0*")]
