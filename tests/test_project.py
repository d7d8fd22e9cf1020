"""The project around the package: set-up, versions, what imports what, and that its formats' page tells the truth."""

import fnmatch
import os
import re
import shutil
import subprocess
import sys
import tomllib
from importlib import metadata
from pathlib import Path
from typing import Any

import pytest
from packaging.requirements import Requirement
from packaging.utils import NormalizedName, canonicalize_name
from packaging.version import Version
from test_docs import blocks
from toy_data import write

import hypogoal
from hypogoal.core.drafts import create
from hypogoal.core.seeding import torch_generator
from hypogoal.data import open_dataset
from hypogoal.domains.find import load_domain
from hypogoal.hypotheses.ensemble import Ensemble, write_ensemble

ROOT = Path(__file__).resolve().parents[1]
PACKAGE = ROOT / "hypogoal"
PYPROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))
PROJECT = PYPROJECT["project"]
# Not in constraints.txt: what a CUDA build of torch pulls in is fixed by torch itself.
TORCH_CUDA = ("nvidia-", "cuda-", "triton")
# Each costs more than the half second that --help may take.
HEAVY = {"torch", "scipy", "matplotlib", "h5py", "stable_baselines3"} | {"minigrid", "ale_py"}
HELP = """import contextlib, io, hypogoal.experiments.plan, hypogoal.experiments.run
from hypogoal.cli import main
with contextlib.redirect_stdout(io.StringIO()):
    assert main(["--help"]) == 0"""
STEP = """import torch
from hypogoal.core.adam import Adam
weight = torch.ones(3, requires_grad=True)
weight.sum().backward()
Adam([weight], 0.1).step()"""
TRAINING = """import hypogoal.stages.train_ensemble, hypogoal.stages.train_meta
import hypogoal.hypotheses.sub_goals, hypogoal.meta.training"""
UNSAFE = re.compile(r"(torch|PPO|DQN)\.(load|save)\(|allow_pickle(?!=False)|from torch import .*\b(load|save)\b")


def text_of(name: str) -> str:
    return (ROOT / name).read_text(encoding="utf-8")


def requirements() -> list[Requirement]:
    """Every requirement that pyproject.toml declares, the extras' too."""
    extras = [line for lines in PROJECT["optional-dependencies"].values() for line in lines]
    return [Requirement(line) for line in [*PROJECT["dependencies"], *extras]]


def pins() -> dict[NormalizedName, Version]:
    """constraints.txt as {canonical name: version}; a line of any other form fails."""
    found: dict[NormalizedName, Version] = {}
    for line in text_of("constraints.txt").splitlines():
        if line and not line.startswith("#"):
            match = re.fullmatch(r"([a-z0-9.-]+)==([0-9][0-9a-z.]*)", line)
            assert match, f"constraints.txt: {line!r} is not name==version"
            found[canonicalize_name(match[1])] = Version(match[2])
    return found


def test_version_is_said_once() -> None:
    """Spec A8: what an artefact's manifest, the package, the citation and the changelog call the version agrees."""
    cited = re.findall(r"^version: (.+)$", text_of("CITATION.cff"), re.M)
    changed = re.findall(r"^## (\S+)", text_of("CHANGELOG.md"), re.M)
    assert metadata.version("hypogoal") == PROJECT["version"], "run `make setup` again"
    assert {hypogoal.__version__, *cited, changed[0]} == {PROJECT["version"]}


def test_constraints_reach_every_dependency() -> None:
    """A fresh set-up takes the versions tested, which pyproject.toml allows; dependencies of dependencies, too."""
    known = pins()
    for requirement in requirements():
        pin = known[canonicalize_name(requirement.name)]
        assert pin in requirement.specifier, f"{requirement} does not allow the tested {pin}"
    names = [requirement.name for requirement in requirements()]
    seen: set[NormalizedName] = set()
    while names:
        name = canonicalize_name(names.pop())
        if name in seen or name.startswith(TORCH_CUDA):
            continue
        seen.add(name)
        assert name in known, f"{name} is not in constraints.txt"
        if metadata.version(name) != str(known[name]):  # its dependencies are those of another version
            continue
        for line in metadata.requires(name) or []:
            requirement = Requirement(line)
            if requirement.marker is None or requirement.marker.evaluate({"extra": ""}):
                names.append(requirement.name)
    direct = {canonicalize_name(requirement.name) for requirement in requirements()}
    assert seen - direct, "the walk reached no dependency of a dependency"


