"""What members see: windows around the agent, and where a localiser says that it is (beyond the paper; Spec B4, C5)."""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np
import pytest
import torch
from numpy.typing import NDArray

from hypogoal.core.errors import UserError
from hypogoal.core.seeding import torch_generator
from hypogoal.domains.montezuma_emulator import observed_pixel
from hypogoal.hypotheses.config import EnsembleConfig
from hypogoal.hypotheses.ensemble import Ensemble
from hypogoal.hypotheses.localisers import (
    LearnedLocaliser,
    RamLocaliser,
    _action_loss,
    _changed,
    _held,
    fit_localiser,
)
from hypogoal.hypotheses.networks import as_input
from hypogoal.hypotheses.stacked import StackedMembers
from hypogoal.hypotheses.training import fit
from hypogoal.hypotheses.views import AgentView, FullView, StateOrigins, cut_windows

SHAPE = (84, 84, 4)


def numbered(count: int = 1) -> NDArray[np.uint8]:
    """Images 6x7 of two frames whose pixels say row and column in the first, and their sum in the second."""
    rows, columns = np.mgrid[:6, :7]
    return np.repeat(np.stack([10 * rows + columns, rows + columns], axis=-1)[None], count, axis=0).astype(np.uint8)


def test_a_window_by_hand() -> None:
    """The pixel in the middle of an odd window is the agent's; of an even one it is the one after the middle."""
    odd = cut_windows(numbered(), np.array([[2.0, 3.0]]), 3, 3)
    np.testing.assert_array_equal(odd[0, :, :, 0], [[12, 13, 14], [22, 23, 24], [32, 33, 34]])
    even = cut_windows(numbered(), np.array([[2.4, 3.4]]), 2, 4)
    np.testing.assert_array_equal(even[0, :, :, 0], [[11, 12, 13, 14], [21, 22, 23, 24]])
    np.testing.assert_array_equal(even[0, :, :, 1], [[2, 3, 4, 5], [3, 4, 5, 6]])


def test_outside_the_image_is_black() -> None:
    """At two corners, and somewhere else altogether; each state has its own window."""
    found = cut_windows(numbered(3), np.array([[0.0, 0.0], [5.0, 6.0], [-90.0, 400.0]]), 3, 3)[..., 1]
    np.testing.assert_array_equal(found[0], [[0, 0, 0], [0, 0, 1], [0, 1, 2]])
    np.testing.assert_array_equal(found[1], [[9, 10, 0], [10, 11, 0], [0, 0, 0]])
    assert not found[2].any()


def ensemble_of(view: FullView | AgentView, members: int = 2, seed: int = 0) -> Ensemble:
    """Fresh members of a crop network."""
    return Ensemble("montezuma-crop", SHAPE, members, torch_generator(seed, "weights"), view).eval()


def observations_of(count: int, seed: int = 0) -> NDArray[np.uint8]:
    """Noise."""
    return np.random.default_rng(seed).integers(256, size=(count, *SHAPE), dtype=np.uint8)


def test_members_see_the_window() -> None:
    """Spec C5: predictions are those of the members on windows cut out by hand, in chunks as in one."""
    ensemble = ensemble_of(AgentView(SHAPE, 24, 32, RamLocaliser(observed_pixel)))
    observations = observations_of(70)
    positions = np.tile([[1, 77, 235]], (70, 1))
    row, column = np.floor(observed_pixel(positions[:1])[0] + 0.5).astype(int)
    cut = observations[:, row - 12 : row + 12, column - 16 : column + 16]
    assert cut.shape[1:] == (24, 32, 4)
    np.testing.assert_array_equal(ensemble.see(observations, positions), cut)
    with torch.no_grad():
        inputs = as_input(torch.from_numpy(cut))
        expected = [member(inputs).softmax(dim=-1)[:, 1].numpy() for member in ensemble.members]
    np.testing.assert_allclose(ensemble.predict(observations, positions), np.stack(expected, axis=1), atol=2e-6)


def test_an_oracle_asks_for_positions() -> None:
    """Spec G2: of a localiser that reads the game's memory nobody gets a prediction without it, or for another game."""
    ensemble = ensemble_of(AgentView(SHAPE, 24, 32, RamLocaliser(observed_pixel)))
    assert ensemble.needs_positions
    with pytest.raises(UserError, match="localiser=ram: it needs the agent's positions: none"):
        ensemble.log_odds(observations_of(2))
    with pytest.raises(UserError, match=r"int64 \(3, 3\)"):
        ensemble.log_odds(observations_of(2), np.zeros((3, 3), dtype=np.int64))


