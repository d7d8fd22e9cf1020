"""LockedRoom through the stages: a policy for each sub-goal reaches it, and members learn from what they reach."""

import importlib
from pathlib import Path

import numpy as np
import pytest
from minigrid.core.constants import COLOR_NAMES

from hypogoal.cli import main
from hypogoal.data import open_dataset

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


@pytest.mark.slow
def test_locked_room_is_collected_and_learned(tmp_path: Path) -> None:
    """Spec B6: the example's first commands, in small: every sub-goal has both classes in every set."""
    data, ensemble = str(tmp_path / "data.h5"), str(tmp_path / "ensemble")
    few = ["labelled_seeds=0", "unlabelled_seeds=1", "heldout_seeds=2", "steps=1050", "states=200"]
    assert main(["collect", "locked_room:DOMAIN", "--out", data, "-q", *(w for s in few for w in ("--set", s))]) == 0
    counts = open_dataset(Path(data)).counts()
    names = {*(f"open-{colour}-door" for colour in COLOR_NAMES), "hold-key"}
    for split in ("labelled", "heldout"):
        assert set(counts[split]) == names
        assert all(3 <= row["positives"] < row["states"] for row in counts[split].values()), counts[split]
    quick = ["--set", "steps=3", "--set", "members=2", "--set", "workers=1", "-q"]
    assert main(["train-ensemble", data, "--out", ensemble, *quick]) == 0
