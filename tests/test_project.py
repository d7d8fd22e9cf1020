"""The project around the package: set-up, versions, what imports what, and that its documents tell the truth."""

from __future__ import annotations

import ast
import fnmatch
import os
import re
import shutil
import subprocess
import sys
import tomllib
from collections.abc import Iterator
from importlib import metadata
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from packaging.requirements import Requirement
from packaging.utils import NormalizedName, canonicalize_name
from packaging.version import Version

import hypogoal
from hypogoal.core.artefacts import create
from hypogoal.core.seeding import torch_generator
from hypogoal.data import Collected, States, write_dataset
from hypogoal.hypotheses.ensemble import Ensemble, write_ensemble

ROOT = Path(__file__).resolve().parents[1]
PACKAGE = ROOT / "hypogoal"
PYPROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))
PROJECT = PYPROJECT["project"]
SETUP_FILES = ("pyproject.toml", "constraints.txt", "Makefile", ".ci/run")
# Not in constraints.txt: what a CUDA build of torch pulls in is fixed by torch itself.
TORCH_CUDA = ("nvidia-", "cuda-", "triton")
# Each costs more than the half second that --help may take.
HEAVY = {"torch", "scipy", "matplotlib", "h5py", "stable_baselines3"} | {"minigrid", "ale_py"}


def requirements() -> list[Requirement]:
    """Every requirement that pyproject.toml declares, the extras' too."""
    extras = [line for lines in PROJECT["optional-dependencies"].values() for line in lines]
    return [Requirement(line) for line in [*PROJECT["dependencies"], *extras]]


def pins() -> dict[NormalizedName, Version]:
    """constraints.txt as {canonical name: version}; a line of any other form fails."""
    found: dict[NormalizedName, Version] = {}
    for line in (ROOT / "constraints.txt").read_text(encoding="utf-8").splitlines():
        if line and not line.startswith("#"):
            match = re.fullmatch(r"([a-z0-9.-]+)==([0-9][0-9a-z.]*)", line)
            assert match, f"constraints.txt: {line!r} is not name==version"
            found[canonicalize_name(match[1])] = Version(match[2])
    return found


def test_version_is_said_once() -> None:
    """Spec A8: what an artefact's manifest, the package, the citation and the changelog call the version agrees."""
    version = PROJECT["version"]
    assert hypogoal.__version__ == version
    assert metadata.version("hypogoal") == version, "run `make setup` again"
    assert re.findall(r"^version: (.+)$", (ROOT / "CITATION.cff").read_text(encoding="utf-8"), re.M) == [version]
    headings = re.findall(r"^## (\S+)", (ROOT / "CHANGELOG.md").read_text(encoding="utf-8"), re.M)
    assert headings[0] == version


def test_each_requirement_is_pinned_within_its_range() -> None:
    """A fresh set-up takes exactly the versions tested, and pyproject.toml allows them."""
    known = pins()
    for requirement in requirements():
        pin = known.get(canonicalize_name(requirement.name))
        assert pin is not None, f"{requirement.name} is not in constraints.txt"
        assert pin in requirement.specifier, f"{requirement} does not allow the tested {pin}"


def test_constraints_reach_every_dependency() -> None:
    """Dependencies of dependencies are pinned too: two set-ups a month apart are the same."""
    known = pins()
    names = [requirement.name for requirement in requirements()]
    seen: set[NormalizedName] = set()
    while names:
        name = canonicalize_name(names.pop())
        if name in seen or name.startswith(TORCH_CUDA):
            continue
        seen.add(name)
        assert name in known, f"{name} is not in constraints.txt"
        for line in metadata.requires(name) or []:
            requirement = Requirement(line)
            if requirement.marker is None or requirement.marker.evaluate({"extra": ""}):
                names.append(requirement.name)
    assert len(seen) > len(requirements()), "the walk reached no dependency of a dependency"


@pytest.mark.parametrize("name", SETUP_FILES)
def test_set_up_names_no_host_and_no_machine_path(name: str) -> None:
    """Where packages come from is the user's pip configuration, not ours; nothing depends on one machine's folders."""
    text = (ROOT / name).read_text(encoding="utf-8")
    assert not re.findall(r"\w+://\S+|(?<![\w.])/(?:opt|home|root|work|tmp|mnt)/\S*", text)


