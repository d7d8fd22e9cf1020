"""Sub-goals of Montezuma's Revenge from labels of one room: examples/one_room.py (Spec B4, C5, G1, H4)."""

import sys
from pathlib import Path

import numpy as np
import pytest
from command_line import run, settings
from corridor import Corridor
from option_loops import QUICK, loop_of, played

from hypogoal.core.errors import UserError
from hypogoal.data import open_dataset
from hypogoal.hypotheses.config import EnsembleConfig
from hypogoal.hypotheses.scores import ranking
from hypogoal.hypotheses.training import train
from hypogoal.hypotheses.views import StateOrigins
from hypogoal.options.termination import Terminations

sys.path.insert(0, str(Path(__file__).parents[2] / "examples"))
import one_room

WINDOW = {"view": "one_room:AgentView", "network": "one_room:network"}


def test_a_window_by_hand() -> None:
    """Of pixels that say their row and column: around the agent, black outside of the picture."""
    rows, columns = np.mgrid[:6, :7]
    pictures = np.tile((10 * rows + columns)[None, ..., None], (2, 1, 1, 2)).astype(np.uint8)
    inside, outside = one_room.cut(pictures, np.array([[2.0, 3.0], [5.0, 6.0]]), 3, 3)[..., 1]
    np.testing.assert_array_equal(inside, [[12, 13, 14], [22, 23, 24], [32, 33, 34]])
    np.testing.assert_array_equal(outside, [[45, 46, 0], [55, 56, 0], [0, 0, 0]])


@pytest.mark.parametrize("missing", ["y", "ladder"])
def test_data_that_do_not_say_enough_are_one_line(missing: str) -> None:
    """Spec G2: where the agent is, and which ladder's base a positive is."""
    observations = np.zeros((12, 84, 84, 4), np.uint8)
    where = {"room": 1, "x": 75, "y": 190, "dying": 0, "ladder": 0, "action": 0, "previous_action": 0}
    origins = {name: np.full(12, value) for name, value in where.items() if name != missing}
    config = EnsembleConfig(members=2, steps=1, view_settings=("localiser_steps=1",), **WINDOW)
    with pytest.raises(UserError, match=f"the data do not say {missing} of each state"):
        train(observations, np.arange(12) < 4, observations, config, 0, origins=StateOrigins(origins, origins))


def test_its_preset_is_an_experiment(tmp_path: Path) -> None:
    """The command at the head of one_room.toml."""
    preset = Path(one_room.__file__).with_suffix(".toml")
    words = ["run", "montezuma-ladders", "--preset", preset, "--out", tmp_path / "out", "--dry-run"]
    lines = run(*words).out.splitlines()
    assert sum(" train-ensemble " in line for line in lines) == 3
    assert {line.split("start=")[1].split()[0] for line in lines if "start=" in line} == {"1L", "2-6", "3-9", "0-4"}


@pytest.mark.atari
@pytest.mark.slow
def test_bases_are_recognised_in_rooms_without_labels(tmp_path: Path) -> None:
    """The claim, in small: the agent is found there, and what is around it says more than the whole picture."""
    few = settings("states_per_room=150", "unlabelled_per_room=120", "heldout_per_room=12", "workers=1")
    run("collect", "montezuma", "--out", tmp_path / "data.h5", "-q", *few)
    dataset = open_dataset(tmp_path / "data.h5")
    (goal,) = dataset.sub_goals
    split, unlabelled, heldout = dataset.labelled(goal), dataset.unlabelled(), dataset.heldout(goal)
    origins = StateOrigins(split.origins, dataset.unlabelled_states().origins)
    unseen = heldout.where(heldout.origins["seen"] == 0)

    def trained(**chosen: object) -> tuple[object, float]:
        config = EnsembleConfig(members=2, steps=60, **chosen)  # type: ignore[arg-type]
        ensemble = train(split.observations, split.labels, unlabelled, config, 0, origins=origins)
        return ensemble.view, float(ranking(ensemble.predict(unseen.observations), unseen.labels).mean())

    view, of_windows = trained(view_settings=("localiser_steps=70",), **WINDOW)
    _, of_pictures = trained(network="montezuma")
    positions = np.stack([unseen.origins[name] for name in ("room", "x", "y")], axis=1)
    errors = np.abs(view.locate(unseen.observations) - one_room.observed_pixel(positions))  # type: ignore[attr-defined]
    assert np.median(errors.max(axis=1)) < 4
    assert of_windows > of_pictures + 0.1


def test_options_are_learned_that_were_out_of_reach() -> None:
    """No state is sure enough; with patience the threshold falls, and what the replay holds is judged by it."""
    log_odds = np.array([[3, -1], [2, 0], [1, 1], [0, 2], [-1, 3], [-2, 4]], dtype=np.float32)
    rule = one_room.Patience(np.array([3.5, 5.0], dtype=np.float32), 4)
    rule.steps = 150
    ends = Terminations(lambda ids: log_odds[ids], rule)
    loop = played(loop_of(Corridor(4), ends=ends, **QUICK, experience="own", mask_reached=False), 400)
    assert rule.thresholds.tolist() == [2.25, 3.0]  # three quarters of the surest state
    for rows, end in zip(loop.recorder.executions, (0, 5), strict=True):
        last = list(rows)[-20:]
        assert np.mean([row.reached for row in last]) > 0.8
        assert {row.states[-1] for row in last if row.reached} == {end}
