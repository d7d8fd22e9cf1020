"""Other systems than Linux, as far as Linux can tell: no fork, nothing POSIX-only without a guard."""

from __future__ import annotations

import ast
import os
import subprocess
import sys
from functools import partial
from pathlib import Path

import pytest

from hypogoal.core.workers import in_processes

ROOT = Path(__file__).parents[2]
POSIX_MODULES = {"fcntl", "resource", "pwd", "grp", "termios", "tty", "pty", "syslog", "curses", "readline"}
POSIX_CALLS = {"fork", "forkpty", "getuid", "geteuid", "killpg", "setsid", "statvfs", "sysconf", "getloadavg"}
POSIX_CALLS |= {"sched_getaffinity", "SIGKILL", "SIGHUP", "SIGUSR1", "SIGALRM", "nice", "mkfifo"}


def posix_only(source: str) -> list[str]:
    """What in a module only POSIX has, but for imports within ``try`` and what ``os.name`` or ``platform`` guards."""
    found: list[str] = []

    def look(node: ast.AST, guarded: bool) -> None:
        if isinstance(node, ast.If | ast.IfExp):
            guarded |= any(word in ast.unparse(node.test) for word in ("os.name", "sys.platform", "hasattr"))
        if isinstance(node, ast.Try):
            guarded |= any("ImportError" in ast.unparse(handler.type) for handler in node.handlers if handler.type)
        if not guarded:
            if isinstance(node, ast.Import):
                found.extend(name.name for name in node.names if name.name in POSIX_MODULES)
            elif isinstance(node, ast.Attribute) and node.attr in POSIX_CALLS:
                found.append(node.attr)
            elif isinstance(node, ast.keyword) and node.arg == "preexec_fn" and isinstance(node.value, ast.Name):
                found.append("preexec_fn")
            elif isinstance(node, ast.Constant) and node.value in ("fork", "forkserver"):
                found.append(str(node.value))
        for child in ast.iter_child_nodes(node):
            look(child, guarded)

    look(ast.parse(source), False)
    return found


@pytest.mark.parametrize(
    ("source", "expected"),
    [
        ("import fcntl", ["fcntl"]),
        ("try:\n import fcntl\nexcept ImportError:\n fcntl = None", []),
        ("import os\nos.fork()", ["fork"]),
        ("import os\nif os.name == 'posix':\n os.getuid()", []),
        ("Popen(x, preexec_fn=f)", ["preexec_fn"]),
        ("Popen(x, preexec_fn=f if os.name == 'posix' else None)", []),
        ("multiprocessing.get_context('fork')", ["fork"]),
    ],
)
def test_the_search_finds_what_only_posix_has(source: str, expected: list[str]) -> None:
    """The check below can fail."""
    assert posix_only(source) == expected


def test_the_package_has_nothing_posix_only_without_a_guard() -> None:
    """Windows and macOS: no fork, no POSIX module or call that is not guarded."""
    sources = sorted((ROOT / "hypogoal").rglob("*.py"))
    found = {str(path.relative_to(ROOT)): posix_only(path.read_text(encoding="utf-8")) for path in sources}
    assert not {path: names for path, names in found.items() if names}


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
