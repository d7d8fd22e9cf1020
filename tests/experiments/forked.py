"""Cells as processes forked from this one: each is one of its own, but need not load torch and its compiler again."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import warnings
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from types import SimpleNamespace
from typing import BinaryIO

import pytest

from hypogoal.cli import main
from hypogoal.experiments.runners import local


class Forked:
    """What ``subprocess.Popen`` is to a runner, of a command of ours."""

    def __init__(
        self,
        command: Sequence[str],
        *,
        stdout: BinaryIO,
        stderr: int,
        stdin: int,
        env: Mapping[str, str],
        preexec_fn: Callable[[], None],
    ):
        assert (stderr, stdin) == (subprocess.STDOUT, subprocess.DEVNULL)
        self.returncode: int | None = None
        sys.stdout.flush()
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", DeprecationWarning)  # of threads, which a test's process may have
            self.pid = os.fork()
        if not self.pid:
            code = 70
            try:
                os.dup2(os.open(os.devnull, os.O_RDONLY), 0)
                os.dup2(stdout.fileno(), 1)
                os.dup2(1, 2)
                sys.stdout, sys.stderr = (os.fdopen(number, "w", closefd=False) for number in (1, 2))
                os.environ.clear()
                os.environ.update(env)
                preexec_fn()
                sys.argv = list(command[command.index("hypogoal") :])
                code = main()
            finally:
                sys.stdout.flush()
                sys.stderr.flush()
                os._exit(code)

    def poll(self) -> int | None:
        """The exit code, minus the signal that ended it; None while it runs."""
        return self._ask(os.WNOHANG)

    def wait(self) -> int:
        """The exit code, when it has ended."""
        code = self._ask(0)
        assert code is not None
        return code

    def terminate(self) -> None:
        """Have it save and end."""
        if self.poll() is None:
            os.kill(self.pid, signal.SIGTERM)

    def _ask(self, how: int) -> int | None:
        if self.returncode is None:
            found, status = os.waitpid(self.pid, how)
            self.returncode = os.waitstatus_to_exitcode(status) if found else None
        return self.returncode


@contextmanager
def forked() -> Iterator[None]:
    """Within it, runners fork the cells that they start."""
    import torch._dynamo  # noqa: F401 - which the first optimiser of a process loads, for two seconds

    import hypogoal.stages.evaluate
    import hypogoal.stages.train_ensemble  # noqa: F401

    with pytest.MonkeyPatch.context() as patch:
        own = SimpleNamespace(Popen=Forked, STDOUT=subprocess.STDOUT, DEVNULL=subprocess.DEVNULL)
        patch.setattr(local, "subprocess", own)
        yield