@pytest.mark.parametrize("localisers", ["ram", "learned"])
def test_stacked_members_of_several_views(localisers: str) -> None:
    """Spec D1: each ensemble sees with its own localiser, also where all members are one network."""
    ensembles = []
    for seed in range(2):
        torch.manual_seed(seed)  # for the localiser's weights
        localiser = RamLocaliser(observed_pixel) if localisers == "ram" else LearnedLocaliser(SHAPE)
        ensembles.append(ensemble_of(AgentView(SHAPE, 24, 32, localiser), seed=seed))
    observations, positions = observations_of(5), np.array([[1, 20 * x, 235] for x in range(1, 6)])
    stacked = StackedMembers(ensembles)
    assert stacked.needs_positions == (localisers == "ram")
    expected = np.concatenate([ensemble.log_odds(observations, positions) for ensemble in ensembles], axis=1)
    np.testing.assert_allclose(stacked.log_odds(observations, positions), expected, atol=1e-5)
    assert np.ptp(expected) > 1e-3


def square_states(count: int, seed: int) -> tuple[NDArray[np.uint8], NDArray[np.float64], NDArray[np.int64]]:
    """48x48: an agent of two shades, which moves down, up or stays as its action says; others of one shade each move
    anyhow; a wall. States, places, and the last two actions.
    """
    rng = np.random.default_rng(seed)
    states = np.zeros((count, 48, 48, 4), dtype=np.uint8)
    states[:, 40:] = rng.integers(20, 120, size=(count, 1, 1, 1))
    actions = rng.integers(3, size=(count, 2))
    places = np.empty((count, 2))
    for state, place, action in zip(states, places, actions, strict=True):
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
            place[:] = at + np.array([2.5, 1.5])
    return states, places, actions


def test_a_localiser_learns_a_toy() -> None:
    """Beyond the paper: the agent among things that move as it does, in states never seen; the same bytes again."""
    states, places, _ = square_states(200, seed=0)
    unlabelled, _, actions = square_states(100, seed=1)
    others, wanted, _ = square_states(100, seed=2)
    localiser = fit_localiser(states, places, unlabelled, actions, seed=3, steps=100)
    untrained = fit_localiser(states, places, unlabelled, actions, seed=3, steps=1)
    assert (np.abs(localiser.locate(others) - wanted).max(axis=1) <= 4).mean() > 0.9
    assert (np.abs(untrained.locate(others) - wanted).max(axis=1) <= 4).mean() < 0.3
    again = fit_localiser(states, places, unlabelled, actions, seed=3, steps=1).state_dict()
    assert all(torch.equal(value, again[name]) for name, value in untrained.state_dict().items())


def test_actions_alone_tell_where_the_agent_is() -> None:
    """Beyond the paper: a heat-map on the agent makes its actions likelier than one on anything else."""
    _, places, actions = square_states(50, seed=0)
    cells = np.floor((places + 0.5) / 4).astype(int)
    guesses, heat = torch.zeros(50, 6, 12, 12), torch.zeros(50, 12, 12)
    for state, (row, column) in enumerate(cells):
        for which in range(2):
            guesses[state, 3 * which + actions[state, which], row, column] = 5.0
        heat[state, row, column] = 20.0
    right = _action_loss(heat, guesses, torch.from_numpy(actions))
    wrong = _action_loss(heat.roll(3, dims=1), guesses, torch.from_numpy(actions))
    assert right.item() == pytest.approx(-2 * np.log(np.exp(5) / (np.exp(5) + 2)), rel=1e-3)
    assert wrong.item() == pytest.approx(2 * np.log(3), rel=1e-3)


def test_some_labelled_states_stand_still() -> None:
    """Beyond the paper: an agent on a ladder does not move, so the localiser must not need its motion."""
    states = np.random.default_rng(0).integers(256, size=(400, 6, 6, 4), dtype=np.uint8)
    shown = _held(states.copy(), np.random.default_rng(1))
    still = (shown == states[..., -1:]).all((1, 2, 3))
    assert 0.3 < still.mean() < 0.4
    np.testing.assert_array_equal(shown[~still], states[~still])


def test_what_is_made_up_leaves_the_agent_alone() -> None:
    """Of changed states the agent's pixels are as they were, mirrored perhaps, where the changed place says."""
    states, places, _ = square_states(40, seed=0)
    changed, moved = _changed(states, places, np.random.default_rng(0))
    inside = ((moved > 4) & (moved < 43)).all(axis=1)
    assert inside.sum() > 5
    for image, place in zip(changed[inside], moved[inside], strict=True):
        top, left = np.round(place - (2.5, 1.5)).astype(int)
        bright, dark = image[top + 2 : top + 4, left : left + 4, 3], image[top : top + 2, left : left + 4, 3]
        assert np.ptp(bright) == np.ptp(dark) == 0
        assert bright[0, 0] > dark[0, 0]
    assert ((changed > 0).mean(axis=(1, 2, 3)) > 0.5).any()