def test_entry_points_load() -> None:
    """Spec B6: the console script and every domain that pyproject.toml announces exist under that name."""
    from hypogoal.domains.base import load_domain

    scripts = [("hypogoal", PROJECT["scripts"]["hypogoal"], "console_scripts")]
    domains = PROJECT["entry-points"]["hypogoal.domains"]
    for name, value, group in [*scripts, *((name, value, "hypogoal.domains") for name, value in domains.items())]:
        loaded = metadata.EntryPoint(name, value, group).load()
        if group == "console_scripts":
            assert callable(loaded)
        else:
            assert load_domain(name) is loaded
            assert loaded.name == name


def test_every_data_file_of_the_package_is_installed() -> None:
    """Presets and templates are in the wheel: each file that is not Python matches a package-data pattern."""
    patterns = PYPROJECT["tool"]["setuptools"]["package-data"]["hypogoal"]
    files = [path.relative_to(PACKAGE) for path in PACKAGE.rglob("*") if path.is_file()]
    data = [path for path in files if path.suffix != ".py" and "__pycache__" not in path.parts]
    assert any(path.suffix == ".toml" for path in data), "the presets are gone"
    for path in data:
        assert any(fnmatch.fnmatch(path.as_posix(), pattern) for pattern in patterns), f"{path} is not packaged"


def loaded_by(code: str) -> set[str]:
    """Top-level modules that a fresh interpreter has loaded after running ``code``."""
    script = f"import sys\n{code}\nprint(*sorted(name for name in sys.modules if '.' not in name))"
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=True, cwd=ROOT)
    return set(done.stdout.split())


def test_versions_of_python_are_those_that_are_tested() -> None:
    """Classifiers are those of ``make versions``, the first is the least allowed; extras that a line names exist."""
    named = re.findall(r"Python :: (3\.\d+)", "\n".join(PROJECT["classifiers"]))
    others = re.search(r"^OTHERS := (.*)$", (ROOT / "Makefile").read_text(encoding="utf-8"), re.M)
    assert others and ["3.11", *others[1].split()] == named and PROJECT["requires-python"] == ">=3.11"
    told = {
        name for path in PACKAGE.rglob("*.py") for name in re.findall(r"hypogoal\[(\w+)\]", path.read_text("utf-8"))
    }
    assert told == {"lerobot", "minari", "montezuma", "tensorboard"} and told <= PROJECT["optional-dependencies"].keys()


def test_import_is_light() -> None:
    """``import hypogoal`` and its command line load none of the heavy packages: they wait for the command."""
    assert "torch" in loaded_by("import torch"), "the check itself sees a loaded module"
    assert not HEAVY & loaded_by("import hypogoal, hypogoal.cli")


def test_help_is_light() -> None:
    """``hypogoal --help`` answers without any of them."""
    code = "import contextlib, io\nfrom hypogoal.cli import main\nwith contextlib.redirect_stdout(io.StringIO()):\n    "
    loaded = loaded_by(code + 'assert main(["--help"]) == 0')
    assert "typer" in loaded
    assert not HEAVY & loaded


def test_commands_load_what_they_need() -> None:
    """A run's plan and a stage's settings need no torch; SciPy's statistics are the evaluation's alone."""
    assert "torch" not in loaded_by("import hypogoal.experiments.run")
    assert "scipy" not in loaded_by("import hypogoal.stages.train_ensemble, hypogoal.stages.train_meta")


def unsafe(source: str) -> Iterator[str]:
    """Spec G2: what in this source could load or save a pickle."""
    modules = {"pickle", "cloudpickle", "dill", "joblib", "shelve", "marshal"}
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names if alias.name.split(".")[0] in modules)
        elif isinstance(node, ast.ImportFrom) and (node.module or "").split(".")[0] in modules:
            yield str(node.module)
        elif isinstance(node, ast.ImportFrom) and node.module == "torch":
            yield from (f"torch.{alias.name}" for alias in node.names if alias.name in ("load", "save"))
        elif isinstance(node, ast.Attribute) and node.attr in ("load", "save") and isinstance(node.value, ast.Name):
            if node.value.id in ("torch", "PPO", "DQN"):
                yield f"{node.value.id}.{node.attr}"
        elif isinstance(node, ast.keyword) and node.arg == "allow_pickle":
            yield from () if isinstance(node.value, ast.Constant) and node.value.value is False else ("allow_pickle",)


