"""Sub-goals of Montezuma's Revenge from labels of one room: examples/one_room.py (Spec B4, C5, G1, H4)."""

from __future__ import annotations

import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from corridor import LENGTH, Corridor
from numpy.typing import NDArray

from hypogoal.cli import main
from hypogoal.core.artefacts import open_artefact
from hypogoal.core.checkpoints import Checkpoints, State
from hypogoal.core.config import known, resolve
from hypogoal.core.errors import UserError
from hypogoal.core.seeding import seed_for
from hypogoal.data import Collected, States, open_dataset, write_dataset
from hypogoal.hypotheses.config import EnsembleConfig
from hypogoal.hypotheses.ensemble import read_ensemble
from hypogoal.hypotheses.scores import ranking
from hypogoal.hypotheses.training import train
from hypogoal.hypotheses.views import StateOrigins
from hypogoal.options.choosers import RandomChooser
from hypogoal.options.config import OptionConfig
from hypogoal.options.light import LightLearner
from hypogoal.options.loop import OptionLoop
from hypogoal.options.recording import Recorder
from hypogoal.options.termination import Terminations

sys.path.insert(0, str(Path(__file__).parents[2] / "examples"))
import one_room
from one_room import AgentView, AgentViewSettings, Patience, observed_pixel

SHAPE = (84, 84, 4)
OWN = ("view=one_room:AgentView", "network=one_room:network", "threshold=one_room:median")
Origins = dict[str, NDArray[np.int64]]


