"""The documentation's site: it builds without a warning, its commands run, its table of equations is true."""

import ast
import importlib
import re
import runpy
import shlex
import subprocess
import sys
from pathlib import Path

import pytest
from browser import needs_browser, run_in

import hypogoal
from hypogoal.cli import main

ROOT = Path(__file__).resolve().parents[1]
DOCS = ROOT / "docs"
# Appended to the commands as they stand, so that they end in seconds: fewer states, steps, episodes.
SHORT = {
    "collect": ("heldout_layouts=1", "unlabelled_seeds=1"),
    "train-ensemble": ("steps=3", "workers=1"),
    "train-options": ("steps=400", "warm_up=100", "max_episode_steps=60"),
    "train-meta": ("steps=400", "warm_up=100", "max_episode_steps=60"),
    "train-baseline": ("steps=640", "max_episode_steps=60"),
}
NOT_OURS = (
    "python3",
    ".venv/bin/pip",
    "pip",
    "make",
    "scancel",
    "export",
    "source",
    "uv",
)  # the Makefile and CI run them


def blocks(page: Path, language: str) -> list[str]:
    """The fenced blocks of a page in one language."""
    return re.findall(rf"^```{language}\n(.*?)^```", page.read_text(encoding="utf-8"), flags=re.DOTALL | re.MULTILINE)


def commands(page: Path) -> list[list[str]]:
    """The words of each command line in a page's ``sh`` blocks, comments left out."""
    lines = [line for block in blocks(page, "sh") for line in block.replace("\\\n", " ").splitlines()]
    return [words for line in lines if (words := shlex.split(line, comments=True))]


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The site, built as make docs builds it: a link that leads nowhere or a missing name is an error."""
    out = tmp_path_factory.mktemp("site")
    command = [sys.executable, "-m", "mkdocs", "build", "--strict", "--site-dir", str(out)]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout + done.stderr
    return out


@needs_browser
@pytest.mark.slow
@pytest.mark.parametrize("name", ["reference/settings.html", "results/agents.html"])
def test_the_widest_tables_fit_a_narrow_window(site: Path, name: str) -> None:
    """Nothing has to be scrolled sideways, because each row becomes a card. Chromium has no window below 500 pixels."""
    page = site / name
    script = """
        const wide = [...document.querySelectorAll("table"), document.documentElement];
        const widths = wide.map((each) => each.scrollWidth);
        document.title = [innerWidth, document.querySelectorAll("table[data-cards]").length, ...widths];
    """
    title, complaints = run_in(page, script, page.parent, "--window-size=500,900")
    width, cards, *widths = map(int, title.split(","))
    assert width == 500
    assert cards
    assert max(widths) <= width
    assert not complaints


def test_the_reference_is_that_of_the_code(site: Path) -> None:
    """Every command and every setting of every stage is in the reference, and every page is there."""
    from hypogoal.cli import commands as made_commands
    from hypogoal.core.config import STAGES
    from hypogoal.core.presets import described
    from hypogoal.experiments.experiment import config_class_of

    assert len(list(site.rglob("*.html"))) >= 15
    pages = {name: (site / f"reference/{name}.html").read_text(encoding="utf-8") for name in ("cli", "settings")}
    for name in made_commands():
        assert f"<code>hypogoal {name}</code>" in pages["cli"], name
    for stage in STAGES:
        for row in described(config_class_of(stage)):
            assert f"<code>{row['name']}</code>" in pages["settings"], (stage, row["name"])


@pytest.mark.slow
def test_the_tutorial_as_it_stands(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Every command of the tutorial, in its order, only shorter, and then the README's program on what they made."""
    monkeypatch.chdir(tmp_path)
    ran = set()
    for words in commands(DOCS / "tutorial.md"):
        assert words[0] == "hypogoal", words
        short = [part for pair in SHORT.get(words[1], ()) for part in ("--set", pair)]
        assert main([*words[1:], *short]) == 0, words
        ran.add(words[1])
    assert {*SHORT, "evaluate", "report", "show", "run"} <= ran
    assert (tmp_path / "runs/tutorial/report/index.html").is_file()
    for block in blocks(ROOT / "README.md", "python"):
        exec(compile(block.replace("runs/demo", "runs/tutorial"), "README.md", "exec"), {})


