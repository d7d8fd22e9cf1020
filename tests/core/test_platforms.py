"""Other systems than Linux, as far as Linux can tell: no fork, no module that only POSIX has."""

from __future__ import annotations

import os
import subprocess
import sys
from functools import partial
from pathlib import Path

from hypogoal.core.workers import in_processes

ROOT = Path(__file__).parents[2]
POSIX_MODULES = {"fcntl", "resource", "pwd", "grp", "termios", "tty", "pty", "syslog", "curses", "readline"}


def _whoami(number: int) -> tuple[int, int, str | None]:
    import multiprocessing

    return number, os.getpid(), multiprocessing.get_start_method(allow_none=True)


def test_workers_are_spawned() -> None:
    """Whatever the system's default is: workers are started anew, and tasks go to them by name."""
    results: dict[int, tuple[int, int, str | None]] = {}
    in_processes([partial(_whoami, number) for number in range(3)], 2, results.__setitem__)
    assert [results[number][0] for number in range(3)] == [0, 1, 2]
    assert os.getpid() not in {row[1] for row in results.values()}
    assert {row[2] for row in results.values()} == {"spawn"}


WITHOUT = """
import sys
for name in {missing!r}:
    sys.modules[name] = None  # importing it raises ImportError
sys.path.insert(0, {tests!r})
from hypogoal.cli import main
sys.exit(main({arguments!r}))
"""


def test_a_system_without_posix_modules_collects(tmp_path: Path) -> None:
    """Where there is no fcntl (Windows) a stage works, checkpoints and renames included."""
    arguments = ["collect", "own_domain:DOMAIN", "--out", str(tmp_path / "data.h5"), "-q"]
    code = WITHOUT.format(missing=sorted(POSIX_MODULES), tests=str(ROOT / "tests"), arguments=arguments)
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, cwd=ROOT)
    assert done.returncode == 0, done.stderr
    assert [path.name for path in tmp_path.iterdir()] == ["data.h5"]
