"""Own code that lies or leaves: each way ends as one line that says whose, where and what to do, with exit code 2."""

from __future__ import annotations

import asyncio
import re
import subprocess
import sys
import warnings
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any, NoReturn

import corridor_env
import gymnasium
import numpy as np
import pytest
import torch
from command_line import run
from corridor_env import SUB_GOALS, CorridorEnv
from own_domain import CorridorDomain, TallCorridor
from torch import Tensor, nn

from hypogoal.cli import main
from hypogoal.core.errors import Complete
from hypogoal.data import open_dataset
from hypogoal.domains.base import Step
from hypogoal.domains.gymnasium_domain import GymnasiumDomain

NAME = f"{__name__}:LIAR"
COLLECT = ["collect", NAME, "--set", "steps=20", "--set", "heldout_seeds=4", "-q"]
BASELINE = ["train-baseline", NAME, "--set", "steps=64", "--set", "max_episode_steps=20", "-q"]
NAN = float("nan")


def lying(**methods: Any) -> type[CorridorEnv]:
    """The corridor with other methods."""
    return type("Liar", (CorridorEnv,), methods)


def giving(place: int, value: Any) -> GymnasiumDomain:
    """A domain whose steps give something else at one place: observation, reward, terminated, truncated, info."""

    def step(self: CorridorEnv, action: int) -> Any:
        given = [*CorridorEnv.step(self, action)]
        given[place] = value(given[place]) if callable(value) else value
        return tuple(given)

    return GymnasiumDomain(lying(step=step), SUB_GOALS)


def labelling(value: Any) -> GymnasiumDomain:
    return GymnasiumDomain(CorridorEnv, {**SUB_GOALS, "lie": lambda env: value})


def labelling_all(value: Any) -> GymnasiumDomain:
    return GymnasiumDomain(CorridorEnv, ("left-end", "lie"), labels=lambda env: value)


def judging(value: Any) -> GymnasiumDomain:
    return GymnasiumDomain(CorridorEnv, SUB_GOALS, success=lambda env, info, earned, terminated: value)


def choosing(value: Any) -> GymnasiumDomain:
    return GymnasiumDomain(CorridorEnv, SUB_GOALS, policy=lambda env, observation, rng: value)


class Spaceless(gymnasium.Env[Any, int]):
    """It says nothing of its observations."""


def short(self: CorridorEnv, action: int) -> Any:
    observation, reward, over, _, info = CorridorEnv.step(self, action)
    return observation, reward, over, info  # old gym's


REWARDS = [None, "1", NAN, float("inf"), -1e400, 1e39, 10**400, 1j, np.complex64(1), np.ones(1), np.ones(2), [1.0]]
ENDS = [None, "False", 2, NAN, np.array([True]), np.array([True, False])]
OBSERVATIONS = [
    None,
    "text",
    [[1], [1, 2]],
    lambda image: image.astype(np.float32),
    lambda image: image[:-1],
    lambda image: image[None],
]
LIES: list[tuple[GymnasiumDomain, str]] = [
    *((giving(1, value), "the environment's step gave the reward ") for value in REWARDS),
    *((giving(2, value), "the environment's step gave terminated ") for value in ENDS),
    *((giving(3, value), "the environment's step gave truncated ") for value in ENDS),
    *((giving(0, value), "the environment ") for value in OBSERVATIONS),
    (giving(4, None), "the environment's step gave (ndarray, float, bool, bool, NoneType)"),
    (GymnasiumDomain(lying(step=short), SUB_GOALS), "the environment's step gave (ndarray, float, bool, dict)"),
    (GymnasiumDomain(lying(step=lambda self, action: None), SUB_GOALS), "step gave no tuple but a NoneType"),
    (
        GymnasiumDomain(lying(reset=lambda self, **_: np.zeros((2, 48, 48), np.uint8)), SUB_GOALS),
        "the environment's reset gave no tuple but a ndarray",
    ),
    (GymnasiumDomain(lying(reset=lambda self, **_: (1, {})), SUB_GOALS), "gave an observation that does not fit"),
    (GymnasiumDomain(lambda: None, SUB_GOALS), "the environment is a NoneType, not a gymnasium.Env"),  # type: ignore[arg-type, return-value]
    (GymnasiumDomain(Spaceless, SUB_GOALS), "the environment has no spaces: AttributeError: "),
    *((labelling(value), "a sub-goal's function gave the label ") for value in [*ENDS, object()]),
    *(
        (labelling_all({"left-end": True, "lie": value}), "the function of all labels gave the label of lie ")
        for value in [*ENDS, object()]
    ),
    (labelling_all({"left-end": True}), "the function of all labels gave labels for left-end: test_own_code.py, line "),
    (labelling_all({"left-end": True, "lie": True, 3: 1}), "gave labels for left-end, lie, 3: test_own_code.py"),
    *((labelling_all(value), "the function of all labels gave a ") for value in (None, [True, True])),
    *(
        (choosing(value), "the domain's policy gave the action ")
        for value in [77, -1, 1.5, None, "1", True, np.array([0, 1]), NAN]
    ),
]