@pytest.fixture(autouse=True)
def allowed(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("HYPOGOAL_TRUST", "1")


# Windows.


def numbered(count: int = 1) -> NDArray[np.uint8]:
    """Images 6x7 of two frames whose pixels say row and column in the first, and their sum in the second."""
    rows, columns = np.mgrid[:6, :7]
    return np.repeat(np.stack([10 * rows + columns, rows + columns], axis=-1)[None], count, axis=0).astype(np.uint8)


def test_a_window_by_hand() -> None:
    """The pixel in the middle of an odd window is the agent's; of an even one it is the one after the middle."""
    odd = one_room.cut(numbered(), np.array([[2.0, 3.0]]), 3, 3)
    np.testing.assert_array_equal(odd[0, :, :, 0], [[12, 13, 14], [22, 23, 24], [32, 33, 34]])
    even = one_room.cut(numbered(), np.array([[2.4, 3.4]]), 2, 4)
    np.testing.assert_array_equal(even[0, :, :, 0], [[11, 12, 13, 14], [21, 22, 23, 24]])
    np.testing.assert_array_equal(even[0, :, :, 1], [[2, 3, 4, 5], [3, 4, 5, 6]])


def test_outside_the_image_is_black() -> None:
    """At two corners, and somewhere else altogether; each state has its own window."""
    found = one_room.cut(numbered(3), np.array([[0.0, 0.0], [5.0, 6.0], [-90.0, 400.0]]), 3, 3)[..., 1]
    np.testing.assert_array_equal(found[0], [[0, 0, 0], [0, 0, 1], [0, 1, 2]])
    np.testing.assert_array_equal(found[1], [[9, 10, 0], [10, 11, 0], [0, 0, 0]])
    assert not found[2].any()


def test_members_see_the_window_in_chunks() -> None:
    view = AgentView(SHAPE, AgentViewSettings())
    observations = np.random.default_rng(0).integers(256, size=(70, *SHAPE), dtype=np.uint8)
    seen = view.see(observations)
    assert seen.shape == (70, 24, 32, 4)
    np.testing.assert_array_equal(seen[64:], view.see(observations[64:]))
    np.testing.assert_array_equal(view.change(view.to_change(observations), None), seen)


def test_windows_are_moved_and_mapped_alike_in_all_frames() -> None:
    """Each by 0 to twice the margin, shades in their order; without other surroundings, to see it."""
    view = AgentView((84, 84, 2), AgentViewSettings(jitter=2))
    picture = np.random.default_rng(1).integers(256, size=(28, 36, 2), dtype=np.uint8)
    kept = np.repeat(picture[None], 60, axis=0)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(one_room, "other_surroundings", lambda windows, rng: windows)
        changed = view.change(kept, np.random.default_rng(0))
    assert changed.shape == (60, 24, 32, 2)
    assert changed.dtype == np.float32
    corners = set()
    for state in changed:
        parts = [corner for corner in np.ndindex(5, 5) if alike(state, window_at(picture, corner))]
        assert len(parts) == 1
        corners.add(parts[0])
    assert len(corners) > 15


def window_at(picture: NDArray[np.uint8], corner: tuple[int, ...]) -> NDArray[np.uint8]:
    """The window of 24x32 pixels with this corner."""
    row, column = corner
    return picture[row : row + 24, column : column + 32]


def alike(first: NDArray[Any], second: NDArray[Any]) -> bool:
    """Whether two pictures have the same shades up to an increasing map."""
    return bool((np.unique(first, return_inverse=True)[1] == np.unique(second, return_inverse=True)[1]).all())


def test_shade_maps_rise() -> None:
    """256 shades to 0..1, each brighter than the one before, every map another."""
    maps = one_room.shade_maps(50, np.random.default_rng(0))
    assert maps.shape == (50, 256)
    assert maps.dtype == np.float32
    assert (np.diff(maps, axis=1) > 0).all()
    assert maps.min() >= 0
    assert maps.max() <= 1
    assert (np.ptp(maps[:, [0, 128, 255]], axis=0) > (0.1, 0.3, 0.1)).all()


def test_other_surroundings_leave_the_agent_alone() -> None:
    """Around the middle nothing changes, in no frame; of the rest a side or all, in most states."""
    images = np.random.default_rng(0).integers(200, 256, size=(400, 30, 38, 4), dtype=np.uint8)
    before = images.copy()
    changed = one_room.other_surroundings(images, np.random.default_rng(1))
    np.testing.assert_array_equal(images, before)
    np.testing.assert_array_equal(changed[:, 15 - 4 : 15 + 7, 19 - 4 : 19 + 4], images[:, 11:22, 15:23])
    differ = (changed != images).any(3)
    touched = differ.any((1, 2))
    assert 0.6 < touched.mean() < 0.8
    corners = differ[touched][:, [0, 0, -1, -1], [0, -1, 0, -1]]
    everywhere, left, right, below = (1, 1, 1, 1), (1, 0, 1, 0), (0, 1, 0, 1), (0, 0, 1, 1)
    assert {everywhere, left, right, below} <= {tuple(row) for row in corners.astype(int).tolist()}
    assert differ[touched].mean() > 0.3
    new = changed[touched][:, 0, 0][differ[touched][:, 0, 0]]
    assert (new == new[:, :1]).all()  # alike in all frames


def test_half_of_the_labelled_positives() -> None:
    """Whatever negatives and unlabelled states look like."""
    labelled = np.array([[0.2, 1.0], [0.9, 1.0], [0.5, 1.0], [0.7, 0.1], [0.99, 0.99]], np.float32)
    labels = np.array([True, True, True, True, False])
    found = one_room.median(labelled, labels, np.zeros((0, 2), np.float32))
    np.testing.assert_allclose(found, [0.6, 1.0])


# Finding the agent.


def square_states(count: int, seed: int) -> tuple[NDArray[np.uint8], NDArray[np.int64], NDArray[np.int64]]:
    """48x48: an agent of two shades, which moves down, up or stays as its action says; others of one shade each move
    anyhow; a wall. States, the agent's first row and column in the last frame, and the last two actions.
    """
    rng = np.random.default_rng(seed)
    states = np.zeros((count, 48, 48, 4), dtype=np.uint8)
    states[:, 40:] = rng.integers(20, 120, size=(count, 1, 1, 1))
    actions = rng.integers(3, size=(count, 2))
    corners = np.empty((count, 2), dtype=np.int64)
    for state, corner, action in zip(states, corners, actions, strict=True):
        for thing in range(4):
            at, speed = rng.integers(6, 36, size=2), rng.integers(-2, 3, size=2)
            for frame in range(4):
                down, right = speed * (frame - 3)
                if thing == 3:
                    down, right = -2 * (action - 1)[: max(3 - frame, 0)].sum(), 0
                top, left = max(at[0] + down, 0), max(at[1] + right, 0)
                state[top : top + 6, left : left + 4, frame] = 90 + 50 * thing if thing < 3 else 120
                if thing == 3:
                    state[top + 2 : top + 4, left : left + 4, frame] = 250
            corner[:] = at
    return states, corners, actions


def middle_of(positions: NDArray[np.int64]) -> NDArray[np.float64]:
    """The middle of the square whose first column and row are the last two positions."""
    return positions[:, :0:-1] + np.array([2.5, 1.5])


def test_the_agent_is_found_among_things_that_move_as_it_does(monkeypatch: pytest.MonkeyPatch) -> None:
    """In states never seen; the same bytes again."""
    monkeypatch.setattr(one_room, "observed_pixel", middle_of)
    states, corners, _ = square_states(200, seed=0)
    unlabelled, _, actions = square_states(100, seed=1)
    others, wanted, _ = square_states(100, seed=2)
    still = np.zeros(200, dtype=np.int64)
    labelled = {"room": still, "x": corners[:, 1], "y": corners[:, 0], "dying": still}
    origins = StateOrigins(labelled, {"action": actions[:, 0], "previous_action": actions[:, 1]})

    def trained(steps: int) -> AgentView:
        view = AgentView((48, 48, 4), AgentViewSettings(localiser_steps=steps))
        view.fit(states, unlabelled, origins, 3)
        return view

    def near(view: AgentView) -> float:
        errors = np.abs(view.locate(others) - wanted - np.array([2.5, 1.5]))
        return float((errors.max(axis=1) <= 4).mean())

    untrained = trained(1)
    assert near(trained(100)) > 0.9
    assert near(untrained) < 0.3
    again = trained(1).state_dict()
    assert all(torch.equal(value, again[name]) for name, value in untrained.state_dict().items())


def test_actions_alone_tell_where_the_agent_is() -> None:
    """A heat-map on the agent makes its actions likelier than one on anything else."""
    _, corners, actions = square_states(50, seed=0)
    cells = np.floor((corners + np.array([3.0, 2.0])) / 4).astype(int)
    guesses, heat = torch.zeros(50, 6, 12, 12), torch.zeros(50, 12, 12)
    for state, (row, column) in enumerate(cells):
        for which in range(2):
            guesses[state, 3 * which + actions[state, which], row, column] = 5.0
        heat[state, row, column] = 20.0
    right = one_room.action_loss(heat, guesses, torch.from_numpy(actions))
    wrong = one_room.action_loss(heat.roll(3, dims=1), guesses, torch.from_numpy(actions))
    assert right.item() == pytest.approx(-2 * np.log(np.exp(5) / (np.exp(5) + 2)), rel=1e-3)
    assert wrong.item() == pytest.approx(2 * np.log(3), rel=1e-3)


def test_what_is_made_up_leaves_the_agent_alone() -> None:
    """Of changed states the agent's pixels are as they were, mirrored perhaps, where the changed place says."""
    states, corners, _ = square_states(40, seed=0)
    changed, moved = one_room.cluttered(states, corners + np.array([2.5, 1.5]), np.random.default_rng(0))
    inside = ((moved > 4) & (moved < 43)).all(axis=1)
    assert inside.sum() > 5
    for image, place in zip(changed[inside], moved[inside], strict=True):
        top, left = np.round(place - (2.5, 1.5)).astype(int)
        bright, dark = image[top + 2 : top + 4, left : left + 4, 3], image[top : top + 2, left : left + 4, 3]
        assert np.ptp(bright) == np.ptp(dark) == 0
        assert bright[0, 0] > dark[0, 0]
    assert ((changed > 0).mean(axis=(1, 2, 3)) > 0.5).any()


# Through the stages.


def made_up(count: int, seed: int) -> tuple[NDArray[np.uint8], NDArray[np.bool_], Origins]:
    """States of which the agent's surroundings say the label, with the origins that Montezuma's have."""
    rng = np.random.default_rng(seed)
    labels = np.arange(count) % 3 == 0
    origins = {
        "room": np.ones(count, dtype=np.int64),
        "x": rng.integers(40, 110, size=count),
        "y": rng.integers(160, 220, size=count),
        "dying": np.zeros(count, dtype=np.int64),
        "ladder": np.where(labels, np.arange(count) // 3 % 2, -1),
        "action": np.arange(count) % 18,
        "previous_action": np.arange(count) % 18,
    }
    observations = rng.integers(60, size=(count, *SHAPE), dtype=np.uint8)
    positions = np.stack([origins[name] for name in ("room", "x", "y")], axis=1)
    middles = np.round(observed_pixel(positions)).astype(int)
    for observation, (row, column), label in zip(observations, middles, labels, strict=True):
        observation[row - 4 : row + 4, column - 2 : column + 2] = 200
        observation[row + 6 : row + 9, column - 8 : column + 8] = 250 if label else 100
    return observations, labels, origins


def write_made_up(path: Path) -> Path:
    """A data file of such states."""
    sets = []
    for seed, count in enumerate((60, 40, 30)):
        observations, labels, origins = made_up(count, seed)
        sets.append(States(observations, labels[:, None], origins))
    write_dataset(path, Collected(SHAPE, ("base",), *sets), domain="montezuma", config={}, seed=0)
    return path


def few(*more: str) -> list[str]:
    """Settings of a short training."""
    pairs = (*OWN, "view.localiser_steps=2", "steps=12", "members=2", "batch_size=16", "workers=1", *more)
    return [word for pair in pairs for word in ("--set", pair)]


def test_a_broken_training_ends_with_the_same_bytes(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Spec G1: broken off between two steps of the members; the localiser is not trained again."""
    words = ["train-ensemble", str(write_made_up(tmp_path / "data.h5")), *few(), "-q", "--out"]
    assert main([*words, str(tmp_path / "whole")]) == 0
    offered: list[Checkpoints] = []

    def offer(checkpoints: Checkpoints, state: Callable[[], State]) -> None:
        offered.append(checkpoints)
        if len(offered) == 5:
            checkpoints.save(state())
        if len(offered) == 8:
            raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr(Checkpoints, "offer", offer)
        assert main([*words, str(tmp_path / "broken")]) == 130
    with monkeypatch.context() as patch:
        patch.delattr(AgentView, "fit")
        assert main([*words, str(tmp_path / "broken"), "--resume"]) == 0
    for name in ("base.safetensors", "metrics.jsonl"):
        assert (tmp_path / "whole" / name).read_bytes() == (tmp_path / "broken" / name).read_bytes()


def test_what_is_saved_is_what_was_trained(tmp_path: Path) -> None:
    """Spec A8: the localiser's weights lie beside the members', its settings in the manifest; code needs trust."""
    data = write_made_up(tmp_path / "data.h5")
    assert main(["train-ensemble", str(data), *few("view.jitter=1"), "-q", "--out", str(tmp_path / "ensemble")]) == 0
    artefact = open_artefact(tmp_path / "ensemble")
    assert artefact.config["view_settings"] == ["localiser_steps=2", "jitter=1"]
    back = read_ensemble(artefact.path, artefact.config, "base")
    dataset = open_dataset(data)
    split, origins = dataset.labelled("base"), dataset.unlabelled_states().origins
    config = resolve(EnsembleConfig, known(EnsembleConfig, artefact.config), stage="train-ensemble")
    seed = seed_for(0, "ensemble", "base")
    direct = train(
        split.observations,
        split.labels,
        dataset.unlabelled(),
        config,
        seed,
        origins=StateOrigins(split.origins, origins),
    )
    for name, value in direct.state().items():
        assert torch.equal(value, back.state()[name]), name
    positives = direct.predict(split.observations[split.labels])
    np.testing.assert_allclose(back.thresholds.numpy(), np.median(positives, axis=0), atol=1e-6)


@pytest.mark.parametrize(
    ("words", "line"),
    [
        (["--set", "view.jiter=1"], "one_room:AgentView has no setting: jiter. Did you mean 'jitter'"),
        (["--set", "view.jitter=21"], "value not allowed: jitter='21' in one_room:AgentView. Allowed: 0 .. 20"),
    ],
)
def test_wrong_settings_are_one_line(
    words: list[str], line: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Spec G2: before anything is trained."""
    data = write_made_up(tmp_path / "data.h5")
    assert main(["train-ensemble", str(data), *few(), *words, "-q", "--out", str(tmp_path / "ensemble")]) == 2
    assert line in capsys.readouterr().err
    assert not (tmp_path / "ensemble").exists()


def test_data_that_do_not_say_enough_are_one_line() -> None:
    """Spec G2: where the agent is, and which ladder's base a positive is."""
    observations, labels, origins = made_up(12, seed=0)
    view = {"view": "one_room:AgentView", "view_settings": ("localiser_steps=1",), "network": "one_room:network"}
    config = EnsembleConfig(members=2, steps=1, **view)
    for missing in ("y", "ladder"):
        some = {name: values for name, values in origins.items() if name != missing}
        with pytest.raises(UserError, match=f"the data do not say {missing} of each state"):
            train(observations, labels, observations, config, 0, origins=StateOrigins(some, origins))


@pytest.mark.atari
@pytest.mark.slow
def test_bases_are_recognised_in_rooms_without_labels(tmp_path: Path) -> None:
    """The claim, in small: the agent is found there, and what is around it says more than the whole picture."""
    data = tmp_path / "data.h5"
    counts = ("states_per_room=150", "unlabelled_per_room=120", "heldout_per_room=12", "workers=1")
    assert main(["collect", "montezuma", "--out", str(data), "-q", *(w for c in counts for w in ("--set", c))]) == 0
    dataset = open_dataset(data)
    (goal,) = dataset.sub_goals
    split, unlabelled, heldout = dataset.labelled(goal), dataset.unlabelled(), dataset.heldout(goal)
    origins = StateOrigins(split.origins, dataset.unlabelled_states().origins)
    unseen = heldout.where(heldout.origins["seen"] == 0)

    def trained(**settings: object) -> tuple[object, float]:
        config = EnsembleConfig(members=2, **settings)  # type: ignore[arg-type]
        ensemble = train(split.observations, split.labels, unlabelled, config, 0, origins=origins)
        return ensemble.view, float(ranking(ensemble.predict(unseen.observations), unseen.labels).mean())

    window = {"view": "one_room:AgentView", "network": "one_room:network", "view_settings": ("localiser_steps=70",)}
    view, of_windows = trained(steps=60, **window)
    _, of_pictures = trained(steps=60, network="montezuma")
    positions = np.stack([unseen.origins[name] for name in ("room", "x", "y")], axis=1)
    errors = np.abs(view.locate(unseen.observations) - observed_pixel(positions)).max(axis=1)  # type: ignore[attr-defined]
    assert np.median(errors) < 4
    assert of_windows > of_pictures + 0.1


# Patience.

LOG_ODDS = np.array([[3.0, -1.0], [2.0, 0.0], [1.0, 1.0], [0.0, 2.0], [-1.0, 3.0], [-2.0, 4.0]], dtype=np.float32)


def by_table(ids: NDArray[np.int64]) -> NDArray[np.float32]:
    return LOG_ODDS[ids]


def patient(thresholds: tuple[float, float], length: int, environments: int = 1) -> Patience:
    rule = Patience(by_table, 2, None, np.array(thresholds, dtype=np.float32), environments)
    rule.steps = length
    return rule


def execution(rule: Terminations, option: int, states: tuple[int, ...]) -> list[bool]:
    """What is said at each state, and that the execution ends with the last."""
    options, said = np.array([option]), []
    for age, state in enumerate(states):
        said.append(bool(rule.reached(LOG_ODDS[[state], options], options, np.array([age]))[0]))
    rule.finished(np.array([0]), options, np.array([said[-1]]))
    return said


def test_a_threshold_falls_to_three_quarters_of_the_best_that_was_seen() -> None:
    rule = patient((10.0, 5.0), 4)
    assert execution(rule, 1, (3, 4)) == [False, False]
    assert rule.thresholds.tolist() == [10, 5]  # two steps of four
    execution(rule, 1, (5, 4))
    assert rule.thresholds.tolist() == [10, 3]  # 3/4 of 4; the other option has had no time
    assert execution(rule, 1, (3, 4, 5)) == [False, False, True]


def test_a_threshold_falls_to_half_of_the_first_at_most_and_never_rises() -> None:
    rule = patient((4.0, 2.0), 2)
    for _ in range(3):
        execution(rule, 0, (2, 3))  # 3/4 of 1
    assert rule.thresholds[0] == 2
    execution(rule, 1, (1, 2))
    execution(rule, 1, (5, 2))  # ends in time after a state that is as sure as can be
    assert rule.thresholds[1] == 1
    unsure = patient((-3.0, 0.0), 1)
    unsure.finished(np.array([0]), np.array([0]), np.array([False]))
    for option in (0, 1):
        execution(unsure, option, (5, 5) if option == 0 else (0, 0))
    assert unsure.thresholds.tolist() == [-3, 0]


def test_an_option_that_gets_there_keeps_its_threshold() -> None:
    """One execution of twenty is enough, fewer are not; counters begin anew with each window."""
    for reaches, expected in ((1, 3.0), (0, 2.25)):
        rule = patient((0.0, 3.0), 20)
        for number in range(20):
            execution(rule, 1, (5,) if number < reaches else (4,))
        assert rule.thresholds[1] == expected
    rule = patient((0.0, 3.0), 2)
    execution(rule, 1, (4, 5))  # reaches
    execution(rule, 1, (4, 4))  # does not, nor does any other of its window
    assert rule.thresholds[1] == 2.25


def test_an_option_is_given_as_many_steps_of_its_own() -> None:
    """Steps of other options do not use up its window."""
    rule = patient((10.0, 5.0), 4)
    execution(rule, 0, (0, 1))
    execution(rule, 1, (1, 2, 3, 3))
    assert rule.thresholds.tolist() == [10, 2.5]


def test_patience_goes_on_where_it_was() -> None:
    """Spec G1: in the middle of an execution and of a window."""
    rng = np.random.default_rng(0)
    steps = [(rng.integers(LENGTH - 1, size=3), rng.integers(2, size=3), rng.random(3) < 0.3) for _ in range(60)]
    whole, begun, resumed = (patient((4.0, 5.0), 7, 3) for _ in range(3))

    def play(rule: Patience, part: list[tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.bool_]]]) -> None:
        for states, options, ends in part:
            said = rule.reached(LOG_ODDS[states, options], options, np.where(ends, 0, 1))
            rule.finished(np.flatnonzero(ends), options[ends], said[ends])

    play(whole, steps)
    play(begun, steps[:25])
    resumed.restore(begun.snapshot())
    play(resumed, steps[25:])
    np.testing.assert_array_equal(resumed.thresholds, whole.thresholds)
    assert (whole.thresholds < [4, 5]).all()


def loop_of(rule: Terminations, environments: int) -> OptionLoop:
    engine = Corridor(environments)
    config = OptionConfig.of(
        experience="own",
        mask_reached=False,
        environments=environments,
        warm_up=50,
        update_interval=4,
        option_batch=32,
        epsilon_steps=300,
    )
    policies = LightLearner(engine, rule, config, seed=0)
    return OptionLoop(engine, rule, policies, RandomChooser(np.random.default_rng(0)), Recorder(2, engine), config, 1.0)


def test_options_are_learned_that_were_out_of_reach() -> None:
    """No state is sure enough; with patience the threshold falls, and what the replay holds is judged by it."""
    loop = loop_of(patient((3.5, 5.0), 150, 4), 4)
    for _ in range(400):
        loop.step()
    last = [row for rows in loop.recorder.executions for row in list(rows)[-20:]]
    assert np.mean([row.reached for row in last]) > 0.9
    assert loop.terminations.thresholds.tolist() == [2.25, 3.0]
    ends = {
        option: {row.states[-1] for row in list(rows)[-20:] if row.reached}
        for option, rows in enumerate(loop.recorder.executions)
    }
    assert ends == {0: {0}, 1: {5}}
