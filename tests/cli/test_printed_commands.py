"""What is printed as a command works as printed: after a stage, and as what an error says to do (Spec A8, G2)."""

from __future__ import annotations

import ast
import re
import shlex
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from typer.main import get_command

from hypogoal.cli import app, main
from hypogoal.core import own_code
from hypogoal.evaluation.run import read_evaluation

TESTS, PACKAGE = Path(__file__).parents[1], Path(own_code.__file__).parents[1]
PRINTED = re.compile(r"hypogoal .*$")
OWN = """
from corridor_env import SUB_GOALS, CorridorEnv, Sensed
from hypogoal import GymnasiumDomain
from margin import pair_loss
from wide_network import wide

PLAY = {"steps": 200, "environments": 4, "warm_up": 50, "max_episode_steps": 20, "random_episodes": 1}
FEW = {
    "collect": {"steps": 150, "heldout_seeds": (4, 5)},
    "train-ensemble": {"steps": 2, "members": 2, "workers": 1},
    "train-options": PLAY,
    "train-meta": PLAY,
}
DOMAIN = GymnasiumDomain(CorridorEnv, SUB_GOALS, defaults=FEW)
NUMBERS = GymnasiumDomain(Sensed, SUB_GOALS, defaults=FEW)
"""
Shell = Callable[[str], str]


