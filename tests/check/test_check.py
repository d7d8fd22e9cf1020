"""``hypogoal check``: what keeps its contract passes, and each broken law is named (Spec B6, C1, C2, C5)."""

import itertools
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import pytest
import torch
from command_line import fails, refuses, run, settings
from corridor import Corridor
from corridor_env import NEVER, SUB_GOALS, CorridorEnv, Sensed
from gymnasium import spaces
from gymnasium.wrappers import FlattenObservation, NormalizeObservation
from own_domain import CorridorConfig, CorridorDomain, TallCorridor
from torch import Tensor, nn

from hypogoal.check import Verdict, check_domain, check_network, check_objective, require
from hypogoal.data import Collected
from hypogoal.diversity import OBJECTIVES as OURS
from hypogoal.diversity import Context, Objective, dbat, load_objective, none
from hypogoal.domains.base import Step
from hypogoal.domains.gymnasium.domain import GymnasiumConfig, GymnasiumDomain
from hypogoal.hypotheses.networks import NETWORKS
from hypogoal.observations import mixed_type

TESTS = Path(__file__).parents[1]
SMALL = GymnasiumConfig(steps=150, heldout_seeds=(4, 5))
NOBODYS, COUNT = np.random.default_rng(5), itertools.count()


def having(**parts: Any) -> CorridorDomain:
    """The corridor with other attributes and methods."""
    domain = CorridorDomain()
    vars(domain).update(parts)
    return domain


def domain_of(**engine_parts: Any) -> CorridorDomain:
    """The corridor with an engine whose methods and attributes are replaced."""
    engine: Any = type("Broken", (TallCorridor,), engine_parts)
    return having(make_engine=lambda layout_seed, count, max_steps: engine(count, max_steps))


def stepping(**changes: Any) -> CorridorDomain:
    """The corridor with changed parts of its steps."""

    def step(self: Any, actions: np.ndarray) -> Step:
        found = Corridor.step(self, actions)
        return found._replace(**{name: change(getattr(found, name)) for name, change in changes.items()})

    return domain_of(step=step)


def collecting(part: str, **changes: Any) -> CorridorDomain:
    """The corridor with a part of its collected states changed."""

    def collect(config: CorridorConfig, seed: int, progress: Any) -> Collected:
        found = CorridorDomain().collect(config, seed, progress)
        states = getattr(found, part)
        new = {name: change(getattr(states, name)) for name, change in changes.items()}
        return replace(found, **{part: replace(states, **new)})

    return having(collect=collect)


def first_fault(verdicts: Any) -> Verdict:
    return next(verdict for verdict in verdicts if not verdict.ok)


def never_ending(self: Any, actions: np.ndarray) -> Step:
    self.max_steps = 10_000
    return Corridor.step(self, actions)


def forgetful(self: Any, snapshot: dict[str, Any]) -> None:
    Corridor.restore(self, snapshot | {"ids": np.full_like(snapshot["ids"], 4)})


def wandering(self: Any, actions: np.ndarray) -> Step:
    return Corridor.step(self, NOBODYS.integers(2, size=len(actions)))


def moody(self: Any, ids: np.ndarray) -> np.ndarray:
    return Corridor.labels(self, ids) | [False, next(COUNT) % 2 == 0]


class Dark(CorridorDomain):
    """Its observations are numbers that nobody measured."""

    observation_dtype = np.dtype(np.float32)

    def make_engine(self, layout_seed: int, count: int, max_steps: int, **arguments: Any) -> Any:
        images = np.full((count, *self.observation_shape), np.nan, np.float32)
        engine = type("Dark", (TallCorridor,), {"images": lambda self, ids: images})
        return engine(count, max_steps)


