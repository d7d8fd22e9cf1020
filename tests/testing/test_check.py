"""``hypogoal check``: what keeps its contract passes, and each broken promise is named (Spec B6, C1, C2)."""

from __future__ import annotations

import itertools
import random
from dataclasses import replace
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import pytest
from command_line import fails, refuses, run, settings
from corridor import Corridor
from corridor_env import ALWAYS, NEVER, SUB_GOALS, CorridorEnv, all_labels, at_left, swift
from hypogoal.testing import Verdict, check_domain, check_network, check_objective, require
from own_domain import CorridorConfig, CorridorDomain, TallCorridor
from torch import Tensor, nn

from hypogoal.cli import main
from hypogoal.core.errors import UserError
from hypogoal.core.progress import Progress
from hypogoal.data import GET_MORE, Collected
from hypogoal.diversity import OBJECTIVES as OURS
from hypogoal.diversity import Objective, dbat, load_objective, none
from hypogoal.domains import base as bases
from hypogoal.domains.base import Step
from hypogoal.domains.gymnasium_domain import GymnasiumConfig, GymnasiumDomain
from hypogoal.hypotheses.networks import NETWORKS
from tests.attacks.own_code import FAMILIES

TESTS = Path(__file__).parents[1]


def domain_of(**engine_parts: Any) -> CorridorDomain:
    """The corridor with an engine whose methods and attributes are replaced."""
    engine = type("Broken", (TallCorridor,), engine_parts)

    class Domain(CorridorDomain):
        observation_shape = engine_parts.get("observation_shape", TallCorridor.observation_shape)

        def make_engine(self, layout_seed: int, count: int, max_steps: int, **arguments: Any) -> Any:
            return engine(count, max_steps)

    return Domain()


def collecting(change: Any) -> CorridorDomain:
    """The corridor with other collected states."""

    class Domain(CorridorDomain):
        def collect(self, config: CorridorConfig, seed: int, progress: Any) -> Collected:
            return change(super().collect(config, seed, progress))

    return Domain()


def stepped(**changes: Any) -> dict[str, Any]:
    """An engine whose steps are changed."""

    def step(self: Any, actions: np.ndarray) -> Step:
        found = Corridor.step(self, actions)
        return found._replace(**{name: change(getattr(found, name)) for name, change in changes.items()})

    return {"step": step}


def first_fault(verdicts: Any) -> Verdict:
    return next(verdict for verdict in verdicts if not verdict.ok)


def never_ending(self: Any, actions: np.ndarray) -> Step:
    self.max_steps = 10_000
    return Corridor.step(self, actions)


def forgetful(self: Any, snapshot: dict[str, Any]) -> None:
    Corridor.restore(self, snapshot | {"ids": np.full_like(snapshot["ids"], 4)})


NOBODYS, COUNT = np.random.default_rng(5), itertools.count()


def wandering(self: Any, actions: np.ndarray) -> Step:
    return Corridor.step(self, NOBODYS.integers(2, size=len(actions)))


def moved(states: Any, **changes: Any) -> Any:
    return replace(states, **{name: change(getattr(states, name)) for name, change in changes.items()})


def test_domains_that_keep_the_contract_pass() -> None:
    """Spec B6; the corridor's held-out states are those for learning, and that is told."""
    verdicts = list(check_domain(CorridorDomain()))
    require(verdicts)
    assert len(verdicts) == 12
    assert [verdict.name for verdict in verdicts if verdict.warnings] == ["classes", "heldout"]
    told = "left-end has 8 positives among 48 labelled states: classes are unbalanced. Collect more steps or other"
    assert verdicts[8].warnings[0].startswith(told)
    assert not [
        verdict
        for verdict in check_domain(CorridorDomain(), CorridorConfig(10))
        if verdict.name == "classes" and verdict.warnings
    ]


