"""Films of an agent's episode, and sheets of collected states: what is drawn (Spec A1, B5, D1, D6, E1, F7)."""

from __future__ import annotations

import io
from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
from corridor import Corridor
from option_loops import Chosen, Scripted, loop_of
from PIL import Image

from hypogoal.core.artefacts import open_artefact
from hypogoal.core.errors import UserError
from hypogoal.data import Collected, States, write_dataset
from hypogoal.films import agent_to_film, draw_frame, episode_gif, films_of, frame_lines, keep_film, kept_films
from hypogoal.hypotheses.ensemble import read_ensemble
from hypogoal.meta.episodes import Frame, agent_of, play_episode
from hypogoal.tools.sheets import COLUMNS, GAP, MOST_STATES, sheet, sheets, write_sheets

CAP, TIMEOUT, MEMBERS = 64, 10, 2


@pytest.fixture(scope="module")
def frames(tiny_run):
    played = [play_episode(agent_of(open_artefact(tiny_run / "meta"), seed=3), MEMBERS) for _ in range(2)]
    for first, second in zip(*played, strict=True):
        assert (first.option, first.step, first.ended) == (second.option, second.step, second.ended)
    return played[0]


def test_an_episode_is_whole(frames):
    """Spec D1: every step once, from 0 to the cap or the goal; each execution's time runs down by one a step."""
    running = [frame for frame in frames if not frame.ended]
    assert [frame.step for frame in running] == list(range(len(running)))
    assert frames[-1].ended and frames[-1].step == len(running) <= CAP
    for before, after in pairwise(frames):
        if before.ended:
            assert after.left == TIMEOUT
            assert after.step == before.step
            np.testing.assert_array_equal(after.observation, before.observation)
        else:
            assert (after.left, after.option, after.step) == (before.left - 1, before.option, before.step + 1)
    for frame in frames:
        if frame.ended == "its time is up":
            assert frame.left == 0 and not frame.predictions[frame.option % MEMBERS]
        if frame.ended == "its classifier is positive":
            assert frame.predictions[frame.option % MEMBERS]


