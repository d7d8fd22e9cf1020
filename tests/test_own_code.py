"""User code: what it gives is looked at once, and whatever it raises is one line with its file and line."""

import errno
import os
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from command_line import fails, refuses, settings
from corridor_env import SHAPE, SUB_GOALS, CorridorEnv
from torch import Tensor, nn

from hypogoal.core import own_code
from hypogoal.core.checkpoints import PACE
from hypogoal.core.errors import NumericalError, UserError
from hypogoal.domains.gymnasium.domain import GymnasiumDomain

NAME = f"{__name__}:OWN"
COLLECT = ["collect", NAME, *settings("steps=20", "heldout_seeds=4"), "-q"]
BASELINE = ["train-baseline", NAME, *settings("steps=64", "max_episode_steps=20"), "-q"]
NAN = float("nan")


def with_methods(**methods: Any) -> GymnasiumDomain:
    """The corridor with other methods."""
    return GymnasiumDomain(type("Own", (CorridorEnv,), methods), SUB_GOALS)


def giving(change: Callable[[Any], Any]) -> GymnasiumDomain:
    """A domain whose steps give other observations."""

    def step(self: CorridorEnv, action: int) -> Any:
        observation, *rest = CorridorEnv.step(self, action)
        return change(observation), *rest

    return with_methods(step=step)


def labelling(value: Any) -> GymnasiumDomain:
    return GymnasiumDomain(CorridorEnv, {**SUB_GOALS, "odd": lambda env: value})


