"""Spec B6, G2: code that a file names is not the user's word, in no process and no spelling; nor is a numpy.py."""

import subprocess
import sysconfig
from pathlib import Path

import numpy as np
import pytest
from command_line import run
from toy_data import write

from hypogoal.cli import main
from hypogoal.core import own_code
from hypogoal.data import Collected, States, write_dataset
from hypogoal.experiments.planning import make_plan
from hypogoal.experiments.records import last_line
from hypogoal.experiments.toml_file import read_toml

ROOT = Path(__file__).resolve().parents[2]
HYPOGOAL = str(Path(sysconfig.get_path("scripts")) / "hypogoal")
SPELLINGS = (
    "collect evilmod:obj",
    "collect --preset demo evilmod:obj",
    "collect -q --seed 1 evilmod:obj",
    "collect {own}",
    "train-baseline evilmod:obj",
    "train-baseline --agent ppo evilmod:obj",
    "train-ensemble DATA --diversity evilmod:obj",
    "train-ensemble DATA --diversity=evilmod:obj",
    "train-ensemble --diversity {own} DATA",
    "train-ensemble DATA --set diversity=evilmod:obj",
    "train-ensemble DATA --set=diversity=evilmod:obj",
    "train-ensemble DATA --set network=evilmod:obj",
    "train-ensemble DATA --set=network=evilmod:obj",
    "train-ensemble DATA --set 'network = evilmod:obj'",
    "train-ensemble DATA --set {setting}",
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


def test_a_strangers_experiment_runs_none_of_its_code(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """Whichever way it is written, with the module in the current folder: one line each, nothing is imported.

    A few are swept, in processes of their own; then all of them are said as such a process is told them.
    """
    monkeypatch.chdir(tmp_path)
    (tmp_path / "evilmod.py").write_text(MARK)
    (tmp_path / "theirs.toml").write_text('[train-ensemble]\ndiversity = "evilmod:obj"\n')
    data, theirs = write(tmp_path / "data.h5"), write(tmp_path / "theirs.h5", domain="evilmod:obj")
    commands = tuple(text.replace("DATA", str(data)).replace("THEIRS", str(theirs)) for text in SPELLINGS)
    axes = 'own = ["evilmod:obj"], setting = ["network=evilmod:obj"]'
    stranger = experiment(tmp_path / "stranger.toml", (commands[1], commands[8], commands[-1]), axes)
    assert main(["sweep", str(stranger), "--out", "out", "-q"]) == 2
    assert capsys.readouterr().err.count("\n") == 1
    told = [last_line(log) for log in (tmp_path / "out" / "logs").glob("*.log")]
    assert len(told) == 3
    for name, value in own_code.environment_of_children().items():
        monkeypatch.setenv(name, value)
    cells = make_plan(read_toml(experiment(tmp_path / "all.toml", commands, axes)), tmp_path / "all").cells
    assert len(cells) == len(SPELLINGS)
    for cell in cells:
        assert main([*cell.arguments, "--resume"]) == 2, cell
        told += capsys.readouterr().err.splitlines()
    assert len(told) == 3 + len(SPELLINGS)
    for line in told:
        assert "a file names code of its own as its" in line
        assert line.endswith("evilmod:obj. Do you trust it? Set HYPOGOAL_TRUST=evilmod:obj")
    assert not [*tmp_path.glob("ran-*")]


def test_what_the_user_gave_or_allowed_is_run_in_cells(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """By HYPOGOAL_TRUST, by --set of the sweep, and by a domain that is allowed; in processes of a cell's own too."""
    monkeypatch.chdir(tmp_path)
    for name in ("margin", "wide_network"):
        (tmp_path / f"{name}.py").write_text((ROOT / "examples" / f"{name}.py").read_text())
    (tmp_path / "corridor.py").write_text(
        "from corridor_env import SUB_GOALS, CorridorEnv\nfrom hypogoal import GymnasiumDomain\n"
        "DOMAIN = GymnasiumDomain(CorridorEnv, SUB_GOALS, "
        "defaults={'train-ensemble': {'network': 'wide_network:wide'}})"
    )
    monkeypatch.setenv("PYTHONPATH", str(ROOT / "tests"))
    monkeypatch.syspath_prepend(str(ROOT / "tests"))
    monkeypatch.setenv("HYPOGOAL_TRUST", " margin:pair_loss, corridor:DOMAIN")
    data, corridor = images(tmp_path / "data.h5"), images(tmp_path / "corridor.h5", "corridor:DOMAIN")
    few = "--set steps=2 --set members=2 --set workers="
    commands = (
        f"train-ensemble {data} --diversity=margin:pair_loss --set network={{own}} {few}2",
        f"train-ensemble {corridor} {few}1",
    )
    toml = experiment(tmp_path / "own.toml", commands, 'own = ["doorkey"], setting = ["x"]')
    run("sweep", toml, "--out", "out", "-q", "--set", "own=wide_network:wide")
    assert len([*tmp_path.glob("out/c?/*/manifest.json")]) == 2


def test_a_preset_of_a_run_is_a_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Of ``run`` what --set says is the user's word, what --preset says is not."""
    seen: list[frozenset[str]] = []
    monkeypatch.setattr("hypogoal.stages.sweep.run_cells", lambda *_, **__: seen.append(own_code.allowed()))
    monkeypatch.chdir(tmp_path)
    (tmp_path / "theirs.toml").write_text('[train-ensemble]\ndiversity = "evilmod:obj"\n')
    words = ["run", "doorkey", "--preset", "theirs.toml", "-q", "--set", "train-ensemble.network=mine:net"]
    with pytest.raises(AttributeError):
        main([*words, "--out", "out", "--debug"])
    assert seen == [{"mine:net"}]
    monkeypatch.setenv(own_code.OF_FILE, "1")
    with own_code.given("evilmod:obj"):
        assert not own_code.allowed()


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
