"""What is restored is all there was: every attribute of every part, without a list of names (Spec G1)."""

import copy
from collections import deque
from collections.abc import Iterator, Mapping
from typing import Any

import numpy as np
import pytest
import torch
from corridor import Corridor
from loops import CASES, loop_of
from odd_parts import Twice

from hypogoal.options.choosers import CHOOSERS
from hypogoal.options.learner import LEARNERS
from hypogoal.options.loop import OptionLoop
from hypogoal.options.termination import TerminationRule, Terminations

STEPS = 45


def differences(one: Any, other: Any, place: str, known: set[int]) -> Iterator[str]:
    """Where two objects differ, in anything that they consist of; an engine by what it gives as its state."""
    if id(one) in known:
        return
    known.add(id(one))
    if type(one) is not type(other):
        yield f"{place}: {type(one).__name__}, {type(other).__name__}"
    elif isinstance(one, np.ndarray):
        if one.shape != other.shape or not np.array_equal(one, other, equal_nan=one.dtype.kind == "f"):
            yield place
    elif isinstance(one, torch.Tensor):
        if not torch.equal(one, other):
            yield place
    elif isinstance(one, list | tuple | deque):
        if len(one) != len(other):
            yield f"{place}: {len(one)}, {len(other)} of them"
        for number, pair in enumerate(zip(one, other, strict=False)):
            yield from differences(*pair, f"{place}[{number}]", known)
    elif isinstance(one, Mapping):
        if one.keys() != other.keys():
            yield f"{place}: {sorted(map(str, one.keys() ^ other.keys()))}"
        for key in one.keys() & other.keys():
            yield from differences(one[key], other[key], f"{place}[{key}]", known)
    elif isinstance(one, np.random.Generator):
        if one.bit_generator.state != other.bit_generator.state:
            yield place
    elif isinstance(one, torch.Generator):
        if not torch.equal(one.get_state(), other.get_state()):
            yield place
    elif hasattr(one, "state_dict"):  # networks, optimisers
        yield from differences(one.state_dict(), other.state_dict(), place, known)
    elif hasattr(one, "snapshot") and hasattr(one, "n_actions"):
        yield from differences(one.snapshot(), other.snapshot(), place, known)
    elif hasattr(one, "__dict__") and not callable(one):
        yield from differences(vars(one), vars(other), place, known)
    elif isinstance(one, bool | int | float | str) and one != other:
        yield f"{place}: {one}, {other}"


def parting(one: OptionLoop, other: OptionLoop) -> list[str]:
    return list(differences(one, other, "loop", set()))


def with_rule(case: str) -> OptionLoop:
    """The case with a rule that has state in place of the paper's, but where options are planned by that."""
    loop = loop_of(case)
    if "planned" not in case:
        engine = loop.engine
        rule = Twice(np.zeros(2, np.float32), engine.count)
        terminations = Terminations(lambda ids: engine.labels(ids)[:, :2], rule)
        loop.terminations = loop.learner.terminations = terminations
    return loop


def test_every_registered_part_is_compared() -> None:
    parts = {type(part).__name__ for case in CASES for part in (loop_of(case).learner, loop_of(case).chooser)}
    assert {place.partition(":")[2] for place in (*CHOOSERS.values(), *LEARNERS.values())} <= parts


@pytest.mark.usefixtures("small_gru")
@pytest.mark.parametrize("case", CASES)
def test_a_fresh_part_that_is_restored_has_all_that_the_other_has(case: str) -> None:
    """Then both go on alike. Where nothing is restored the two differ, or nothing would be tested."""
    played, fresh = with_rule(case), with_rule(case)
    for _ in range(STEPS):
        played.step()
    assert parting(played, fresh)
    fresh.restore(copy.deepcopy(played.snapshot()))
    assert parting(played, fresh) == []
    for _ in range(STEPS // 3):
        played.step()
        fresh.step()
    assert parting(played, fresh) == []


def test_what_is_left_out_is_found(monkeypatch: pytest.MonkeyPatch) -> None:
    """An attribute that changes and is not named as such."""
    monkeypatch.setattr(Twice, "CHANGING", TerminationRule.CHANGING)
    played, fresh = with_rule("light, shared, ppo"), with_rule("light, shared, ppo")
    assert isinstance(played.engine, Corridor)
    for _ in range(STEPS):
        played.step()
    fresh.restore(copy.deepcopy(played.snapshot()))
    assert any("row" in place for place in parting(played, fresh))