FITS_NOT = "an observation that does not fit its space"
MALFORMED: list[tuple[Any, str]] = [
    (giving(lambda image: image.reshape(SHAPE[0] // 2, SHAPE[1] * 2, 3)), FITS_NOT),  # as many bytes
    (with_methods(reset=lambda self, **_: (np.zeros(SHAPE, np.int32), {})), FITS_NOT),
    *((labelling(value), "the label of odd is no truth value") for value in ("no", NAN)),
]


@pytest.fixture(autouse=True)
def trusted(monkeypatch: pytest.MonkeyPatch) -> None:
    """What the data file names; no checkpoint, however slow the machine."""
    monkeypatch.setenv("HYPOGOAL_TRUST", "1")
    monkeypatch.setenv(PACE, "1e9")


@pytest.fixture
def told(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Callable[..., str]:
    """The one line with which a command ends that has this code; nothing is left at --out."""

    def ended(own: object, words: list[str], wanted: str) -> str:
        monkeypatch.setattr(sys.modules[__name__], "OWN", own, raising=False)
        return refuses(wanted, *words, "--out", tmp_path / "out")

    return ended


@pytest.fixture
def data(corridor_run: Path) -> Path:
    return corridor_run / "data.h5"


@pytest.mark.parametrize(("domain", "fault"), MALFORMED)
def test_the_first_step_is_looked_at(domain: GymnasiumDomain, fault: str, told: Callable[..., str]) -> None:
    """Spec G2: by 'collect' and in engines; 'check' finds it too."""
    told(domain, COLLECT, fault)
    told(domain, BASELINE, fault)
    checked = fails("check", *COLLECT[1:-1])
    assert "FAIL" in checked.out or fault in checked.err


def raising(error: BaseException) -> Callable[..., Any]:
    def leave(*arguments: object, **named: object) -> Any:
        raise error

    return leave


LINE = raising.__code__.co_firstlineno + 2
PLACES: dict[str, tuple[Callable[..., GymnasiumDomain], list[str]]] = {
    "make": (lambda leave: GymnasiumDomain(leave, SUB_GOALS), COLLECT),
    "reset": (lambda leave: with_methods(reset=leave), COLLECT),
    "label": (lambda leave: GymnasiumDomain(CorridorEnv, {"odd": leave}), COLLECT),
    "policy": (lambda leave: GymnasiumDomain(CorridorEnv, SUB_GOALS, policy=leave), COLLECT),
    "success": (lambda leave: GymnasiumDomain(CorridorEnv, SUB_GOALS, success=leave), BASELINE),
    "step": (lambda leave: with_methods(step=leave), BASELINE),
}
ERRORS = [ValueError("why\nand where"), SystemExit(0), OSError(errno.ENOENT, "no", "x")]


@pytest.mark.parametrize(("place", "error"), [*zip(PLACES, ERRORS * 2, strict=True)])
def test_what_is_raised_has_a_place(place: str, error: BaseException, told: Callable[..., str]) -> None:
    """Spec G2: nobody takes a program that ended for one that succeeded."""
    domain, words = PLACES[place]
    line = told(domain(raising(error)), words, f"your code raised {type(error).__name__}: ")
    assert f": test_own_code.py, line {LINE}. --debug shows" in line and "and where" not in line


def test_objectives(told: Callable[..., str], data: Path) -> None:
    """Spec C1, G2."""
    fault = "your code raised ZeroDivisionError"
    words = ["train-ensemble", str(data), "--diversity", NAME, *settings("steps=5", "workers=1"), "-q"]
    told(lambda a, b: 1 // 0, words, fault)
    assert f"FAIL finite: {fault}" in fails("check", "--diversity", NAME).out


class Raises(nn.Module):
    """A layer that cannot be used."""

    def forward(self, images: Tensor) -> Any:
        return 1 // 0


@pytest.mark.parametrize(
    ("layers", "fault"),
    [
        (lambda channels: ([nn.Conv2d(channels, 4, 3, 2).double()], (8,)), "does not take these observations"),
        (lambda channels: ([Raises()], (8,)), "your code raised ZeroDivisionError"),
    ],
)
def test_networks(layers: Any, fault: str, told: Callable[..., str], data: Path) -> None:
    """Spec C5, G2."""
    told(layers, ["train-ensemble", str(data), *settings(f"network={NAME}", "steps=5", "workers=1"), "-q"], fault)
    assert "FAIL logits: " in fails("check", "--network", NAME).out


def test_in_processes_of_a_stage(
    told: Callable[..., str], data: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capfd: Any
) -> None:
    """Spec G2: with members in other processes; a module that ends the program is one line too."""
    monkeypatch.syspath_prepend(str(tmp_path))
    (tmp_path / "theirs.py").write_text("def pair_loss(a, b):\n    return a.nothing\n")
    (tmp_path / "leaves.py").write_text("import sys\nsys.exit(0)\n")
    words = ["train-ensemble", str(data), *settings("steps=5", "workers=2"), "-q", "--diversity"]
    told(None, [*words, "theirs:pair_loss"], "has no attribute 'nothing': theirs.py, line 2")
    fault = "the diversity objective cannot be loaded: SystemExit: 0: leaves:x leaves.py, line 2"
    told(None, [*words, "leaves:x"], fault)
    # Python's own tracker may say on a busy machine that it frees what an ended process held.
    others = capfd.readouterr().err.splitlines()
    assert not [line for line in others if "resource_tracker" not in line and "warnings.warn" not in line]


def failing(name: str) -> OSError:
    return OSError(getattr(errno, name), os.strerror(getattr(errno, name)), "here")


@pytest.mark.parametrize(
    ("error", "words", "code"),
    [
        (UserError("what", "where", "Do."), "what: where. Do.", 2),
        (NumericalError("the loss is nan"), "training stopped: the loss is nan", 1),
        (MemoryError(), "there is not enough memory", 2),
        (RuntimeError("DefaultCPUAllocator: can't allocate memory: 8 bytes"), "there is not enough memory", 2),
        (RuntimeError("CUDA out of memory. Tried to allocate 2.00 GiB"), "there is not enough memory", 2),
        (failing("ENOSPC"), "No space left on device: here. Free some disk space", 2),
        (failing("EACCES"), "Permission denied: here. Ask for permission", 2),
        (ModuleNotFoundError(name="minari"), "the package minari is needed. Install it: pip install minari", 2),
        (KeyError("x"), "internal error: KeyError: 'x'. Run again with --debug", 1),
    ],
)
def test_each_error_has_its_line(error: BaseException, words: str, code: int) -> None:
    """Spec G2: the remedy fits the fault."""
    line, ends_with = own_code.message(error)
    assert line.startswith(words) and ends_with == code