@pytest.mark.atari
def test_positions_are_where_the_emulator_draws_the_agent() -> None:
    """Spec B4: two observations that differ by where the agent stands differ around both places that its RAM says."""
    from hypogoal.domains.montezuma_emulator import Emulator

    emulator = Emulator()
    for room, y, places in ((1, 235, (60, 90)), (1, 192, (60, 90)), (1, 148, (21, 133)), (9, 235, (60, 90))):
        frames, positions = [], []
        for x in places:
            assert emulator.place(room, x, y) is not None
            frames.append(emulator.stack[:, :, 3].astype(int))
            positions.append(emulator.position())
        differ = np.abs(frames[0] - frames[1]) > 15
        for where in observed_pixel(np.array(positions)):
            top, left = np.floor(where - (8, 6)).astype(int)
            rows, columns = np.nonzero(differ[top : top + 17, left : left + 13])
            middle = np.array([rows.min() + rows.max(), columns.min() + columns.max()]) / 2 + (top, left)
            assert np.abs(middle - where).max() <= 1.5


def montezuma_states(
    count: int, seed: int
) -> tuple[NDArray[np.uint8], NDArray[np.bool_], dict[str, NDArray[np.int64]]]:
    """Made-up states of which the agent's surroundings say the label, with the origins that Montezuma's have."""
    rng = np.random.default_rng(seed)
    labels = np.arange(count) % 3 == 0
    origins = {
        "room": np.ones(count, dtype=np.int64),
        "x": rng.integers(40, 110, size=count),
        "y": rng.integers(160, 220, size=count),
        "ladder": np.where(labels, np.arange(count) // 3 % 2, -1),
    }
    observations = rng.integers(60, size=(count, *SHAPE), dtype=np.uint8)
    middles = np.round(observed_pixel(np.stack([origins[name] for name in ("room", "x", "y")], axis=1))).astype(int)
    for observation, (row, column), label in zip(observations, middles, labels, strict=True):
        observation[row - 4 : row + 4, column - 2 : column + 2] = 200
        observation[row + 6 : row + 9, column - 8 : column + 8] = 250 if label else 100
    return observations, labels, origins


CROP = EnsembleConfig(
    members=2,
    network="montezuma-crop",
    view="agent-crop",
    localiser="ram",
    batch_size=16,
    steps=25,
    learning_rate=2e-3,
    batch_kind="per-ladder",
)


def fit_crop(observations: Any, labels: Any, unlabelled: Any, *origins: Any) -> Ensemble:
    """An ensemble of windows, with the origins of labelled and unlabelled states."""
    places = StateOrigins(*origins, agent_pixels=observed_pixel)
    return fit(observations, labels, unlabelled, CROP, 0, origins=places)


def test_an_ensemble_learns_from_windows() -> None:
    """Beyond the paper: what surrounds the agent decides, wherever it is."""
    observations, labels, origins = montezuma_states(60, seed=0)
    others, truth, there = montezuma_states(60, seed=1)
    ensemble = fit_crop(observations, labels, others, origins, there)
    positions = np.stack([there[name] for name in ("room", "x", "y")], axis=1)
    assert (ensemble.predictions(others, positions) == truth[:, None]).mean() > 0.95


def test_data_that_do_not_say_enough_are_one_clear_line() -> None:
    """Spec G2: what a setting needs to know of the states and the data do not say."""
    observations, labels, origins = montezuma_states(12, seed=0)
    some = {name: origins[name] for name in ("room", "x", "ladder")}
    with pytest.raises(UserError, match=r"do not say y of each state: view=agent-crop"):
        fit_crop(observations, labels, observations, some, origins)
    with pytest.raises(UserError, match=r"do not say room, x, y of each state: localiser=ram"):
        fit_crop(observations, labels, observations, origins)
    with pytest.raises(UserError, match="the agent's place in these observations is not known: view=agent-crop"):
        fit(observations, labels, observations, CROP, 0, origins=StateOrigins(origins))
    with pytest.raises(UserError, match="the surroundings of the agent are not known: augment=grey-context"):
        fit(observations, labels, observations, dataclasses.replace(CROP, view="full", augment="grey-context"), 0)
    plain = dataclasses.replace(CROP, view="full")
    with pytest.raises(UserError, match=r"do not say ladder of each state: batch_kind=per-ladder"):
        fit(observations, labels, observations, plain, 0)