BROKEN = [
    (having(sub_goals=("a/b", "c")), "collect", "a/b"),
    (having(sub_goals=("End", "end")), "collect", "End, end"),
    (domain_of(images=lambda self, ids: np.zeros((3, 64, 64, 3), np.float32)), "steps", "float32"),
    (domain_of(images=lambda self, ids: 1 // 0), "steps", "ZeroDivisionError"),
    (Dark(), "steps", "images have numbers that are not finite"),
    (stepping(rewards=lambda values: values[:2]), "steps", "the engine's step gave rewards"),
    (stepping(rewards=lambda values: values * np.nan), "steps", "finite"),
    (domain_of(step=never_ending), "steps", "went on after max_steps"),
    (domain_of(labels=lambda self, ids: Corridor.labels(self, ids)[:, :1]), "steps", "(3, 1)"),
    (domain_of(labels=moody), "two engines", "labels differ in step"),
    (domain_of(step=wandering), "two engines", "differ in step"),
    (domain_of(restore=forgetful), "restore", "differ in step"),
    (collecting("labelled", labels=lambda labels: labels.astype(int)), "collect", "are not truth values"),
    (collecting("labelled", labels=np.zeros_like), "collect", "left-end has no positives"),
    (
        collecting("heldout", observations=lambda some: some[:0], labels=lambda some: some[:0]),
        "collect",
        "heldout: uint8 (0, 64, 64, 3)",
    ),
    (collecting("unlabelled", observations=NOBODYS.permutation), "collect", "states differ when collected again"),
]


@pytest.mark.parametrize(("domain", "law", "fault"), BROKEN)
def test_each_broken_law_of_a_domain_is_named(domain: CorridorDomain, law: str, fault: str) -> None:
    """Spec B6: which law, and what was found."""
    found = first_fault(check_domain(domain))
    assert found.name == law and fault in found.text
    with pytest.raises(AssertionError, match=f"FAIL {law}"):
        require(check_domain(domain))


class Low(CorridorEnv):
    """Its pictures are fewer pixels high than options' convolutions need."""

    observation_space = spaces.Box(0, 255, (12, 48, 3), np.uint8)

    def image(self) -> np.ndarray:
        return super().image()[:12]


def test_what_may_surprise_is_a_warning() -> None:
    """Spec B6: labels that pictures do not show, no resuming, states that play did not reach, pictures for members."""

    def hidden(self: Any, ids: np.ndarray) -> np.ndarray:
        return np.stack([ids == 0, np.full(len(ids), self.elapsed[0] % 2 == 0)], axis=1)

    low = GymnasiumDomain(Low, SUB_GOALS)
    surprises = [
        (check_domain(domain_of(labels=hidden)), "steps", "different labels: no classifier"),
        (check_domain(domain_of(resumes=False)), "restore", "cannot be resumed"),
        (check_domain(NEVER, SMALL), "collect", "on-the-moon has no positives"),
        (check_domain(low, SMALL), "steps", "options cannot be learned from these pictures: images are too small"),
    ]
    for found, law, warning in surprises:
        verdicts = {verdict.name: verdict for verdict in found}
        require(verdicts.values())
        assert warning in verdicts[law].warnings[0]


def _gives_four(self: Any, action: int) -> Any:
    return self.env.step(action)[:4]


def _raises(self: Any, action: int) -> Any:
    raise KeyError(action)


@pytest.mark.parametrize("method", [_gives_four, _raises])
def test_gymnasiums_own_checker_is_asked(method: Any) -> None:
    """Spec B6: of a wrapper that breaks the contract; the line of code that raises is named."""
    bad = type("Bad", (gymnasium.Wrapper,), {"step": method})
    fault = first_fault(check_domain(GymnasiumDomain(lambda: bad(CorridorEnv()), SUB_GOALS), SMALL))
    assert fault.name == "gymnasium" and "\n" not in fault.text
    assert method is not _raises or f"test_check.py, line {_raises.__code__.co_firstlineno + 1}" in fault.text


class Deaf(CorridorEnv):
    def reset(self, *, seed: int | None = None, options: Any = None) -> Any:
        return super().reset()


class Falsy(CorridorEnv):
    def reset(self, *, seed: int | None = None, options: Any = None) -> Any:
        return super().reset(seed=seed or None)


PASS = "super().reset(seed=seed). No wrapper may show what came before"
SEEDINGS: list[tuple[Any, str]] = [
    (Deaf, PASS),
    (Falsy, "also from 0"),
    (lambda: NormalizeObservation(FlattenObservation(Sensed())), PASS),
]


@pytest.mark.parametrize(("make", "fault"), SEEDINGS)
def test_seeds_that_are_lost_are_one_line(make: Any, fault: str) -> None:
    """Spec B6, G2: what Gymnasium's checker asserts is no error of ours."""
    found = first_fault(check_domain(GymnasiumDomain(make, SUB_GOALS), SMALL))
    assert fault in found.text and "internal error" not in found.text


@pytest.mark.parametrize("name", [name for name in OURS if name != "none"])
def test_our_objectives_keep_the_laws(name: str) -> None:
    """Spec C2."""
    require(check_objective(load_objective(name)))


def _positives(a: Tensor, b: Tensor) -> Tensor:
    return torch.stack([logits.softmax(-1)[..., 1] for logits in (a, b)])


def _from_probabilities(a: Tensor, b: Tensor) -> Tensor:
    p, q = _positives(a, b)
    return -(p * (1 - q) + (1 - p) * q).log().sum(-1) / max(p.shape[-1], 1)


def _as_printed(a: Tensor, b: Tensor) -> Tensor:
    p, q = _positives(a, b)
    return -(p * q + (1 - p) * (1 - q)).clamp(min=1e-9).log().sum(-1) / max(p.shape[-1], 1)


PAIRS = [
    (none.pair_loss, "gradients"),
    (_from_probabilities, "finite"),
    (_as_printed, "disagreement"),
    (lambda a, b: dbat.pair_loss(a.detach(), b), "gradients"),
    (lambda a, b: a.square().mean(-1), "finite"),
    (lambda a, b: dbat.pair_loss(a, b) * a.shape[-2] / a.shape[-2], "finite"),
]
ENSEMBLES: list[tuple[Any, str]] = [
    (lambda context: context.unlabelled.square().sum() / context.unlabelled.shape[1], "finite"),
    (lambda context: context.unlabelled[0].square().sum(), "gradients"),
    (lambda context: -(context.unlabelled.softmax(-1)[..., 0] / 1e9).log().sum(), "finite"),
    (lambda context: context.unlabelled.detach().square().sum(), "gradients"),
]
OBJECTIVES = [(Objective("broken", pair_loss=loss), law) for loss, law in PAIRS]
OBJECTIVES += [(Objective("broken", ensemble_loss=loss), law) for loss, law in ENSEMBLES]


@pytest.mark.parametrize(("objective", "law"), OBJECTIVES)
def test_each_broken_law_of_an_objective_is_named(objective: Objective, law: str) -> None:
    """Spec C1, C2: Eq. (1) as printed, probabilities instead of logits, and other ways to go wrong."""
    assert first_fault(check_objective(objective)).name == law


class Detached(nn.Conv2d):
    def forward(self, input: Tensor) -> Tensor:
        return super().forward(input).detach()


class Lost(nn.Module):
    def forward(self, features: Tensor) -> Tensor:
        return features * torch.nan


class Unkept(nn.Module):
    """It scales by a number that is no buffer."""

    def __init__(self) -> None:
        super().__init__()
        self.scale = torch.rand(1)

    def forward(self, features: Tensor) -> Tensor:
        return features * self.scale


def convolution(*others: nn.Module, kind: type[nn.Conv2d] = nn.Conv2d) -> nn.Module:
    """An encoder with fresh weights."""
    return nn.Sequential(kind(3, 4, 8, 8), *others, nn.Flatten())


def drifting(channels: int) -> nn.Module:
    encoder: Any = convolution()
    encoder[0].weight.data += float(NOBODYS.random())
    return encoder


SHARED = convolution()
NETWORK_FAULTS = [
    (None, "logits", "cannot be loaded"),
    (lambda channels: nn.Sequential(nn.Threshold(0.5, 0.0, True), convolution()), "logits", "changes its input"),
    (lambda channels: SHARED, "logits", "two members share weights"),
    (drifting, "members", "of one seed differ"),
    (lambda channels: convolution(kind=Detached), "gradients", "0.0.weight gets no gradient"),
    (lambda channels: convolution(nn.Softmax(0)), "answers", "among others differ"),
    (lambda channels: convolution(Lost()), "answers", "probabilities are not finite"),
    (lambda channels: convolution(Unkept()), "is kept", "loaded members say something else"),
    (lambda channels: convolution().double(), "logits", "observation shape (64, 64, 3): Input type"),
]


@pytest.mark.parametrize(("make", "law", "fault"), NETWORK_FAULTS)
def test_each_broken_law_of_a_network_is_named(
    make: Any, law: str, fault: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Spec C5: members that are one object, that change what the next one sees, that cannot learn or be asked."""
    if make is not None:
        monkeypatch.setattr(sys.modules[__name__], "broken", make, raising=False)
    monkeypatch.setenv("HYPOGOAL_TRUST", "1")
    found = first_fault(check_network("test_check:broken"))
    assert found.name == law and fault in found.text


def squeezed(channels: int) -> nn.Module:
    return convolution(nn.Sigmoid(), nn.Conv2d(4, 4, 1).requires_grad_(False))


BOTH = mixed_type({"front": (np.dtype(np.uint8), (64, 64, 3)), "joints": (np.dtype(np.float32), (7,))})
KEPT = [((name,), "DeepLift") for name in NETWORKS]
KEPT += [
    (("test_check:squeezed",), "integrated"),
    (("tests.hypotheses.test_encoders:Looped",), "integrated"),
    (("mlp", (11,), np.dtype(np.float32)), ""),
    (("front=tiles", (), BOTH), ""),
]


@pytest.mark.parametrize(("network", "explained"), KEPT)
def test_networks_that_keep_the_contract_pass(network: Any, explained: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """Spec C5, F2: ours, own ones with weights that stay as they are, of numbers, mixed; and how they are explained."""
    monkeypatch.setenv("HYPOGOAL_TRUST", "1")
    found = [*check_network(*network)]
    require(found)
    assert f"explained by {explained}" in found[0].text


def test_the_command_prints_a_line_for_each_law(monkeypatch: pytest.MonkeyPatch) -> None:
    """Spec B6: exit code 0 where all are kept, 2 where one is not; what the user named needs no permission."""
    monkeypatch.chdir(TESTS)
    small = settings("steps=150", "heldout_seeds=4,5")
    told = run("check", "corridor_env:DOMAIN", *small).out.splitlines()
    assert len(told) == 5 and all(line.startswith("ok   ") for line in told)
    told = fails("check", "corridor_env:RESTLESS", *small).out.splitlines()
    assert told[-1].startswith("FAIL two engines") and "np_random" in told[-1]
    told = run("check", "corridor_env:SENSED", *small, "--network", "mlp").out.splitlines()
    assert len(told) == 10 and not any(line.startswith("FAIL") for line in told)
    monkeypatch.chdir(TESTS.parent / "examples")
    run("check", "--diversity", "margin:pair_loss", "--network", "wide_network:wide")
    refuses("nothing to check", "check")


def test_an_objective_of_frozen_members_is_one() -> None:
    """Members that are trained now against those that were trained before, alone."""

    def against_earlier(context: Context) -> Tensor:
        pairs = [dbat.pair_loss(frozen, member) for frozen in context.frozen for member in context.unlabelled]
        return torch.stack(pairs).sum() if pairs else context.unlabelled.sum() * 0

    require(check_objective(Objective("earlier", ensemble_loss=against_earlier)))