@pytest.mark.parametrize(
    "source",
    [
        "import pickle",
        "from cloudpickle import loads",
        "import torch\ntorch.load('weights', weights_only=True)",
        "from torch import load",
        "PPO.load('agent.zip')",
        "numpy.load('a.npy', allow_pickle=True)",
    ],
)
def test_unsafe_sources_are_recognised(source: str) -> None:
    """Spec G2: the search used below finds each way in."""
    assert list(unsafe(source))


def test_no_pickle_in_the_package() -> None:
    """Spec G2: no module of the package loads or saves a pickle, directly or through torch, NumPy or an agent."""
    sources = sorted(PACKAGE.rglob("*.py"))
    assert len(sources) > 20
    found = {str(path.relative_to(ROOT)): list(unsafe(path.read_text(encoding="utf-8"))) for path in sources}
    assert not {path: names for path, names in found.items() if names}


def readme() -> str:
    return (ROOT / "README.md").read_text(encoding="utf-8")


def make(folder: Path, *arguments: str) -> subprocess.CompletedProcess[str]:
    """Run make in ``folder`` as from a shell, also when these tests themselves run under make."""
    environment = {key: value for key, value in os.environ.items() if not key.startswith(("MAKE", "MFLAGS"))}
    return subprocess.run(["make", *arguments], cwd=folder, env=environment, capture_output=True, text=True)


def test_the_readme_is_short() -> None:
    assert len(readme().split()) <= 700


def test_readme_commands_exist() -> None:
    """Every ``make X`` and ``hypogoal X`` of the README is a target of the Makefile or a command of the program."""
    targets = set(re.findall(r"^([a-z]+):", (ROOT / "Makefile").read_text(encoding="utf-8"), re.M))
    named = set(re.findall(r"(?:^|`)\s*make ([a-z]+)", readme(), re.M))
    assert {"demo", "test"} <= named <= targets
    command = [sys.executable, "-c", "from hypogoal.cli import main; main()", "--help"]
    environment = os.environ | {"COLUMNS": "200", "NO_COLOR": "1", "TERM": "dumb"}
    done = subprocess.run(command, capture_output=True, text=True, check=True, cwd=ROOT, env=environment)
    commands = set(re.findall(r"^\W*([a-z]+(?:-[a-z]+)*)  +", done.stdout, re.M))
    named = set(re.findall(r"(?:^|`)\s*(?:\.venv/bin/)?hypogoal ([a-z]+(?:-[a-z]+)*)", readme(), re.M))
    assert "train-ensemble" in commands
    assert named, "the README shows no command of hypogoal"
    assert named <= commands


@pytest.mark.skipif(shutil.which("make") is None, reason="needs make")
def test_set_up_is_done_once_and_again_when_the_versions_change(tmp_path: Path) -> None:
    """From a fresh clone ``make demo`` and ``make test`` set up by themselves; later calls do not."""
    for name in ("Makefile", "pyproject.toml", "constraints.txt"):
        shutil.copy(ROOT / name, tmp_path / name)
    create, install = "-m venv .venv", "pip install"
    for target in ("demo", "test", "check", "bench"):
        fresh = make(tmp_path, "-n", target).stdout
        assert create in fresh
        assert install in fresh
        assert ("[dev]" in fresh) == (target != "demo"), "who runs the demo needs no developers' tools"
    (tmp_path / ".venv/bin").mkdir(parents=True)
    (tmp_path / ".venv/bin/python").touch()
    (tmp_path / ".venv/.installed-dev").touch()
    again = make(tmp_path, "-n", "test").stdout
    assert "pytest" in again
    assert create not in again
    assert install not in again
    later = (tmp_path / ".venv/.installed-dev").stat().st_mtime + 10
    os.utime(tmp_path / "constraints.txt", (later, later))
    changed = make(tmp_path, "-n", "test").stdout
    assert install in changed
    assert create not in changed