class Own(BaseException):
    """No Exception."""


class Mute(Exception):
    """It cannot be told."""

    def __str__(self) -> str:
        raise ValueError


def raising(error: BaseException | type[BaseException]) -> Callable[..., NoReturn]:
    def leave(*arguments: object, **named: object) -> NoReturn:
        raise error

    return leave


def endless(*arguments: object, **named: object) -> Any:
    return endless()


def warned(*arguments: object, **named: object) -> None:
    warnings.warn("an error here", stacklevel=1)


LEAVING: list[tuple[str, Callable[..., Any]]] = [
    ("SystemExit(0), to end the program", lambda *_, **__: sys.exit(0)),
    ("SystemExit(1)", lambda *_, **__: sys.exit(1)),
    ("SystemExit('text')", lambda *_, **__: sys.exit("text")),
    ("SystemExit()", lambda *_, **__: sys.exit()),
    ("Own: why", raising(Own("why"))),
    ("GeneratorExit", raising(GeneratorExit)),
    ("StopIteration", raising(StopIteration)),
    ("CancelledError", raising(asyncio.CancelledError)),
    ("Complete: there is complete already", raising(Complete("there"))),
    ("Mute: a Mute", raising(Mute())),
    ("ValueError: a a a b b", raising(ValueError("a\n" * 3 + "b\n" * 5000))),
    ("RecursionError", endless),
    ("UserWarning: an error here", warned),
]
PLACES: dict[str, tuple[str, Callable[[Callable[..., Any]], GymnasiumDomain]]] = {
    "make": ("the environment cannot be made: ", lambda leave: GymnasiumDomain(leave, SUB_GOALS)),
    "reset": ("the environment's reset raised ", lambda leave: GymnasiumDomain(lying(reset=leave), SUB_GOALS)),
    "step": ("the environment's step raised ", lambda leave: GymnasiumDomain(lying(step=leave), SUB_GOALS)),
    "label": ("a sub-goal's function raised ", lambda leave: GymnasiumDomain(CorridorEnv, {"lie": leave})),
    "policy": ("the domain's policy raised ", lambda leave: GymnasiumDomain(CorridorEnv, SUB_GOALS, policy=leave)),
}


@pytest.fixture(autouse=True)
def trusted(monkeypatch: pytest.MonkeyPatch) -> None:
    """What the data file names."""
    monkeypatch.setenv("HYPOGOAL_TRUST", "corridor_env:DOMAIN")