ENGINES = [
    (domain_of(images=lambda self, ids, out=None: np.zeros((len(ids), 64, 64, 3), np.float32)), "images", "float32"),
    (domain_of(images=lambda self, ids, out=None: TallCorridor.images(self, ids)), "images", "does not fill out"),
    (domain_of(reset=lambda self: Corridor.reset(self).astype(np.int32)), "engine", "int32"),
    (domain_of(n_actions=0), "engine", "n_actions is 0"),
    (domain_of(**stepped(rewards=lambda values: values.astype(np.float64))), "steps", "float64"),
    (domain_of(**stepped(rewards=lambda values: values * np.nan)), "steps", "finite"),
    (domain_of(**stepped(terminated=lambda values: values.astype(np.int64))), "steps", "terminated of a step"),
    (domain_of(**stepped(succeeded=lambda _: np.zeros(3, np.int64))), "steps", "succeeded of a step"),
    (domain_of(step=never_ending), "steps", "went on after max_steps"),
    (domain_of(labels=lambda self, ids: Corridor.labels(self, ids).astype(np.int64)), "labels", "int64"),
    (domain_of(labels=lambda self, ids: Corridor.labels(self, ids)[:, :1]), "labels", "(3, 1)"),
    (
        domain_of(labels=lambda self, ids: Corridor.labels(self, ids) | [False, next(COUNT) % 2 == 0]),
        "labels",
        "asked twice in the same state, labels differ: right-end",
    ),
    (domain_of(step=wandering), "determinism", "differ"),
    (domain_of(restore=forgetful), "going on", "after restore"),
    (domain_of(images=lambda self, ids, out=None: 1 // 0), "images", "ZeroDivisionError"),
]
COLLECTIONS = [
    (collecting(lambda found: replace(found, sub_goals=("right-end", "left-end"))), "collection", "in their order"),
    (
        collecting(lambda found: replace(found, labelled=moved(found.labelled, labels=lambda x: x.astype(int)))),
        "collection",
        "labelled labels",
    ),
    (
        collecting(lambda found: replace(found, heldout=moved(found.heldout, observations=lambda x: x[:0]))),
        "collection",
        "no held-out states",
    ),
    (
        collecting(lambda found: replace(found, labelled=moved(found.labelled, labels=np.zeros_like))),
        "classes",
        "left-end has no positives",
    ),
    (
        collecting(
            lambda found: replace(
                found, unlabelled=moved(found.unlabelled, observations=lambda x: NOBODYS.permutation(x))
            )
        ),
        "collected again",
        "unlabelled states differ",
    ),
]


@pytest.mark.parametrize(("domain", "name", "message"), [*ENGINES, *COLLECTIONS])
def test_each_broken_promise_is_named(domain: CorridorDomain, name: str, message: str) -> None:
    """Spec B6: which check fails, and what was found."""
    fault = first_fault(check_domain(domain))
    assert fault.name == name
    assert message in fault.text
    with pytest.raises(AssertionError, match=f"FAIL {name}"):
        require(check_domain(domain))


DEFAULTS: list[tuple[dict[str, Any], str]] = [
    ({"train-ensemble": {"memberz": 4}}, "train-ensemble has no setting: memberz. Did you mean 'members'?"),
    ({"train_ensemble": {"members": 4}}, "defaults are for 'train_ensemble', which is not a stage. Did you mean"),
    ({"train-meta": {"steps": 0}}, "value out of range: steps=0 in train-meta"),
    ({"collect": {"copiez": 2}}, "collect has no setting: copiez"),
    ({"train-options": 7}, "defaults of train-options are 7"),
]


@pytest.mark.parametrize(("defaults", "message"), DEFAULTS)
def test_defaults_that_no_stage_takes_are_named(defaults: dict[str, Any], message: str) -> None:
    """Spec B6: of a misspelt stage nothing would ever be heard, of a misspelt setting only when the stage is run."""
    domain = CorridorDomain()
    domain.defaults = {"train-ensemble": {"members": 4}, **defaults}  # type: ignore[attr-defined]
    fault = first_fault(check_domain(domain))
    assert fault.name == "defaults" and message in fault.text


def test_defaults_that_stages_take_pass() -> None:
    """Spec B6."""
    domain = CorridorDomain()
    domain.defaults = {"train-ensemble": {"members": 4}, "collect": {"copies": 2}, "train-baseline": {}}  # type: ignore[attr-defined]
    verdicts = list(check_domain(domain))
    require(verdicts)
    assert verdicts[1].text == "train-ensemble 1, collect 1, train-baseline 0"


def test_broken_names() -> None:
    """Spec G2: names of sub-goals become names of files."""
    domain = CorridorDomain()
    domain.sub_goals = ("a/b", "c")
    assert "a/b" in first_fault(check_domain(domain)).text


def test_labels_that_cannot_be_seen_are_told() -> None:
    """Spec B6: a picture with two labels is allowed, and no classifier can learn it."""

    def hidden(self: Any, ids: np.ndarray) -> np.ndarray:
        return np.stack([ids == 0, np.full(len(ids), self.elapsed[0] % 2 == 0)], axis=1)

    verdicts = {verdict.name: verdict for verdict in check_domain(domain_of(labels=hidden))}
    assert "have different labels" in verdicts["labels"].warnings[0]


def test_a_label_of_the_way_there_is_named() -> None:
    """Spec B6: one that keeps what it was asked before, by a function each or by one for all; a state's own pass."""
    met: list[int] = []

    def all_but_odd(env: Any) -> dict[str, bool]:
        met.append(env.unwrapped.cell)
        return {"left-end": at_left(env), "odd": len(met) % 2 == 1}

    small = GymnasiumConfig(steps=150, heldout_seeds=(4, 5))
    for domain in (
        GymnasiumDomain(CorridorEnv, ("left-end", "odd"), labels=all_but_odd),
        GymnasiumDomain(CorridorEnv, {"left-end": at_left, "odd": lambda env: all_but_odd(env)["odd"]}),
    ):
        fault = first_fault(check_domain(domain, small))
        assert fault.name == "labels"
        assert "asked twice in the same state, labels differ: odd. A label is a function of the state" in fault.text
    both = ("left-end", "right-end")
    require(check_domain(GymnasiumDomain(CorridorEnv, both, labels=all_labels, success=swift), small))


@pytest.mark.parametrize(("domain", "goal", "word"), [(NEVER, "on-the-moon", "no"), (ALWAYS, "somewhere", "every")])
def test_a_rare_sub_goal_is_no_broken_contract(domain: GymnasiumDomain, goal: str, word: str) -> None:
    """Spec B6: a warning that says what to do, and the rest is looked at; ``collect`` itself still refuses."""
    small = GymnasiumConfig(steps=150, heldout_seeds=(4, 5))
    verdicts = {verdict.name: verdict for verdict in check_domain(domain, small)}
    assert all(verdict.ok for verdict in verdicts.values()) and "collected again" in verdicts
    text = verdicts["classes"].warnings[0]
    assert text.startswith(
        f"{goal} held in {word} state that play met on the labelled layouts, so 'collect' would stop"
    )
    assert text.endswith(GET_MORE)
    with pytest.raises(UserError, match=f"{goal} has no"):
        domain.collect(small, 0, Progress("collect", 1, quiet=True))


class Wrapped(gymnasium.Wrapper):  # type: ignore[type-arg]
    """A wrapper that changes nothing."""


def wrapper(**methods: Any) -> type[gymnasium.Wrapper]:  # type: ignore[type-arg]
    return type("Bad", (gymnasium.Wrapper,), methods)


def _drops(self: Any, *, seed: Any = None, options: Any = None) -> Any:
    return self.env.reset(options=options)


def _takes_none(self: Any) -> Any:
    return self.env.reset()


def _gives_one(self: Any, *, seed: Any = None, options: Any = None) -> Any:
    return self.env.reset(seed=seed)[0]


def _gives_four(self: Any, action: int) -> Any:
    return self.env.step(action)[:4]


def _gives_text(self: Any, action: int) -> Any:
    observation, reward, *rest = self.env.step(action)
    return observation, str(reward), *rest


def _gives_more(self: Any, *, seed: Any = None, options: Any = None) -> Any:
    observation, info = self.env.reset(seed=seed)
    return np.concatenate([observation, observation]), info


def _draws(self: Any, *, seed: Any = None, options: Any = None) -> Any:
    return self.env.reset(seed=int(NOBODYS.integers(1_000)))


BAD = [
    *(("reset", method) for method in (_drops, _takes_none, _gives_one, _gives_more, _draws)),
    *(("step", method) for method in (_gives_four, _gives_text)),
]


@pytest.mark.parametrize(("name", "method"), BAD)
@pytest.mark.parametrize("around", [lambda env: env, Wrapped, gymnasium.wrappers.OrderEnforcing])
def test_a_wrapper_that_breaks_the_contract_is_named(
    name: str, method: Any, around: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Spec B6, G2: by its own file and line, wherever it is met."""
    bad = wrapper(**{name: method})
    domain = GymnasiumDomain(lambda: around(bad(Wrapped(CorridorEnv()))), SUB_GOALS)
    here = f"test_check.py, line {method.__code__.co_firstlineno}"
    fault = first_fault(check_domain(domain, GymnasiumConfig(steps=150, heldout_seeds=(4, 5))))
    assert here in fault.text and fault.text.count("test_check.py") == 1, fault.text
    assert fault.name == "gymnasium" or method is _gives_text
    monkeypatch.setitem(bases.REGISTERED, "bad", domain)
    few = settings("steps=200", "heldout_seeds=4")
    refuses(here, "collect", "bad", "--out", tmp_path / "data.h5", *few, "-q")
    refuses(here, "train-baseline", "bad", "--out", tmp_path / "ppo", "--set", "steps=256", "-q")


@pytest.mark.parametrize("family", [*FAMILIES])
def test_a_few_of_many_stacks_and_commands(family: str) -> None:
    """Spec B6, G2: a few of the cases of ``tests.attacks.own_code``."""
    assert all(FAMILIES[family](random.Random(f"test {family} {case}")) for case in range(30))


def test_an_environment_that_drops_the_seed_is_named(
    tmp_path: Path, capsys: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Spec B6: what draws from nobody's seed, seen in what is shown or in what will be drawn."""

    class Own(CorridorEnv):
        def reset(self, *, seed: int | None = None, options: Any = None) -> Any:
            return super().reset(seed=int(NOBODYS.integers(8)))

    class Later(CorridorEnv):
        def reset(self, *, seed: int | None = None, options: Any = None) -> Any:
            _, info = super().reset()  # as if it drew only later
            self.layout = 0
            return self.image(), info

    for made in (Own, Later):
        monkeypatch.setitem(bases.REGISTERED, "bad", GymnasiumDomain(made, SUB_GOALS))
        assert main(["collect", "bad", "--out", str(tmp_path / "data.h5"), "--set", "steps=200", "-q"]) == 2
        (err,) = capsys.readouterr().err.splitlines()
        line = made.reset.__code__.co_firstlineno
        assert f"reset began two different episodes with seed=0: test_check.py, line {line}. Pass the seed on" in err


@pytest.mark.parametrize("name", [name for name in OURS if name != "none"])
def test_our_objectives_keep_the_laws(name: str) -> None:
    """Spec C2."""
    require(check_objective(load_objective(name)))


def _naive(a: Tensor, b: Tensor) -> Tensor:
    p, q = a.softmax(-1)[..., 1], b.softmax(-1)[..., 1]
    return -(p * (1 - q) + (1 - p) * q).log().sum(-1) / max(p.shape[-1], 1)


def _as_printed(a: Tensor, b: Tensor) -> Tensor:
    p, q = a.softmax(-1)[..., 1], b.softmax(-1)[..., 1]
    return -(p * q + (1 - p) * (1 - q)).clamp(min=1e-9).log().sum(-1) / max(p.shape[-1], 1)


def _distance(a: Tensor, b: Tensor) -> Tensor:
    return -(a.softmax(-1) - b.softmax(-1)).square().sum((-2, -1)) / max(a.shape[-2], 1)


def _one_sided(a: Tensor, b: Tensor) -> Tensor:
    return dbat.pair_loss(a.detach(), b)


OBJECTIVES = [
    (none.pair_loss, "disagreement lowers it"),
    (_naive, "finite at extreme logits"),
    (_as_printed, "disagreement lowers it"),
    (_distance, "gradient does not vanish"),
    (_one_sided, "gradient does not vanish"),
    (lambda a, b: dbat.pair_loss(a, b).mean(), "shape"),
    (lambda a, b: dbat.pair_loss(a, b) * a.shape[-2] / a.shape[-2], "empty sets"),
    (lambda a, b: dbat.pair_loss(a, b) + 0.1 * a.square().sum((-2, -1)), "order does not matter"),
]


@pytest.mark.parametrize(("pair_loss", "name"), OBJECTIVES)
def test_each_broken_law_is_named(pair_loss: Any, name: str) -> None:
    """Spec C2: Eq. (1) as printed, probabilities instead of logits, and other ways to go wrong."""
    assert first_fault(check_objective(Objective("broken", pair_loss=pair_loss))).name == name


OF_ENSEMBLES: list[tuple[Any, str]] = [
    (lambda context: context.unlabelled.mean((1, 2)), "shape"),
    (lambda context: context.unlabelled.square().sum() / context.unlabelled.shape[1], "empty sets"),
    (lambda context: context.unlabelled[0].square().sum(), "order does not matter"),
    (lambda context: -(context.unlabelled.softmax(-1)[..., 0] / 1e9).log().sum(), "finite at extreme logits"),
    (lambda context: context.unlabelled.detach().square().sum(), "gradient does not vanish"),
]


@pytest.mark.parametrize(("ensemble_loss", "name"), OF_ENSEMBLES)
def test_each_broken_law_of_ensembles_is_named(ensemble_loss: Any, name: str) -> None:
    """Spec C1, C2."""
    assert first_fault(check_objective(Objective("broken", ensemble_loss=ensemble_loss))).name == name


def squeezed(channels: int) -> tuple[list[nn.Module], tuple[int, ...]]:
    return [nn.Conv2d(channels, 4, 8, 8), nn.Sigmoid()], (8,)


def spread(channels: int) -> nn.Module:
    return nn.Sequential(nn.Conv2d(channels, 4, 8, 8), nn.Flatten(), nn.Softmax(0))


class Detached(nn.Conv2d):
    def forward(self, input: Tensor) -> Tensor:
        return super().forward(input).detach()


def dead(channels: int) -> tuple[list[nn.Module], tuple[int, ...]]:
    return [Detached(channels, 4, 8, 8), nn.ReLU()], (8,)


def frozen(channels: int) -> tuple[list[nn.Module], tuple[int, ...]]:
    return [nn.Conv2d(channels, 4, 8, 8).requires_grad_(False), nn.ReLU()], (8,)


FAULTS = [("spread", "same answers however asked"), ("dead", "gradients"), ("missing", "builds")]


@pytest.mark.parametrize(("name", "fault"), FAULTS)
def test_networks_are_checked(name: str, fault: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """Spec C5: what cannot be asked or learned is named."""
    monkeypatch.setenv("HYPOGOAL_TRUST", f"test_check:{name}")
    assert first_fault(check_network(f"test_check:{name}")).name == fault


def test_weights_may_be_frozen(monkeypatch: pytest.MonkeyPatch) -> None:
    """Spec C5: what is to have no gradient needs none."""
    monkeypatch.setenv("HYPOGOAL_TRUST", "test_check:frozen")
    require(check_network("test_check:frozen"))


@pytest.mark.parametrize(("name", "method"), [("squeezed", "integrated gradients"), ("tiles", "DeepLift")])
def test_networks_are_told_how_they_are_explained(name: str, method: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """Spec C5, F2."""
    monkeypatch.setenv("HYPOGOAL_TRUST", f"test_check:{name}")
    verdicts = {verdict.name: verdict for verdict in check_network(name if name in NETWORKS else f"test_check:{name}")}
    assert verdicts["explained"].text == f"by {method}"


def test_the_command_prints_a_line_a_check(monkeypatch: pytest.MonkeyPatch) -> None:
    """Spec B6: exit code 0 where all are kept, 2 where one is not; what the user named needs no permission."""
    monkeypatch.chdir(TESTS)
    small = settings("steps=150", "heldout_seeds=4,5")
    told = run("check", "corridor_env:DOMAIN", *small).out.splitlines()
    assert all(line.startswith("ok   ") for line in told if "unbalanced" not in line) and len(told) == 15
    told = fails("check", "corridor_env:RESTLESS", *small).out.splitlines()
    assert told[-1].startswith("FAIL determinism") and "np_random" in told[-1]
    told = run("check", "corridor_env:SENSED", *small, "--network", "mlp").out
    assert "ok   images: float32 (11,)" in told and "FAIL" not in told and told.count("ok   builds") == 1
    told = fails("check", "corridor_env:SENSED", *small, "--network", "doorkey").out
    assert "'doorkey' does not take these observations: observation shape (11,). Give --set network=mlp" in told
    assert "observations must be images" in fails("check", "corridor_env:WORDY").err
    refuses("nothing to check", "check")


def test_own_objectives_and_networks_train(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Spec C1, C5: the examples are checked, trained with, read where they are allowed.

    In processes of their own ``test_own_code`` and ``test_trust`` have such code.
    """
    from hypogoal import load_ensemble

    monkeypatch.chdir(TESTS.parent / "examples")
    run("check", "--diversity", "margin:pair_loss", "--network", "wide_network:wide")
    data, out = tmp_path / "data.h5", tmp_path / "ensemble"
    monkeypatch.syspath_prepend(str(TESTS))
    run("collect", "corridor_env:DOMAIN", "--out", data, "--set", "steps=150", "-q")
    train = ["train-ensemble", str(data), "--out", str(out), "--diversity", "margin:pair_loss", "-q"]
    few = settings("steps=20", "members=2", "workers=1")
    monkeypatch.setenv("HYPOGOAL_TRUST", "corridor_env:DOMAIN")
    run(*train, *few, "--set", "network=wide_network:wide")
    with pytest.raises(UserError, match=r"names code of its own as its network.*HYPOGOAL_TRUST=wide_network:wide"):
        load_ensemble(out, "left-end")
    monkeypatch.setenv("HYPOGOAL_TRUST", "wide_network:wide")
    assert load_ensemble(out, "left-end").predict(np.zeros((1, 48, 48, 3), np.uint8)).shape == (1, 2)


def test_a_preset_cannot_name_code(tmp_path: Path) -> None:
    """Spec G2: a preset may be a stranger's file; what it names is not loaded unless it is allowed."""
    from toy_data import write

    preset = tmp_path / "theirs.toml"
    preset.write_text('[train-ensemble]\ndiversity = "evil:pair_loss"\n')
    given = ["train-ensemble", str(write(tmp_path / "data.h5")), "--out", str(tmp_path / "out")]
    refuses("a file names code of its own as its diversity objective: evil:pair_loss", *given, "--preset", preset)
