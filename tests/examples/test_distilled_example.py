"""The example of distilled options: what it learns, that it carries over, and its own commands (Spec H6)."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest
import torch
from command_line import settings
from option_loops import loop_of, played
from torch import Tensor

import hypogoal
from examples import distilled
from examples.distilled import Learner
from hypogoal.cli import main
from hypogoal.core.arrays import Ints
from hypogoal.core.artefacts import open_artefact
from hypogoal.core.seeding import rng_for
from hypogoal.core.tensors import load_tensors
from hypogoal.domains.base import Layouts
from hypogoal.domains.doorkey.engine import DoorKeyEngine
from hypogoal.evaluation.choosing import qualities
from hypogoal.meta.config import TrainOptionsConfig
from hypogoal.meta.episodes import agent_of
from hypogoal.options.loop import OptionLoop

GOALS = 5
GRID = "examples.distilled:Grid"
QUICK: dict[str, Any] = {
    "network": "examples.distilled:Learner", "embedding": GRID, "environments": 8, "option_batch": 64,
    "update_interval": 8, "option_learning_rate": 2e-3, "steps": 3200,
}  # fmt: skip
SHORT = {  # appended to the page's commands, so that they end in seconds
    "collect": settings("heldout_layouts=1", "unlabelled_seeds=1"),
    "train-ensemble": settings("steps=2", "members=2", "workers=1"),
    "train-options": settings("steps=640", "layouts=1000-1002"),
    "train-meta": settings("steps=320"),
    "evaluate": ["--layouts", "6000-6001"],
}


def distilling(engine: Any, kind: type[Learner] = Learner) -> OptionLoop:
    return loop_of(engine, kind, options=GOALS, config=TrainOptionsConfig.of(**QUICK))


def layouts(*seeds: int) -> Layouts:
    return Layouts(seeds, rng_for(0, "layouts"))


class Aimless(Learner):
    """Random actions, of those that plans know."""

    def act(self, ids: Ints, options: Ints, age: Ints, *, explore: bool = True) -> Ints:
        return self.rng.choice(self.actions, len(ids))


def arrival(kind: type[Learner], state: Mapping[str, Tensor], seed: int) -> float:
    """How often greedy executions in a layout reach a sub-goal that can be had in time: the mean over sub-goals."""
    loop = distilling(DoorKeyEngine(seed, 1), kind)
    loop.learner.load(state)
    states = loop.engine.plan().ids[::20]
    return float(np.nanmean(qualities(loop, np.arange(GOALS), states)))


def test_options_carry_over_to_layouts_that_nobody_played() -> None:
    """Distilled from twelve layouts, they reach their sub-goals in others twice as often as random actions do."""
    loop = played(distilling(DoorKeyEngine(layouts(*range(1000, 1012)), 8)), 400)
    state = loop.learner.state()
    distilled_options, random_actions = (
        np.array([arrival(kind, state, seed) for seed in range(6000, 6004)]) for kind in (Learner, Aimless)
    )
    assert (distilled_options > random_actions).all()
    assert distilled_options.mean() > 2 * random_actions.mean()


def test_it_goes_on_where_it_was() -> None:
    """Spec G1: the same weights as without a break."""
    whole, begun, resumed = (distilling(DoorKeyEngine(layouts(3, 5), 8)) for _ in range(3))
    played(whole, 20)
    resumed.restore(played(begun, 8).snapshot())
    played(resumed, 12)
    for name, value in whole.learner.state().items():
        assert torch.equal(value, resumed.learner.state()[name]), name


@pytest.mark.filterwarnings("ignore:a masked option runs")
@pytest.mark.slow
def test_distilled_options_go_through_all_stages(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """From plans to play in other layouts, inside an engine and without it; an agent over them, which is drawn."""
    text = Path(distilled.__file__).read_text(encoding="utf-8").replace("\\\n", "")
    monkeypatch.chdir(tmp_path)
    lines = [line.split() for line in text.splitlines() if line.startswith("    hypogoal ")]
    assert len(lines) == 5
    for words in lines:
        more = settings(f"meta_network={GRID}") if words[1] == "train-meta" else []
        assert main([*words[1:], *SHORT[words[1]], *more, "-q"]) == 0, words
    played = pd.read_csv("runs/far/evaluation/numbers.csv").query("scope == 'zero-shot'")
    assert {*played["layout"]} == {6000, 6001}
    assert len(played.dropna(subset="member").drop_duplicates(["sub_goal", "member"])) == 5 * 2
    played = distilled.play(6100)
    assert len(played) == 10 and all("steps its" in line for line in played)
    options, meta = (Path("runs/far") / name for name in ("options", "meta"))
    learned, kept = (load_tensors(folder / "options.safetensors") for folder in (options, meta))
    assert all(torch.equal(value, kept[name]) for name, value in learned.items() if name.startswith("online."))
    loaded, loop = hypogoal.load_options(meta), agent_of(open_artefact(meta, "meta"), 0, 1)
    ids = loop.engine.plan().ids[::97]
    for option in range(loaded.count):
        inside = loop.learner.act(ids, np.full(len(ids), option), np.zeros(len(ids), np.int64), explore=False)
        outside = [loaded.policies(option)(image) for image in loop.engine.images(ids)]
        assert inside.tolist() == outside
