"""LockedRoom through the stages: a policy for each sub-goal reaches it, and members learn from what they reach."""

import importlib
from pathlib import Path

import numpy as np
import pytest

EXAMPLES = Path(__file__).parents[2] / "examples"


@pytest.fixture(autouse=True)
def in_the_examples_folder(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(EXAMPLES)
    monkeypatch.syspath_prepend(str(EXAMPLES))
    monkeypatch.setenv("HYPOGOAL_TRUST", "1")


@pytest.mark.parametrize("seed", [0, 1, 2])
def test_every_policy_reaches_its_sub_goal(seed: int) -> None:
    """Spec I4: each door by its colour, the locked one with its key, and the key, before MiniGrid's own time is up."""
    example = importlib.import_module("locked_room")
    env, rng = example.make(), np.random.default_rng(0)
    locked = 0

    def labels() -> dict[str, bool]:
        return {name: label(env) for name, label in example.SUB_GOALS.items()}

    for name, policy in example.POLICIES.items():
        env.reset(seed=seed)
        holds, steps = labels(), 0
        assert not any(holds.values())
        while not holds[name]:
            env.step(policy(env, None, rng))
            holds, steps = labels(), steps + 1
            assert steps < 150, name
        others = {other for other, held in holds.items() if held} - {name}
        locked += name != "hold-key" and "hold-key" in others
    assert locked == 1
