"""What is printed as a command works as printed: after a stage, and as what an error says to do (Spec A8, G2)."""

import re
import shlex
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from hypogoal.cli import main
from hypogoal.core import own_code
from hypogoal.evaluation.run import read_evaluation

TESTS = Path(__file__).parents[1]
OWN = """
from corridor_env import SUB_GOALS, CorridorEnv
from hypogoal import GymnasiumDomain
from margin import pair_loss
from wide_network import wide

PLAY = {"steps": 200, "environments": 4, "warm_up": 50, "max_episode_steps": 20}
FEW = {
    "collect": {"steps": 150, "heldout_seeds": (4, 5)},
    "train-ensemble": {"steps": 2, "members": 2, "workers": 1},
    "train-options": PLAY,
    "train-meta": PLAY,
}
DOMAIN = GymnasiumDomain(CorridorEnv, SUB_GOALS, defaults=FEW)
"""
Shell = Callable[..., str]


@pytest.fixture
def shell(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> Iterator[Shell]:
    """Types a line into ``sh``, whose words our program gets, in a folder with own code; gives back all it prints."""
    folder = tmp_path / "where it's  at"
    folder.mkdir()
    (folder / "tiny.py").write_text(OWN)
    (folder / "few.toml").write_text("[train-meta]\ndecisions = 16\n")
    monkeypatch.chdir(folder)
    for place in (TESTS, TESTS.parent / "examples", folder):
        monkeypatch.syspath_prepend(str(place))

    def typed(line: str, code: int = 0) -> str:
        script = f"hypogoal() {{ printf '%s\\0' \"$@\"; }}; {line}"
        done = subprocess.run(["sh", "-c", script], env={}, capture_output=True, text=True, check=True)
        own_code._allowed.clear()  # as in a process of its own
        capsys.readouterr()
        assert main(done.stdout.split("\0")[:-1]) == code, (line, capsys.readouterr())
        said = capsys.readouterr()
        return said.out + said.err

    yield typed
    sys.modules.pop("tiny", None)


def printed(text: str, lead: str) -> str:
    """The command behind ``lead``, which is all that is behind it in its line."""
    (line,) = (line for line in text.splitlines() if lead in line)
    command = line.partition(lead)[2].rstrip(")")
    assert command.startswith("hypogoal "), line
    return command


def test_what_follows_a_stage_with_code_of_ones_own(shell: Shell) -> None:
    """From collecting to the report nothing is typed but what was printed; a path has spaces and a quote in it."""
    line = 'hypogoal collect tiny:DOMAIN --out "it\'s  mine/data.h5"'
    ran = []
    while line:
        if "train-ensemble" in line:
            line += " --diversity tiny:pair_loss --set network=tiny:wide"
        if "train-options" in line:
            line += " --preset few.toml --layout-seed 3 --set environments=3"
        ran.append(line)
        text = shell(line)
        line = printed(text, "next: ") if "next: " in text else ""
    assert "--preset few.toml --set layout_seed=3 --trust" in ran[3] and "environments" not in ran[3]
    stages = ["collect", "train-ensemble", "train-options", "train-meta", "evaluate", "report"]
    assert [shlex.split(line)[1] for line in ran] == stages
    assert all("--trust" in line for line in ran[1:])
    assert Path("runs/data/report/index.html").is_file()


def test_what_an_error_says_to_do(shell: Shell) -> None:
    """Each is typed as it stands, with code of one's own that this process was not told of."""
    shell("hypogoal collect tiny:DOMAIN --out 'a run/data.h5' -q")
    refusal = shell("hypogoal train-ensemble 'a run/data.h5' --out 'a run/ensemble' -q", 2)
    assert "Do you trust it? Give --trust" in refusal
    shell("hypogoal train-ensemble 'a run/data.h5' --out 'a run/ensemble' -q --trust")
    shell(printed(shell("hypogoal report 'a run'", 2), "First run: ") + " --trust")
    shell("hypogoal train-options 'a run/ensemble' --out 'a run/options' -q --trust")
    since = read_evaluation(Path("a run")).facts["missing"]
    shell(printed(since[-1], "options: made since this evaluation (evaluate it again: ") + " --trust")
    assert read_evaluation(Path("a run")).facts["missing"] == []
    Path("not yet").mkdir()
    shell(printed(shell("hypogoal evaluate 'not yet'", 2), "Train something into it first: "))
    for given in ("collect doorkey --out x --set bogus=1", "train-meta e --out o --gae-lambda 3", "show runs --bogus"):
        (line,) = re.findall(r"'(hypogoal [^']+)'", shell(f"hypogoal {given}", 2))
        shell(line)
