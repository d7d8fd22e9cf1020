"""Members' verdicts on states: each asked for once, and the first one stands (Spec D1, G1)."""

from collections.abc import Callable

import numpy as np
import pytest
import torch
from corridor import LENGTH, Corridor, LongCorridor
from numpy.typing import NDArray
from torch import nn
from uneven import Uneven

from hypogoal.domains.base import Engine
from hypogoal.domains.doorkey.engine import DoorKeyEngine
from hypogoal.hypotheses.ensemble import Ensemble
from hypogoal.hypotheses.networks import NETWORKS
from hypogoal.options.termination import Terminations, learned_terminations


def ensembles_of(engine: Engine, network: str) -> list[Ensemble]:
    return [Ensemble(network, engine.observation_shape, 2, torch.Generator().manual_seed(g)).eval() for g in range(2)]


def moved(engine: Engine, steps: int) -> NDArray[np.int64]:
    """All states that the engine has met after so many steps at random."""
    rng = np.random.default_rng(0)
    for _ in range(steps):
        engine.step(rng.integers(engine.n_actions, size=engine.count))
    return np.arange(engine.n_states)


def test_verdicts_are_asked_once_per_state() -> None:
    """Spec D1: the cache gives what the classifier gives and asks it once for each state."""
    engine, asked = Corridor(1), []

    def classify(ids):
        asked.extend(ids.tolist())
        return engine.labels(ids)

    verdicts = Terminations.of_predictions(classify, 2)
    rng = np.random.default_rng(0)
    for _ in range(20):
        ids, options = rng.integers(LENGTH, size=7), rng.integers(2, size=7)
        np.testing.assert_array_equal(verdicts.of(ids), engine.labels(ids))
        np.testing.assert_array_equal(verdicts.of_running(ids, options), engine.labels(ids)[np.arange(7), options])
    assert sorted(asked) == list(range(LENGTH))
    assert verdicts.of_running(ids[:0], options[:0]).shape == (0,)
    far = np.array([5000])
    assert Terminations.of_predictions(lambda ids: np.ones((len(ids), 2), dtype=bool), 2).of(far).all()


class TallCorridor(LongCorridor):
    """In pictures that the member network takes."""

    observation_shape = (84, 84, 4)


def test_running_members_are_judged_alone_and_once() -> None:
    """Spec D1: the verdicts of each ensemble's own, its thresholds included, member by member, each state once."""
    engine = TallCorridor(3)
    everything, rng = moved(engine, 20), np.random.default_rng(0)
    ensembles = ensembles_of(engine, "montezuma")
    for ensemble in ensembles:  # each member says yes in some of the states, in none within rounding of its threshold
        chances = np.sort(ensemble.predict(engine.images(everything)), axis=0)
        widest = np.diff(chances, axis=0).argmax(0)
        ensemble.thresholds.copy_(
            torch.from_numpy(np.take_along_axis(chances, widest + np.array([[0], [1]]), 0).mean(0))
        )
    wanted = np.concatenate([ensemble.predictions(engine.images(everything)) for ensemble in ensembles], axis=1)
    assert (wanted.any(0) & ~wanted.all(0)).all()
    verdicts = learned_terminations(engine, ensembles, running_only=True)
    asked: list[tuple[int, int]] = []
    ask = verdicts.classify_one
    assert ask is not None

    def counted(ids, option):
        asked.extend((int(identity), option) for identity in ids)
        return ask(ids, option)

    verdicts.classify_one = counted
    for _ in range(30):
        ids, options = rng.integers(engine.n_states, size=9), rng.integers(4, size=9)
        np.testing.assert_array_equal(verdicts.of_running(ids, options), wanted[ids, options])
    assert len(set(asked)) == len(asked) > 100
    np.testing.assert_array_equal(verdicts.of(everything), wanted)


def in_one_piece(channels: int) -> tuple[list[nn.Module], tuple[int, ...]]:
    """A network whose members cannot be joined to one."""
    return [nn.Conv2d(channels, 4, 8, stride=8), nn.GroupNorm(2, 4), nn.ReLU()], (16,)


Asked = Callable[[Terminations, NDArray[np.int64], NDArray[np.int64]], NDArray[np.bool_]]
ASKED: dict[str, tuple[str, Asked]] = {
    "all of them, joined": ("doorkey", lambda verdicts, ids, _: verdicts.of(ids)),
    "all of them, not joined": ("in one piece", lambda verdicts, ids, _: verdicts.of(ids)),
    "the running ones": ("doorkey", lambda verdicts, ids, options: verdicts.of_running(ids, options)),
}


@pytest.mark.parametrize("asked", ASKED)
def test_what_was_said_stands(asked: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """Spec G1: members that are undecided to the last bit, where that depends on the states judged together: after a
    break they say what they say without one, and never two things of one state.
    """
    monkeypatch.setitem(NETWORKS, "in one piece", in_one_piece)
    network, ask = ASKED[asked]
    engine = DoorKeyEngine(100, 4)
    everything, rng = moved(engine, 15), np.random.default_rng(0)
    together = [(rng.choice(everything, size=5), rng.integers(4, size=5)) for _ in range(20)]
    ensembles = ensembles_of(engine, network)
    with Uneven():
        for ensemble in ensembles:
            for member in ensemble.members:
                nn.init.ones_(member[-1].bias)
                member[-1].weight.data *= 1e-6
            ensemble.thresholds.copy_(torch.from_numpy(np.median(ensemble.predict(engine.images(everything)), axis=0)))

        def fresh() -> Terminations:
            if asked == "the running ones":
                return learned_terminations(engine, ensembles, running_only=True)
            return learned_terminations(engine, ensembles)

        unbroken, broken, resumed, another = (fresh() for _ in range(4))
        said = [ask(unbroken, *some) for some in together]
        for some in together[:10]:
            ask(broken, *some)
        resumed.restore(broken.snapshot())
        for some, expected in zip(together[10:], said[10:], strict=True):
            np.testing.assert_array_equal(ask(resumed, *some), expected)
        at_once = another.of(everything)  # which depends on the batch, or nothing would be tested here
        assert any((ask(another, *some) != expected).any() for some, expected in zip(together, said, strict=True))
        assert at_once.any() and not at_once.all()
        later = unbroken.of(everything)
        for (ids, options), expected in zip(together, said, strict=True):
            rows = later[ids] if expected.ndim == 2 else later[ids, options]
            np.testing.assert_array_equal(rows, expected)