def test_predictions_are_those_of_the_sub_goals_members(tiny_run, frames):
    """Spec D1, D6: recomputed here from the pictures and the weights."""
    source = open_artefact(tiny_run / "ensemble")
    for goal in {frame.option // MEMBERS for frame in frames}:
        alike = [frame for frame in frames if frame.option // MEMBERS == goal]
        ensemble = read_ensemble(source.path, source.config, source.config["sub_goals"][goal])
        says = ensemble.predictions(np.stack([frame.observation for frame in alike]))
        assert says.tolist() == [list(frame.predictions) for frame in alike]


def test_videos_are_of_the_agents_that_choose(tiny_run):
    """Spec E1, F7: of the one that learned to choose, not of the random chooser; a frame for each of the episode's."""
    agent = agent_to_film(tiny_run)
    assert agent.path.name == "meta"
    films = films_of(agent, "agents/meta", 2)
    assert [film.name for film in films] == ["agents-meta-episode-0.gif", "agents-meta-episode-1.gif"]
    with Image.open(io.BytesIO(films[0].gif)) as video:
        assert video.format == "GIF"
        assert 2 < video.n_frames <= 2 * CAP + 1
        assert video.size[0] == 320


def test_the_film_of_a_page_is_one_in_which_members_differ(tiny_run, tmp_path, monkeypatch):
    """Spec E1, F7: the first of a few that the right one of two members solves; where there is none, the first."""
    from hypogoal.meta import episodes

    frame = Frame(np.zeros((8, 8, 3), np.uint8), 0, 0, (True, True), 5, "solved")
    differ = replace(frame, predictions=(True, False))
    wrong = [replace(frame, ended="the episode, unsolved"), replace(frame, predictions=(False, True))]
    plays = [[frame], *([differ, last] for last in wrong), [differ, frame], [frame]]
    monkeypatch.setattr(episodes, "play_episode", lambda loop, members: plays.pop(0))
    (film,) = kept_films(tmp_path, keep_film(tiny_run, tmp_path))
    assert film.name == "meta-episode-3.gif" and len(plays) == 1
    monkeypatch.setattr(episodes, "play_episode", lambda loop, members: [frame])
    (film,) = kept_films(tmp_path, keep_film(tiny_run, tmp_path))
    assert film.name == "meta-episode-0.gif"


def test_what_is_drawn_of_a_frame():
    """Spec F7: option, members and predictions in words; the bar is as long as the steps that are left."""
    stack = np.zeros((84, 84, 4), np.uint8)
    stack[..., 3] = 200
    frame = Frame(stack, 12, 3, (True, False), 5, "")
    lines = frame_lines(frame, ["red", "door"], 2)
    assert lines == ["option: door", "  member 0: reached", "> member 1: not reached", "step 12"]
    picture = np.asarray(draw_frame(frame, ["red", "door"], 2, timeout=10))
    assert picture.shape[1] == 336 and (picture[:336] == 200).all()
    bar = picture[336]
    assert (bar[:168] == bar[0]).all() and (bar[170:] == bar[-1]).all() and (bar[0] != bar[-1]).any()
    video = Image.open(io.BytesIO(episode_gif([frame, replace(frame, left=0, ended="x")], ["red", "door"], 2, 10)))
    assert video.n_frames == 2


@pytest.mark.parametrize(
    ("option", "action", "timeout", "cap", "why"),
    [
        (1, 1, 9, 9, "solved"),
        (0, 0, 9, 9, "its classifier is positive"),
        (1, 0, 4, 9, "its time is up"),
        (1, 0, 9, 4, "the episode is cut"),
    ],
)
def test_frames_say_why_an_option_ended(option, action, timeout, cap, why):
    """An option to the left end (0) or the right one (1), played by going left (0) or right (1) all the time."""
    loop = loop_of(Corridor(1, cap), Scripted(action), Chosen(option), option_timeout=timeout)
    first, *_ = [frame for frame in play_episode(loop, 1) if frame.ended]
    assert (first.option, first.ended) == (option, why)


SIDE = 20


def states(count: int, channels: int) -> np.ndarray:
    """Pictures of one grey level each; of stacks the last frame's is 50 above the others'."""
    pictures = np.zeros((count, SIDE, SIDE, channels), np.uint8)
    pictures[:] = np.arange(count, dtype=np.uint8)[:, None, None, None] + 60
    if channels == 4:
        pictures[..., -1] += 50
    return pictures


@pytest.mark.parametrize("channels", [1, 3, 4])
def test_a_sheet_shows_each_state(channels: int) -> None:
    """Spec B5: states in rows, the newest frame of a stack, black where there is none."""
    shown = sheet(states(COLUMNS + 3, channels))
    side = SIDE + 2 * GAP
    assert shown.shape == (2 * side, COLUMNS * side, 3)
    for index in range(2 * COLUMNS):
        top, left = index // COLUMNS * side + GAP, index % COLUMNS * side + GAP
        level = 60 + index + (50 if channels == 4 else 0) if index < COLUMNS + 3 else 0
        assert (shown[top : top + SIDE, left : left + SIDE] == level).all()


def test_sheets_are_by_room_and_label() -> None:
    """Spec B5: a sheet for each room and label that there is, with no more states than fit, spread over all."""
    count = 3 * MOST_STATES
    rooms = np.repeat([7, 7, 12], MOST_STATES)
    split = States(states(count, 1), np.arange(count) < MOST_STATES, {"room": rooms})
    drawn = dict(sheets(split))
    assert list(drawn) == ["room-07-positives", "room-07-negatives", "room-12-negatives"]
    assert len({shown.shape for shown in drawn.values()}) == 1, "each has as many as fit"
    everywhere = States(split.observations[:5], np.arange(5) < 5, {})
    assert [name for name, _ in sheets(everywhere)] == ["positives"]


def test_sheets_of_a_file(tmp_path: Path) -> None:
    """Spec A1: PNG files by split, sub-goal, room and label; one line for what is not a data file."""

    def some(count: int) -> States:
        labels = np.zeros((count, 2), np.bool_)
        labels[:2] = True
        return States(states(count, 3), labels, {"room": np.where(np.arange(count) < 3, 1, 2)})

    data = Collected((SIDE, SIDE, 3), ("one", "two"), some(5), some(1), some(6))
    write_dataset(tmp_path / "data.h5", data, domain="unknown", config={}, seed=0)
    files = write_sheets(tmp_path / "data.h5", tmp_path / "sheets")
    assert len(files) == 12
    assert files[3].relative_to(tmp_path) == Path("sheets/labelled/two/room-01-positives.png")
    assert np.array_equal(np.asarray(Image.open(files[0])), sheet(states(2, 3)))
    with pytest.raises(UserError, match="need a data file"):
        write_sheets(tmp_path, tmp_path / "sheets")