def test_the_other_pages_name_commands_that_are_there() -> None:
    """A command in any page is one of ours with options that it has."""
    from hypogoal.cli import commands as made_commands

    ours = made_commands()
    seen = 0
    for page in (*DOCS.rglob("*.md"), ROOT / "README.md"):
        for words in commands(page):
            if words[0].startswith(NOT_OURS):
                continue
            assert words[0] in ("hypogoal", "python"), (page.name, words)
            if words[0] == "hypogoal":
                options = {name for option in ours[words[1]].params for name in option.opts}
                used = {word.partition("=")[0] for word in words[2:] if word.startswith("--")}
                assert used <= {*options, "--trust"}, (page.name, words)
                seen += 1
    assert seen > 20


def test_equations_lead_to_code() -> None:
    """Spec, head: a reader finds each equation of the paper in ten seconds."""
    rows = re.findall(
        r"^\| [^|]+ \| ([^|]+`hypogoal/[^|]+|`hypogoal/[^|]+) \|$", (DOCS / "concepts.md").read_text(), re.M
    )
    assert len(rows) >= 15
    for row in rows:
        file = None
        for name in re.findall(r"`([^`]+)`", row):
            if "/" in name:
                file = ROOT / name
                assert file.is_file(), name
            else:
                dotted = ".".join(file.relative_to(ROOT).with_suffix("").parts)
                module = importlib.import_module(dotted.removesuffix(".__init__"))
                assert hasattr(module, name), (row, name)


def test_links_lead_to_files_of_a_checkout() -> None:
    """Each of every page; that they work on the site, too, is MkDocs' own test."""
    pages = [*DOCS.rglob("*.md"), *(path for path in ROOT.glob("*.md") if path.name != "CHANGELOG.md")]
    dead = []
    for page in pages:
        text = re.sub("```.*?```", "", page.read_text(encoding="utf-8"), flags=re.S)
        for link in re.findall(r"\]\(([^)#\s]+)(?:#[^)]*)?\)", text):
            if not link.startswith("http") and not (page.parent / link).exists():
                dead.append((page.name, link))
    assert not dead and len(pages) > 20


def test_readme_and_the_sites_first_page_are_one_text() -> None:
    """``python docs/home.py`` would change nothing; pictures are drawn as they were."""
    page = runpy.run_path(str(DOCS / "home.py"))
    assert page["home"]() == (DOCS / "index.md").read_text(encoding="utf-8")


def test_the_picture_of_the_stages_is_drawn_from_their_code() -> None:
    """``python docs/stages.py`` would change nothing; each stage reads and writes what it declares."""
    picture = runpy.run_path(str(DOCS / "stages.py"))
    assert picture["drawn"]() == (DOCS / "stages.svg").read_text(encoding="utf-8")
    stage = ROOT / "hypogoal" / "stages" / "train_meta.py"
    assert picture["declared"](stage) == ("train-meta", ["ensemble", "options"], "meta")


def test_pictures_of_a_report_are_of_this_version() -> None:
    """``python docs/pictures.py RUN`` renews them and writes the version into them."""
    pictures = runpy.run_path(str(DOCS / "pictures.py"))
    for name in ("REPORT", "FILM"):
        assert pictures["version_of"](pictures[name]) == hypogoal.__version__


def test_editors_are_shown_the_signatures_of_the_code() -> None:
    """``python docs/signatures.py`` would change nothing; a name that Python gives is in the file, too."""
    signatures = runpy.run_path(str(DOCS / "signatures.py"))
    text = signatures["STUB"].read_text(encoding="utf-8")
    assert signatures["stub"]() == text
    shown = {node.name for node in ast.parse(text).body if isinstance(node, ast.FunctionDef)}
    shown |= set(re.findall(r" as (\w+)$", text, flags=re.MULTILINE))
    assert shown | {"__version__"} == set(hypogoal.__all__)


def test_requirements_lead_to_tests() -> None:
    """Each requirement is cited by a test; tests cite nothing else. The package does without such numbers."""
    listed = (DOCS / "requirements.md").read_text(encoding="utf-8")
    numbers = re.findall(r"^- \*\*([A-I]\d)\*\* ", listed, re.MULTILINE)
    assert set(numbers) == cited("tests") and len(numbers) > 50 and not cited("hypogoal")


def cited(folder: str) -> set[str]:
    """The requirements' numbers in a folder's files."""
    paths = [path for path in (ROOT / folder).rglob("*") if path.suffix in (".py", ".toml")]
    text = "".join(path.read_text(encoding="utf-8") for path in paths)
    marks = re.findall(r"Spec [A-I]\d(?:[-, ]+[A-I]\d)*", text)
    return set(re.findall(r"[A-I]\d", " ".join(marks)))
