"""What is published installs into an empty environment elsewhere, and works there."""

import os
import shutil
import subprocess
import sys
import sysconfig
import venv
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
SDIST = "import sys; from setuptools import build_meta; build_meta.build_sdist(sys.argv[1])"
WHEEL = "pip wheel --no-deps --wheel-dir dist ."  # as README has it
WHERE = "import hypogoal; print(hypogoal.__file__)"


@pytest.fixture
def checkout(tmp_path: Path) -> Path:
    """The files that git knows, since building leaves others beside them."""
    listed = subprocess.run(["git", "ls-files", "-z"], cwd=ROOT, capture_output=True, text=True, check=False)
    if listed.returncode:
        pytest.skip("no checkout of git")
    copy = tmp_path / "hypogoal"
    for name in listed.stdout.strip("\0").split("\0"):
        if (ROOT / name).is_file():
            (copy / name).parent.mkdir(parents=True, exist_ok=True)
            shutil.copy(ROOT / name, copy / name)
    return copy


def builder_of(kind: str, folder: Path) -> list[str]:
    """The words behind ``python`` that build a package of this kind into a folder."""
    if kind == "sdist":
        return ["-c", SDIST, str(folder)]
    return ["-m", *WHEEL.split(), "--no-build-isolation", "--no-index"]


def test_readme_says_how_a_wheel_is_made() -> None:
    """The command that the test below runs, but for building without a network."""
    assert f"\n{WHEEL}\n" in (ROOT / "README.md").read_text(encoding="utf-8")


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["wheel", "sdist", "editable"])
def test_it_installs_elsewhere_and_runs_the_demos_first_stage(kind: str, checkout: Path, tmp_path: Path) -> None:
    """Dependencies are those of this environment; hypogoal is not in it but by a link, which a path does not carry.

    Python runs beside the checkout, whose folder has the package's name.
    """
    pytest.importorskip("setuptools", minversion="77")

    def called(*words: object) -> str:
        command = [str(word) for word in words]
        surroundings = {name: value for name, value in os.environ.items() if name != "PYTHONPATH"}
        done = subprocess.run(command, cwd=tmp_path, env=surroundings, capture_output=True, text=True, check=False)
        assert done.returncode == 0, done.stdout + done.stderr
        return done.stdout

    package = ["-e", checkout]
    if kind != "editable":
        built = checkout / "dist"
        subprocess.run([sys.executable, *builder_of(kind, built)], cwd=checkout, capture_output=True, check=True)
        package = [*built.iterdir()]
    elsewhere = tmp_path / "environment"
    venv.create(elsewhere)
    (site,) = elsewhere.glob("lib/python*/site-packages")
    (site / "dependencies.pth").write_text(sysconfig.get_path("purelib") + "\n", encoding="utf-8")
    python = elsewhere / "bin" / "python"
    offline = ("--no-deps", "--no-index", "--no-build-isolation", "--quiet")
    called(sys.executable, "-m", "pip", "--python", python, "install", *offline, *package)
    assert Path(called(python, "-c", WHERE).strip()).is_relative_to(checkout if kind == "editable" else elsewhere)
    data = tmp_path / "data.h5"
    few = ("--set", "heldout_layouts=1", "--set", "unlabelled_seeds=1")
    called(elsewhere / "bin" / "hypogoal", "collect", "doorkey", "--preset", "demo", *few, "--out", data)
    assert str(data) in called(elsewhere / "bin" / "hypogoal", "verify", data)