@pytest.mark.skipif(shutil.which("make") is None, reason="needs make")
def test_set_up_says_what_is_wrong_with_python(tmp_path: Path) -> None:
    """An unfit Python is named in one line and leaves no half-made environment behind."""
    for name in ("Makefile", "pyproject.toml", "constraints.txt"):
        shutil.copy(ROOT / name, tmp_path / name)
    done = make(tmp_path, "setup", "PYTHON=false")
    assert done.returncode != 0
    assert "needs Python 3.11" in done.stderr
    assert not (tmp_path / ".venv").exists()


@pytest.mark.skipif(shutil.which("git") is None, reason="needs git")
def test_results_are_not_committed_by_mistake(tmp_path: Path) -> None:
    """data/ and runs/ are ignored but for their README; sources are not."""
    shutil.copy(ROOT / ".gitignore", tmp_path)
    subprocess.run(["git", "init", "-q", "."], cwd=tmp_path, check=True)
    wanted = {"data/README.md", "runs/README.md", "hypogoal/data.py", "hypogoal/core/artefacts.py"}
    unwanted = {"data/doorkey.h5", "runs/demo/manifest.json", ".venv/bin/python", "tests/__pycache__/a.pyc"}
    paths = "\n".join(wanted | unwanted)
    done = subprocess.run(["git", "check-ignore", "--stdin"], cwd=tmp_path, input=paths, capture_output=True, text=True)
    assert set(done.stdout.split()) == unwanted
    for name in ("data", "runs"):
        assert (ROOT / name / "README.md").is_file()


def code_of(document: str) -> list[str]:
    """The Python blocks of a document."""
    return re.findall(r"^```python\n(.*?)^```", (ROOT / document).read_text(encoding="utf-8"), re.M | re.S)


def test_formats_are_readable_without_hypogoal(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """Spec A8: the snippets of docs/formats.md, which import nothing of ours, read what we write."""
    rng = np.random.default_rng(0)
    goals = ("collect-red-key", "open-red-door")

    def states(count: int) -> States:
        observations = rng.integers(256, size=(count, 8, 8, 3), dtype=np.uint8)
        return States(observations, rng.random((count, 2)) < 0.5, {"layout_seed": np.zeros(count, np.int64)})

    collected = Collected((8, 8, 3), goals, states(7), states(5), states(3))
    monkeypatch.chdir(tmp_path)
    data, ensemble = Path("data/doorkey.h5"), Path("runs/demo/ensemble")
    data.parent.mkdir()
    write_dataset(data, collected, domain="doorkey", config={}, seed=0)
    config = {"sub_goals": list(goals)}
    with create(ensemble, kind="ensemble", config=config, seed=0, inputs=[data]) as draft:
        member = Ensemble("doorkey", (64, 64, 3), 1, torch_generator(0, "weights")).eval()
        write_ensemble(draft.files, "open-red-door", member)

    snippets = code_of("docs/formats.md")
    assert len(snippets) == 4
    assert not any("hypogoal" in snippet for snippet in snippets)
    found: dict[str, Any] = {}
    for snippet in snippets:
        exec(compile(snippet, "docs/formats.md", "exec"), found)
    logits = member.logits(np.zeros((1, 64, 64, 3), np.uint8))[0]
    np.testing.assert_allclose(found["logits"].detach().numpy(), logits, atol=1e-6)
    printed = capsys.readouterr().out
    positives = int(collected.labelled.labels[:, 1].sum())
    assert f"open-red-door: 7 states, {positives} positives, uint8 (8, 8, 3)" in printed
    assert "5 unlabelled states" in printed
    assert "members.0.13.weight float32 (2, 100)" in printed

    (ensemble / "open-red-door.safetensors").write_bytes(b"changed")
    with pytest.raises(AssertionError, match="open-red-door"):
        exec(compile(snippets[1], "docs/formats.md", "exec"), {})