@pytest.fixture
def shell(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> Iterator[Shell]:
    """Types a line into ``sh``, whose words our program gets, in a folder with own code; gives back all it prints."""
    folder = tmp_path / "where it's  at"
    folder.mkdir()
    (folder / "tiny.py").write_text(OWN)
    monkeypatch.chdir(folder)
    for place in (TESTS, TESTS.parent / "examples", folder):
        monkeypatch.syspath_prepend(str(place))

    def typed(line: str, code: int = 0) -> str:
        script = f"hypogoal() {{ printf '%s\\0' \"$@\"; }}; {line}"
        done = subprocess.run(["sh", "-c", script], env={}, capture_output=True, text=True, check=True)
        own_code._allowed.clear()  # as in a process of its own
        capsys.readouterr()
        assert main(done.stdout.split("\0")[:-1]) == code, (line, capsys.readouterr())
        printed = capsys.readouterr()
        return printed.out + printed.err

    yield typed
    sys.modules.pop("tiny", None)


def printed(text: str, lead: str) -> str:
    """The command behind ``lead``, which is all that is behind it in its line."""
    (line,) = (line for line in text.splitlines() if lead in line)
    command_line = line.partition(lead)[2].rstrip(")")
    assert PRINTED.fullmatch(command_line), line
    return command_line


def test_what_follows_a_stage_with_code_of_ones_own(shell: Shell) -> None:
    """From collecting to the report nothing is typed but what was printed; paths have spaces and a quote in them."""
    line = 'hypogoal collect tiny:DOMAIN --out "it\'s  mine/data.h5"'
    ran = []
    while line:
        ran.append(line)
        text = shell(line)
        line = printed(text, "next: ") if "next: " in text else ""
    stages = ["collect", "train-ensemble", "train-options", "train-meta", "evaluate", "report"]
    assert [shlex.split(line)[1] for line in ran] == stages
    assert all(line.endswith(" --trust") for line in ran[1:])
    assert Path("it's  mine/report/index.html").is_file()


def test_what_follows_allows_networks_and_objectives_too(shell: Shell) -> None:
    """All code that the next command's files name."""
    text = shell("hypogoal collect tiny:DOMAIN --out data.h5")
    line = printed(text, "next: ") + " --diversity tiny:pair_loss --set network=tiny:wide"
    line = printed(shell(line), "next: ")
    assert line == "hypogoal train-options ensemble --out options --trust"
    assert "next: " in shell(line)


def test_what_follows_pictures(shell: Shell) -> None:
    """An imported folder of images; training is shortened by what is added behind."""
    few = " --steps 2 --members 2 --set workers=1"
    for number, kind in enumerate(("positive", "negative", "unlabelled")):
        folder = Path("my  photos") / kind
        folder.mkdir(parents=True)
        for index in range(6):
            picture = np.full((48, 48, 3), 40 * number + index, np.uint8)
            Image.fromarray(picture).save(folder / f"{index}.png")
    line = printed(shell("hypogoal import 'my  photos' --out 'my  photos.h5' --domain tiny:DOMAIN"), "next: ")
    assert line.endswith(" --trust") and "next: " in shell(line + few)


def test_what_an_error_says_to_do(shell: Shell) -> None:
    """Each is typed as it stands, with code of one's own that this process was not told of."""
    shell("hypogoal collect tiny:DOMAIN --out 'a run/data.h5' -q")
    refusal = shell("hypogoal train-ensemble 'a run/data.h5' --out 'a run/ensemble' -q", 2)
    assert "Do you trust it? Give --trust" in refusal
    shell("hypogoal train-ensemble 'a run/data.h5' --out 'a run/ensemble' -q --trust")
    shell(printed(shell("hypogoal report 'a run'", 2), "First run: ") + " --trust")
    shell("hypogoal report 'a run'")
    shell("hypogoal train-options 'a run/ensemble' --out 'a run/options' -q --trust")
    since = read_evaluation(Path("a run")).metrics["missing"]
    shell(printed(since[-1], "options: made since this evaluation (evaluate it again: ") + " --trust")
    assert read_evaluation(Path("a run")).metrics["missing"] == []
    shell("hypogoal collect tiny:NUMBERS --out 'num  bers.h5' -q")
    text = shell("hypogoal show 'num  bers.h5' --pictures sheets", 2)
    assert "num  bers.npz" in shell(printed(text, "Read them as arrays: "))
    for given in ("collect tiny:DOMAIN", "collect doorkey", "collect montezuma", "train-baseline doorkey"):
        text = shell(f"hypogoal {given} --out x --set bogus=1", 2)
        assert " = " in shell(printed(text, "All of them: "))
    shell(printed(shell("hypogoal train-ensemble nothing.h5 --out x", 2), "How to make it: "))
    Path("not yet").mkdir()
    shell(printed(shell("hypogoal evaluate 'not yet'", 2), "Train something into it first: "))
    for given in ("collect", "train-meta e --out o --gae-lambda 3", "show runs --bogus"):
        (line,) = re.findall(r"'(hypogoal [^']+)'", shell(f"hypogoal {given}", 2))
        shell(line)


def texts(tree: ast.AST) -> Iterator[ast.Constant | ast.JoinedStr]:
    """The texts in a module that are no docstrings; of one that has parts, the whole."""
    passed: set[int] = set()
    for node in ast.walk(tree):  # what stands around another comes before it
        if isinstance(node, ast.Expr):
            passed.add(id(node.value))
        elif isinstance(node, ast.JoinedStr):
            passed |= {id(part) for part in node.values}
            yield node
        elif isinstance(node, ast.Constant) and isinstance(node.value, str) and id(node) not in passed:
            yield node


def test_commands_in_texts_work(shell: Shell) -> None:
    """Those that stand in our texts are typed; those with something filled in come from one place, which quotes."""
    known = "|".join(get_command(app).commands)  # type: ignore[attr-defined]
    found = set()
    for path in PACKAGE.rglob("*.py"):
        for node in texts(ast.parse(path.read_text(encoding="utf-8"))):
            if isinstance(node, ast.Constant):
                found |= {*re.findall(r"'(hypogoal [^']+)'", node.value)}
            elif path.name != "slurm.py" and path.parent.name != "cli":  # a script; names of commands
                assert not re.search(rf"hypogoal ({known}) .*\{{", ast.unparse(node)), path
    assert found == {"hypogoal config"}
    for line in found:
        shell(line)