@pytest.mark.parametrize("name", ["pyproject.toml", "constraints.txt", "Makefile", ".ci/run"])
def test_set_up_names_no_host_and_no_machine_path(name: str) -> None:
    """Where packages come from is the user's pip configuration, not ours; nothing depends on one machine's folders."""
    assert not re.findall(r"\w+://\S+|(?<![\w.])/(?:opt|home|root|work|tmp|mnt)/\S*", text_of(name))


def test_each_deviation_has_a_number_of_its_own() -> None:
    numbers = re.findall(r"^\| \*\*(DEV-\d+)\*\*", text_of("docs/deviations.md"), re.M)
    assert len(numbers) == len({*numbers}) > 30


def test_entry_points_load() -> None:
    """Spec B6: the console script and every domain that pyproject.toml announces exist under that name."""
    assert callable(metadata.EntryPoint("hypogoal", PROJECT["scripts"]["hypogoal"], "console_scripts").load())
    for name, value in PROJECT["entry-points"]["hypogoal.domains"].items():
        loaded = metadata.EntryPoint(name, value, "hypogoal.domains").load()
        assert load_domain(name) is loaded and loaded.name == name


def test_every_data_file_of_the_package_is_installed() -> None:
    """Presets and templates are in the wheel: each file that is not Python matches a package-data pattern."""
    patterns = PYPROJECT["tool"]["setuptools"]["package-data"]["hypogoal"]
    files = [path.relative_to(PACKAGE) for path in PACKAGE.rglob("*") if path.is_file()]
    data = [path for path in files if path.suffix != ".py" and "__pycache__" not in path.parts]
    assert any(path.suffix == ".toml" for path in data), "the presets are gone"
    for path in data:
        assert any(fnmatch.fnmatch(path.as_posix(), pattern) for pattern in patterns), f"{path} is not packaged"


def test_extras_that_a_line_names_exist() -> None:
    sources = "".join(path.read_text("utf-8") for path in PACKAGE.rglob("*.py"))
    named = ",".join(re.findall(r"hypogoal\\*\[([\w,]+)\]", sources)).split(",")
    assert {*named} == {"lerobot", "minari", "montezuma", "tensorboard"} <= PROJECT["optional-dependencies"].keys()


@pytest.mark.parametrize(
    ("code", "loaded", "unloaded"),
    [
        (STEP, {"torch"}, {"torch._dynamo"}),
        (HELP, {"typer", "hypogoal.experiments.run"}, HEAVY),
        (TRAINING, {"torch"}, {"scipy", "pandas", "matplotlib"}),
        ("import hypogoal.evaluation.run", {"pandas"}, {"matplotlib", "jinja2", "rich"}),
    ],
)
def test_imports_are_light(code: str, loaded: set[str], unloaded: set[str]) -> None:
    """Heavy packages wait for the command that needs them, SciPy's statistics for the evaluation."""
    script = f"import sys\n{code}\nprint(*sys.modules)"
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=True, cwd=ROOT)
    names = {*done.stdout.split()}
    assert loaded <= names and not unloaded & names


def test_no_pickle_in_the_package() -> None:
    """Spec G2: none through torch, NumPy or an agent; import-linter forbids pickle's own modules."""
    for source in ("torch.load(path, weights_only=True)", "PPO.load('agent.zip')", "np.load(p, allow_pickle=True)"):
        assert UNSAFE.search(source)
    sources = sorted(PACKAGE.rglob("*.py"))
    assert len(sources) > 20
    assert not [path for path in sources if UNSAFE.search(path.read_text(encoding="utf-8"))]


def test_the_targets_that_the_readme_names_exist() -> None:
    """Every ``make X`` is a target of the Makefile; of other commands see ``test_docs``."""
    text = text_of("README.md")
    targets = {*re.findall(r"^([a-z]+):", text_of("Makefile"), re.M)}
    assert {"demo", "test"} <= {*re.findall(r"(?:^|`)\s*make ([a-z]+)", text, re.M)} <= targets