@pytest.fixture
def told(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> Callable[..., str]:
    """What a command says in which own code lies or leaves: exit code 2, one line, and nothing is left at --out."""

    def run(own: object, arguments: list[str], code: int = 2) -> str:
        monkeypatch.setattr(sys.modules[__name__], "LIAR", own, raising=False)
        out = tmp_path / "out.h5"
        assert main([*arguments, "--out", str(out)]) == code
        line = capsys.readouterr().err
        assert line.count("\n") == 1 and line.startswith("hypogoal: ") and not out.exists()
        return line

    return run


@pytest.fixture(scope="module")
def data(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """States of the corridor."""
    path = tmp_path_factory.mktemp("data") / "data.h5"
    few = ["--set", "steps=80", "--set", "heldout_seeds=4,5", "-q"]
    run("collect", "corridor_env:DOMAIN", *few, "--out", path)
    return path


@pytest.mark.parametrize(("domain", "message"), LIES)
def test_what_an_environment_gives_is_looked_at(
    domain: GymnasiumDomain, message: str, told: Callable[..., str], capsys: pytest.CaptureFixture[str]
) -> None:
    """Spec G2: whose code, its file and line; 'check' names the same."""
    line = told(domain, COLLECT)
    assert message in line and re.search(r"(test_own_code|corridor_env)\.py, line \d", line)
    assert main(["check", *COLLECT[1:-1]]) == 2
    checked = capsys.readouterr()
    assert "FAIL" in checked.out.splitlines()[-1] if checked.out else message in checked.err


@pytest.mark.parametrize("value", [None, 0.5, "True", np.array([True]), NAN])
def test_what_is_called_a_success_is_looked_at(value: Any, told: Callable[..., str]) -> None:
    """Spec G2: where episodes end, so in training; whose code, its file and line."""
    assert re.search(
        r"the domain's success gave success .*: test_own_code\.py, line \d", told(judging(value), BASELINE)
    )


@pytest.mark.parametrize(("text", "leave"), LEAVING)
def test_whatever_is_raised_is_one_line(text: str, leave: Callable[..., Any], told: Callable[..., str]) -> None:
    """Spec G2: nobody takes a program that ended for one that succeeded."""
    for place in PLACES:
        message, domain = PLACES[place]
        line = told(domain(leave), COLLECT)
        assert f"{message}{text}" in line and "test_own_code.py, line " in line and len(line) < 600


@pytest.mark.parametrize("own", [giving(1, NAN), giving(1, None), giving(2, np.ones(2)), *(
    PLACES["step"][1](leave) for _, leave in LEAVING[:6]
)])  # fmt: skip
def test_baselines_stop_at_it(own: GymnasiumDomain, told: Callable[..., str]) -> None:
    """Spec E7, G2: at a reward that is NaN not with the tensor that PPO made of it."""
    assert "the environment's step " in told(own, BASELINE)


def test_ctrl_c_is_nobodys_fault(told: Callable[..., str]) -> None:
    """Spec G2: it ends as ever, wherever it comes."""
    assert "stopped" in told(PLACES["step"][1](raising(KeyboardInterrupt)), COLLECT, 130)


HONEST = [
    giving(1, np.float32),
    giving(1, np.array),
    giving(1, torch.tensor),
    giving(1, bool),
    giving(1, int),
    giving(2, np.bool_),
    giving(2, np.array),
    giving(2, torch.tensor),
    giving(2, int),
    giving(3, np.float64),
    GymnasiumDomain(CorridorEnv, {name: lambda env, label=label: int(label(env)) for name, label in SUB_GOALS.items()}),  # type: ignore[misc]
]


def test_numbers_of_any_library_are_numbers(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Spec B6: the same states, rewards and ends as of Python's own."""
    plain, actions = corridor_env.DOMAIN, np.random.default_rng(0).integers(2, size=(40, 2))
    engine = plain.make_engine(0, 2, 9)
    steps = [engine.step(row) for row in actions]
    for own in HONEST:
        engine = own.make_engine(0, 2, 9)
        for step, row in zip(steps, actions, strict=True):
            for one, other in zip(step[:4], engine.step(row)[:4], strict=True):
                assert one.dtype == other.dtype
                np.testing.assert_array_equal(one, other)
    kinds = (int, np.int8, np.array, torch.tensor, lambda action: np.array([action]))
    written = []
    for number, kind in enumerate(kinds):
        policy = lambda env, observation, rng, kind=kind: kind(rng.integers(2))  # noqa: E731
        monkeypatch.setattr(
            sys.modules[__name__], "LIAR", GymnasiumDomain(CorridorEnv, SUB_GOALS, policy=policy), raising=False
        )
        out = tmp_path / f"{number}.h5"
        run("collect", NAME, "--set", "steps=200", "--set", "heldout_seeds=4,5", "-q", "--out", out)
        written.append(open_dataset(out).unlabelled())
    for other in written[1:]:
        np.testing.assert_array_equal(written[0], other)


def test_a_module_that_leaves_while_it_is_loaded(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, told: Callable[..., str]
) -> None:
    """Spec G2."""
    monkeypatch.syspath_prepend(tmp_path)
    (tmp_path / "leaving_module.py").write_text("import sys\nsys.exit(0)")
    line = told(None, ["collect", "leaving_module:DOMAIN", "-q"])
    place = "leaving_module:DOMAIN (leaving_module.py, line 2)"
    assert f"the domain cannot be loaded: SystemExit(0), to end the program: {place}" in line


class Engine(TallCorridor):
    """An engine of someone's own whose steps are changed."""

    change: Any = None

    def step(self, actions: np.ndarray) -> Step:
        return self.change(super().step(actions))  # type: ignore[no-any-return]


def own_engine(change: Callable[[Step], Any]) -> CorridorDomain:
    class Domain(CorridorDomain):
        def make_engine(self, layout_seed: int, count: int, max_steps: int, **arguments: Any) -> Any:
            engine = Engine(count, max_steps)
            engine.change = change
            return engine

    return Domain()


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda step: step._replace(rewards=step.rewards * NAN), "the engine's step gave the reward nan"),
        (lambda step: step._replace(rewards=None), "the engine's step gave rewards None"),
        (lambda step: step._replace(terminated=step.rewards), "the engine's step gave terminated"),
        (lambda step: step._replace(truncated=step.truncated[:1]), "the engine's step gave truncated"),
        (lambda step: step._replace(succeeded=step.rewards), "the engine's step gave succeeded"),
        (lambda step: None, "the engine's step gave a NoneType, not a Step"),
        (lambda step: tuple(step), "the engine's step gave a tuple, not a Step"),
        (lambda step: sys.exit(0), "user code in test_own_code raised SystemExit(0)"),
        (lambda step: 1 // 0, "user code in test_own_code raised ZeroDivisionError"),
    ],
)
def test_engines_without_gymnasium_too(change: Callable[[Step], Any], message: str, told: Callable[..., str]) -> None:
    """Spec B6, G2: what no environment's block is around is own code by where it was raised."""
    line = told(own_engine(change), BASELINE)
    assert message in line and "test_own_code.py, line " in line


@pytest.mark.parametrize("labels", [np.full((48, 2), NAN), np.full((48, 2), "False"), np.ones((48, 1), bool), None])
def test_labels_of_a_domain_that_collects_itself(labels: Any, told: Callable[..., str]) -> None:
    """Spec B6, G2: NumPy makes True of NaN and of the text 'False'."""

    class Domain(CorridorDomain):
        def collect(self, config: Any, seed: int, progress: Any) -> Any:
            found = super().collect(config, seed, progress)
            return replace(found, labelled=replace(found.labelled, labels=labels))

    assert "the domain's labelled labels are not truth values" in told(Domain(), ["collect", NAME, "-q"])


OBJECTIVES: list[tuple[Callable[[Tensor, Tensor], Any], str]] = [
    (lambda a, b: None, "gave NoneType"),
    (lambda a, b: 0.5, "gave float"),
    (lambda a, b: (a - b).sum(-1), "gave torch.float32"),
    (lambda a, b: (a > b).sum(), "gave torch.int64 ()"),
    (lambda a, b: sys.exit(0), "raised SystemExit(0)"),
]


@pytest.mark.parametrize(("objective", "message"), OBJECTIVES)
def test_objectives(
    objective: Any, message: str, told: Callable[..., str], data: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Spec C1, G2."""
    few = ["--set", "steps=5", "--set", "workers=1", "-q"]
    line = told(objective, ["train-ensemble", str(data), "--diversity", NAME, *few])
    assert f"the diversity objective {NAME} {message}" in line and "test_own_code.py, line " in line
    assert main(["check", "--diversity", NAME]) == 2
    assert f"FAIL shape: the diversity objective {NAME}" in capsys.readouterr().out


class Leaves(nn.Module):
    """A layer that ends the program when it is used."""

    def __init__(self, leave: Callable[[], Any]):
        super().__init__()
        self.leave = leave

    def forward(self, images: Tensor) -> Any:
        return self.leave()


def convolution(channels: int) -> nn.Module:
    return nn.Conv2d(channels, 4, 3, 2)


NETWORKS: list[tuple[Callable[[int], Any], str]] = [
    (lambda channels: None, "raised TypeError"),
    (lambda channels: ([convolution(channels)], ()), "gave layers"),
    (lambda channels: ([convolution(channels)], (0,)), "gave layers"),
    (lambda channels: ([convolution(channels)], (2.5,)), "gave layers"),
    (lambda channels: (["layer"], (8,)), "gave layers"),
    (lambda channels: sys.exit(0), "raised SystemExit(0)"),
    (lambda channels: ([Leaves(lambda: sys.exit(0))], (8,)), "user code in test_own_code raised SystemExit(0)"),
    (lambda channels: ([Leaves(lambda: 7)], (8,)), "makes 7 of images, not a tensor"),
    (lambda channels: ([convolution(channels).double()], (8,)), "does not take these observations"),
]


@pytest.mark.parametrize(("network", "message"), NETWORKS)
def test_networks(
    network: Any, message: str, told: Callable[..., str], data: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Spec C5, G2."""
    few = ["--set", f"network={NAME}", "--set", "steps=5", "--set", "workers=1", "-q"]
    assert message in told(network, ["train-ensemble", str(data), *few])
    assert main(["check", "--network", NAME]) == 2
    assert "FAIL builds: " in capsys.readouterr().out


def test_in_a_process_of_its_own(data: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Spec G2: by the command as users start it, with members in processes; own code may fork and end its child."""
    (tmp_path / "theirs.py").write_text(
        "import os, sys\n"
        "from corridor_env import SUB_GOALS, CorridorEnv\n"
        "from hypogoal import GymnasiumDomain\n"
        "class Liar(CorridorEnv):\n"
        "    def step(self, action):\n"
        "        if (child := os.fork()) == 0:\n"
        "            os._exit(7)\n"
        "        sys.exit(os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]) - 7)\n"
        "DOMAIN = GymnasiumDomain(Liar, SUB_GOALS)\n"
        "def pair_loss(a, b):\n"
        "    sys.exit(0)\n"
    )
    monkeypatch.setenv("PYTHONPATH", str(Path(__file__).parent))
    out = tmp_path / "out.h5"
    few = ["--set", "steps=5", "--set", "workers=2"]
    for arguments, line in (
        (
            ["collect", "theirs:DOMAIN"],
            "the environment's step raised SystemExit(0), to end the program: theirs.py, line 8",
        ),
        (
            ["train-ensemble", str(data), "--diversity", "theirs:pair_loss", *few],
            "raised SystemExit(0), to end the program: theirs.py, line 11",
        ),
    ):
        command = [sys.executable, "-m", "hypogoal", *arguments, "--out", str(out), "-q"]
        ended = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True)
        assert ended.returncode == 2 and line in ended.stderr and ended.stderr.count("\n") == 1 and not out.exists()
