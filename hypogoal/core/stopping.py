"""Signals that end the process raise ``KeyboardInterrupt`` wherever Python happens to be (Spec G1)."""

import _thread
import math
import os
import signal
import sys
import time
from types import FrameType
from typing import Any

SIGNALS = (signal.SIGINT, signal.SIGTERM)  # Ctrl-C, and a cancelled job
TOGETHER = 0.5  # seconds within which signals count as one: a second one would interrupt the clean-up

_raised_at = -math.inf


def stop(signum: int, _frame: FrameType | None) -> None:
    """The signals' handler; the ``KeyboardInterrupt`` has the signal's number as its argument."""
    global _raised_at
    now = time.monotonic()
    if now - _raised_at > TOGETHER:
        _raised_at = now
        raise KeyboardInterrupt(signum)


def unraised(unraisable: Any) -> None:
    """For ``sys.unraisablehook``: repeat a signal that came while an object was torn down.

    Python would drop it and print a traceback.
    """
    if isinstance(unraisable.exc_value, KeyboardInterrupt):
        _thread.start_new_thread(_again, unraisable.exc_value.args or (signal.SIGINT,))
    else:
        sys.__unraisablehook__(unraisable)


def _again(signum: int) -> None:
    global _raised_at
    time.sleep(0.01)
    _raised_at = -math.inf
    os.kill(os.getpid(), signum)
