"""The command line as a newcomer meets it: help, settings as options, what a stage says (Spec A6, A8)."""

import json
import os
import re
import subprocess
import sys
from pathlib import Path

import pytest
from command_line import refuses, run

from hypogoal import cli
from hypogoal.command.stage import LISTED, load_stage
from hypogoal.core.errors import UserError

ROOT = Path(__file__).resolve().parents[2]
COMMANDS = cli.commands()
TRAIN = ["train-baseline", "doorkey", "--set", "max_episode_steps=20", "-q"]


@pytest.fixture(autouse=True)
def terminal(monkeypatch: pytest.MonkeyPatch) -> None:
    """80 columns, without colours."""
    for name, value in {"COLUMNS": "80", "NO_COLOR": "1", "TERM": "dumb"}.items():
        monkeypatch.setenv(name, value)


def test_help_is_in_groups_with_a_line_to_start_from() -> None:
    """Groups in their order, every command in one of them, nothing wider than the terminal."""
    lines = run("--help").out.splitlines()
    panels = [line.split()[1] for line in lines if line.startswith("╭─")]
    named = [match[1] for line in lines if (match := re.match(r"│ ([a-z][a-z-]+)  +\S", line))]
    assert panels == ["Options", "Make", "Look", "Own"]
    assert sorted(named) == sorted(COMMANDS)
    assert named.index("run") < named.index("collect") < named.index("train-ensemble") < named.index("show")
    assert any(line.strip().startswith("Start here: hypogoal run") for line in lines)
    assert max(map(len, lines)) <= 80


@pytest.mark.parametrize("name", [*COMMANDS])
def test_help_ends_with_an_example_that_can_be_typed(name: str) -> None:
    """Of options that the command has; what lists of commands say of a stage is what its own help says first."""
    text = run(name, "--help").out
    lines = [line.strip() for line in text.splitlines() if line.strip()]
    assert max(map(len, text.splitlines())) <= 80
    if name in LISTED:
        assert lines[1] == LISTED[name] == str(load_stage(name).function.__doc__).splitlines()[0]
    assert lines[-2] == "Example:" and lines[-1].startswith(f"hypogoal {name} ")
    options = {option for parameter in COMMANDS[name].params for option in parameter.opts}
    assert {word for word in lines[-1].split() if word.startswith("--")} <= options


def test_an_option_is_a_setting(tmp_path: Path) -> None:
    """--steps and --set are one; --set goes before; what it may not be is one line, code 2."""
    run(*TRAIN, "--steps", "64", "--set", "steps=640", "--setting", "paper", "--out", tmp_path / "made")
    config = json.loads((tmp_path / "made" / "manifest.json").read_text())["config"]
    assert (config["steps"], config["setting"]) == (640, "paper")
    refuses("steps='0'", *TRAIN, "--steps", "0", "--out", tmp_path / "none")


@pytest.mark.parametrize(
    ("command", "words"),
    [
        ("train-ensemble d --out o --bogus 3", "--set KEY=VALUE; 'hypogoal config train-ensemble' lists them"),
        ("show runs --bogus", "See 'hypogoal show --help'"),
        ("train-meta", "'. See 'hypogoal train-meta --help'"),
        ("frobnicate", "See 'hypogoal --help'"),
    ],
)
def test_unknown_words_lead_on(command: str, words: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """One line, code 2: where to read on."""
    monkeypatch.chdir(tmp_path)
    refuses(words, *command.split())


def test_a_stage_says_what_it_came_to_and_what_is_next(tiny_run: Path, tmp_path: Path) -> None:
    """Then where its output is; of that alone with --quiet."""
    folder = tmp_path / "run"
    train = ["train-ensemble", tiny_run / "data.h5", "--out", folder / "ensemble", "--steps", "2"]
    train += ["--set", "workers=1", "--set", "sub_goals=collect-blue-key"]
    *_, result, then, path = run(*train).out.splitlines()
    assert re.fullmatch(r"held-out balanced accuracy: best member [\d.]+, mean [\d.]+, worst [\d.]+", result)
    assert then == f"next: hypogoal train-options {folder}/ensemble --out {folder}/options"
    assert path == str(folder / "ensemble")
    assert run(*train, "-q", "--force").out.splitlines() == [path]


def test_debug_shows_the_traceback(tmp_path: Path) -> None:
    """Of a mistake, too; without it there is one line."""
    with pytest.raises(UserError, match="no such file or folder"):
        cli.main(["show", str(tmp_path / "none"), "--debug"])


def test_a_shell_completes() -> None:
    """Commands, and options of a stage: as bash asks for them."""
    for typed, offered in (("train-m", {"train-meta"}), ("train-ensemble --memb", {"--members"})):
        asked = {"COMP_WORDS": f"hypogoal {typed}", "COMP_CWORD": str(len(typed.split(" ")))}
        around = os.environ | asked | {"_HYPOGOAL_COMPLETE": "complete_bash"}
        done = subprocess.run([sys.executable, "-m", "hypogoal"], cwd=ROOT, env=around, capture_output=True, text=True)
        assert {*done.stdout.splitlines()} == offered