def make(folder: Path, *arguments: str) -> subprocess.CompletedProcess[str]:
    """Run make in ``folder`` as from a shell, also when these tests themselves run under make."""
    environment = {key: value for key, value in os.environ.items() if not key.startswith(("MAKE", "MFLAGS"))}
    return subprocess.run(["make", *arguments], cwd=folder, env=environment, capture_output=True, text=True)


@pytest.mark.skipif(shutil.which("make") is None, reason="needs make")
def test_set_up_is_done_once_and_again_when_the_versions_change(tmp_path: Path) -> None:
    """``make demo`` and ``make test`` set up by themselves; an unfit Python is one line, and nothing is left of it."""
    clone = tmp_path
    for name in ("Makefile", "pyproject.toml", "constraints.txt"):
        shutil.copy(ROOT / name, clone)
    done = make(clone, "setup", "PYTHON=false")
    assert done.returncode != 0 and "needs Python 3.11" in done.stderr and not (clone / ".venv").exists()
    assert "-m venv .venv" in make(clone, "-n", "test").stdout
    (clone / ".venv/bin").mkdir(parents=True)
    (clone / ".venv/bin/python").touch()
    (clone / ".venv/.installed-dev").touch()
    again = make(clone, "-n", "test").stdout
    assert "pytest" in again and "pip install" not in again
    later = (clone / ".venv/.installed-dev").stat().st_mtime + 10
    os.utime(clone / "constraints.txt", (later, later))
    assert "pip install" in make(clone, "-n", "test").stdout


@pytest.mark.skipif(shutil.which("make") is None, reason="needs make")
def test_floors_are_the_lowest_versions_declared(tmp_path: Path) -> None:
    """``make floors`` installs those, the extras' too; each dependency has one."""
    for name in ("Makefile", "pyproject.toml"):
        shutil.copy(ROOT / name, tmp_path)
    make(tmp_path, "build/floors.txt")
    floors = (tmp_path / "build/floors.txt").read_text("utf-8").splitlines()
    lowest: set[str] = set()
    for need in requirements():
        lowest |= {f"{need.name}=={limit.version}" for limit in need.specifier if limit.operator == ">="}
    assert {*floors} == lowest
    assert len(floors) == len({need.name for need in requirements()})


def test_formats_are_readable_without_hypogoal(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """Spec A8: the snippets of docs/formats.md, which import nothing of ours, read what we write."""
    monkeypatch.chdir(tmp_path)
    Path("data").mkdir()
    goals = ("collect-red-key", "open-red-door")
    data = write(Path("data/doorkey.h5"), goals=goals)
    ensemble = Path("runs/demo/ensemble")
    with create(ensemble, kind="ensemble", config={"sub_goals": goals}, seed=0, inputs=[data]) as draft:
        member = Ensemble("doorkey", (64, 64, 3), 1, torch_generator(0, "weights")).eval()
        write_ensemble(draft.files, "open-red-door", member)
    snippets = blocks(ROOT / "docs/formats.md", "python")
    numbers = Path("runs/demo/evaluation/numbers.csv")
    numbers.parent.mkdir()
    numbers.write_text("quantity,value,method,scope,step\nsuccess,0.5,option agent,,\n")
    assert len(snippets) == 3 and not any("hypogoal" in snippet for snippet in snippets)
    found: dict[str, Any] = {}
    for snippet in snippets:
        exec(compile(snippet, "docs/formats.md", "exec"), found)
    printed = capsys.readouterr().out
    assert "option agent" in printed
    positives = int(open_dataset(data).labelled("open-red-door").labels.sum())
    assert f"open-red-door: 7 states, {positives} positives, uint8 (4, 5, 3)" in printed
    assert "7 unlabelled states" in printed and "members.0.13.weight float32 (2, 100)" in printed


def test_the_changelog_is_short() -> None:
    """A line a change, of at most twenty words, under one of four headings; three lines a version up to 0.15."""
    text = text_of("CHANGELOG.md")
    headings = ["Added", "Changed", "Fixed", "Removed"]
    for version in text.split("\n## ")[1:]:
        number, *lines = version.splitlines()
        changes = [line for line in lines if line.startswith("- ")]
        assert changes and all(len(line.split()) <= 21 for line in changes), number
        used = re.findall(r"^### (\w+)$", version, re.M)
        assert used == [heading for heading in headings if heading in used], number
        early = tuple(map(int, number.split("."))) < (0, 16, 0)
        assert (not used and len(changes) == 3) if early else used, number
