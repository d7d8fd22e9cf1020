"""Other systems than Linux, as far as Linux can tell: no fork, no module that only POSIX has."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).parents[2]
POSIX_MODULES = {"fcntl", "resource", "pwd", "grp", "termios", "tty", "pty", "syslog", "curses", "readline"}


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
