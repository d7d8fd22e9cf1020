"""Commands of hypogoal in this process: those that succeed, and those that are refused."""

import io
from collections.abc import Iterator
from contextlib import contextmanager, redirect_stderr, redirect_stdout
from pathlib import Path
from typing import NamedTuple

import pytest

from hypogoal.cli import main
from hypogoal.core import own_code

# Settings with which nothing is chosen, so that training costs a fourth.
FIXED = ("diversity_weight=1e-4", "restarts=1")


class Printed(NamedTuple):
    """What a command printed."""

    out: str
    err: str

    @property
    def path(self) -> Path:
        """The last line of standard output, which is where the result is."""
        return Path(self.out.splitlines()[-1])


def settings(*pairs: str) -> list[str]:
    """``--set`` before each ``key=value``."""
    words = []
    for pair in pairs:
        words += ["--set", pair]
    return words


def run(*words: object) -> Printed:
    """What a command prints that must succeed."""
    code, printed = called(words)
    assert code == 0, (words, printed.err)
    return printed


def fails(*words: object) -> Printed:
    """What a command prints that must end with exit code 2, since something of the user's is wrong."""
    code, printed = called(words)
    assert code == 2, (words, code, printed)
    return printed


def refuses(wanted: str, *words: object) -> str:
    """The one line in which a command refuses: exit code 2, ``wanted`` in it, and nothing else printed or written."""
    out = _output_of(words)
    before = _names_beside(out)
    code, printed = called(words)
    lines = printed.err.strip().splitlines()
    assert (code, len(lines), printed.out) == (2, 1, ""), (words, code, printed)
    assert lines[0].startswith("hypogoal: ") and lines[0].isprintable(), lines
    assert wanted in lines[0], lines
    assert _names_beside(out) == before, words
    return lines[0]


@contextmanager
def trusting() -> Iterator[None]:
    """Within it the user allows the code that files name; behind it nothing was typed that does."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv(own_code.VARIABLE, "1")
        yield
    own_code._allowed.clear()


def called(words: tuple[object, ...]) -> tuple[int, Printed]:
    """The exit code and what was printed, as in a process of its own: nothing was typed before."""
    own_code._allowed.clear()
    out, err = io.StringIO(), io.StringIO()
    with redirect_stdout(out), redirect_stderr(err):
        code = main([str(word) for word in words])
    return code, Printed(out.getvalue(), err.getvalue())


def _output_of(words: tuple[object, ...]) -> Path | None:
    if "--out" not in words:
        return None
    return Path(str(words[words.index("--out") + 1]))


def _names_beside(out: Path | None) -> list[Path]:
    """Everything in the folder that an output is in, drafts too, but for what Python keeps of modules."""
    if out is None:
        return []
    return sorted(path for path in out.parent.rglob("*") if "__pycache__" not in path.parts)
