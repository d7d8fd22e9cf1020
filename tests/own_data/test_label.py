"""States marked by hand (Spec B6): pygame's own window on its driver without a screen, keys as pygame delivers them."""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path

import gymnasium
import numpy as np
import pygame
import pytest
from keyboard import label

from hypogoal.cli import main
from hypogoal.core import own_code
from hypogoal.core.errors import UserError
from hypogoal.dataset import open_dataset
from hypogoal.domains.recorded_play import read_play
from hypogoal.own_data.images import read_images
from hypogoal.own_data.marking import GRID_KEYS, Marks, action_help, action_names, action_of, as_rgb
from hypogoal.stages.label import environment_of


@pytest.fixture(autouse=True)
def no_screen(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("SDL_VIDEODRIVER", "dummy")


def played(actions: Sequence[int], layout_seed: int) -> list[np.ndarray]:
    env = gymnasium.make("hypogoal/DoorKey-8x8-v0")
    seen = [env.reset(seed=layout_seed)[0]]
    seen += [env.step(action)[0] for action in actions]
    return seen


def test_a_domain_is_played_and_its_states_become_data(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Spec B6, B7: marks by hand and by mode, held-out ones of another layout, and ``import`` of the folder."""
    out = tmp_path / "turned"
    assert label("n right p m left left left r u", "doorkey", "--out", str(out)) == 0
    first, right, *rest = played([1, 0, 0, 0], 0)
    marks = Marks(out)
    # 'm' marks what is new negative: the first state was, then is marked unlabelled after 'r', the last word.
    assert marks.of(right) == "positive" and marks.of(first) == "unlabelled"
    assert [marks.of(state) for state in rest] == ["unlabelled", "negative", "negative"]  # rest[0] is the first again
    assert marks.counts() == {"positive": 1, "negative": 2, "unlabelled": 1}
    assert (
        label("n right p right right p backspace", "doorkey", "--out", str(out), "--heldout", "--layout-seed", "7") == 0
    )
    last = capsys.readouterr().out.splitlines()
    assert last[-3:] == ["1 positive, 1 negative", f"next: hypogoal import {out} --out {out}.h5", str(out)]
    assert main(["import", str(out), "--out", str(tmp_path / "data.h5"), "-q"]) == 0
    data = open_dataset(tmp_path / "data.h5")
    assert data.sub_goals == ("turned",)
    labelled, heldout = data.labelled("turned"), data.heldout("turned")
    np.testing.assert_array_equal(labelled.observations[labelled.labels.ravel()], right[None])
    np.testing.assert_array_equal(data.unlabelled(), first[None])
    before, after = played([1], 7)
    np.testing.assert_array_equal(heldout.observations, np.stack([after, before]))


def test_what_is_played_is_recorded(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Spec B7: each episode's layout seed and actions, in the form that ``collect --play`` reads; marks need not be."""
    record, out = tmp_path / "play.json", tmp_path / "turned"
    keys = "left up r up right x l right n e"  # x plays nothing, n marks, e picks up
    assert label(keys, "doorkey", "--out", str(out), "--record", str(record), "--layout-seed", "4") == 0
    assert [one[:2] for one in read_play(record)] == [(4, (0, 2)), (4, (2, 1)), (5, (1, 3))]
    assert Marks(out).counts()["negative"] == 1
    for source, do in (("doorkey", "--resume"), (str(out / "negative"), "--heldout")):
        other = record if do == "--resume" else tmp_path / "other.json"
        assert main(["label", source, "--out", str(out), do, "--record", str(other)]) == 2
        assert "--record needs a new file" in capsys.readouterr().err
    assert [path.name for path in tmp_path.iterdir() if path.suffix] == ["play.json"]


def test_recorded_states_are_stepped_through(tmp_path: Path) -> None:
    """Spec B6, G1: a marked state makes way for the next; every mark is on the disk; undo, resume, another mind."""
    states = np.random.default_rng(0).integers(0, 255, (5, 8, 6, 3), dtype=np.uint8)
    np.savez(tmp_path / "states.npz", unlabelled=states)
    out = tmp_path / "at-door"
    arguments = [str(tmp_path / "states.npz"), "--out", str(out)]
    assert label("p n u u u backspace", *arguments) == 0
    marks = Marks(out)
    found = [marks.of(state) for state in states]
    assert found == ["positive", "negative", "unlabelled", "unlabelled", None]
    assert main(["label", *arguments]) == 2, "it exists"
    assert label("right n", *arguments, "--resume") == 0
    assert [Marks(out).of(state) for state in states[:2]] == ["positive", "negative"]
    assert label("n n n n n", *arguments, "--resume") == 0
    again = Marks(out)
    assert {again.of(state) for state in states} == {"negative"} and again.counts()["negative"] == 5
    assert not list(out.rglob(".*"))
    with pytest.raises(UserError, match="8 x 7 x 3, those marked before 8 x 6 x 3"):
        again.mark(np.zeros((8, 7, 3), np.uint8), "positive")


def test_marks_stay_in_their_folder(tmp_path: Path) -> None:
    """Spec G2: somebody's folder of marks that is gone on with may have links in it."""
    (tmp_path / "elsewhere").mkdir()
    (tmp_path / "marks").mkdir()
    (tmp_path / "marks" / "positive").symlink_to(tmp_path / "elsewhere")
    with pytest.raises(UserError, match=r"a folder of marks leads elsewhere: .*marks/positive"):
        Marks(tmp_path / "marks").mark(np.zeros((8, 6, 3), np.uint8), "positive")
    assert not list((tmp_path / "elsewhere").iterdir())


def test_images_and_data_files_are_recorded_states_too(tmp_path: Path) -> None:
    """Spec B6: what was marked before, or imported, can be looked at again."""
    states = np.random.default_rng(1).integers(0, 255, (3, 8, 8, 1), dtype=np.uint8)
    marks = Marks(tmp_path / "one")
    for state, kind in zip(states, marks.kinds, strict=True):
        marks.mark(state, kind)
    assert read_images(tmp_path / "one").unlabelled.shape == (1, 8, 8, 1)
    assert label("n", str(tmp_path / "one" / "positive"), "--out", str(tmp_path / "two")) == 0
    assert Marks(tmp_path / "two").of(states[0]) == "negative"
    more = np.random.default_rng(2).integers(0, 255, (20, 8, 8, 1), dtype=np.uint8)
    np.savez(tmp_path / "own.npz", observations=more, labels=np.arange(20) % 2, unlabelled=states)
    assert main(["import", str(tmp_path / "own.npz"), "--out", str(tmp_path / "own.h5"), "-q"]) == 0
    assert label("right p", str(tmp_path / "own.h5"), "--out", str(tmp_path / "three")) == 0
    assert Marks(tmp_path / "three").of(states[1]) == "positive"


def test_stacks_of_frames_keep_their_channels(tmp_path: Path) -> None:
    """Spec B4, B6: four frames are no image; the file holds the array, and the picture shows the last one large."""
    states = np.random.default_rng(0).integers(0, 255, (9, 12, 10, 4), dtype=np.uint8)
    marks = Marks(tmp_path / "base")
    for number, state in enumerate(states):
        marks.mark(state, marks.kinds[number % 3])
    parts = read_images(tmp_path / "base")
    assert parts.observations.shape == (6, 12, 10, 4) and parts.unlabelled.shape == (3, 12, 10, 4)
    held = {state.tobytes() for state in [*parts.observations, *parts.unlabelled]}
    assert held == {state.tobytes() for state in states}
    picture = as_rgb(states[0])
    assert picture.shape == (36, 40, 3)
    np.testing.assert_array_equal(picture[::3, :30:3, 0], states[0, ..., 3])
    np.testing.assert_array_equal(picture[12:24, 30:, 1], states[0, ..., 1])


@pytest.mark.atari
def test_keys_are_actions() -> None:
    """Spec B6: MiniGrid's by name, Atari's by what is held together, others by number."""
    grid = action_names(gymnasium.make("hypogoal/DoorKey-8x8-v0"))
    nothing: frozenset[str] = frozenset()
    assert [action_of(grid, key, nothing) for key in ("left", "d", "up", "page up", "space")] == [0, 1, 2, 3, 5]
    assert action_of(grid, "x", nothing) is None
    atari = action_names(gymnasium.make("hypogoal/MontezumaLadder-v0"))
    assert atari[action_of(atari, "down", nothing) or 0] == "DOWN"
    assert atari[action_of(atari, "space", frozenset({"up", "left"})) or 0] == "UPLEFTFIRE"
    assert atari[action_of(atari, "return", nothing) or 0] == "NOOP" and action_of(atari, "x", nothing) is None
    numbers = ("0", "1", "2")
    assert action_of(numbers, "2", nothing) == 2 and action_of(numbers, "3", nothing) is None


def test_every_key_that_is_offered_plays_its_action() -> None:
    """Spec B6: names without a key go by their number, from 10 on by a letter; none of these is a key that marks."""
    nothing: frozenset[str] = frozenset()
    some = ("left", "right", "forward", "attack")
    assert action_help(some) == ("left or a: left, right or d: right, up or w: forward", "3: attack")
    assert action_of(some, "3", nothing) == 3 and action_of(some, "attack", nothing) is None
    twelve = tuple(map(str, range(12)))
    assert [action_of(twelve, key, nothing) for key in ("9", "b", "c", "f")] == [9, 10, 11, None]
    names = (*GRID_KEYS, *map(str, range(26)))
    told = [one.partition(": ")[::2] for line in action_help(names) for one in line.split(", ")]
    assert [name for _, name in told] == list(names)
    offered = [(key, name) for keys, name in told if keys != "no key" for key in keys.split(" or ")]
    every = {key for key, _ in offered}
    assert len(every) == len(offered) and not every & {"p", "n", "u", "m", "r", "l", "backspace", "escape"}
    pygame.display.init()
    for key, name in offered:
        assert action_of(names, key, nothing) == names.index(name)
        assert pygame.key.key_code(key), "pygame knows no such key"
    pygame.quit()


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["nowhere.h5"], "neither a file nor an environment: nowhere.h5"),
        (["CartPole-v1"], "only observations that are images"),
        (["no_such:thing"], "the environment cannot be loaded"),
        (["doorkey", "--arg", "layout"], "--arg needs KEY=VALUE: layout"),
        (["doorkey", "--arg", "colour=3"], "the environment cannot be made"),
        (["."], "no images"),
    ],
)
def test_what_cannot_be_marked_is_said_and_nothing_written(
    arguments: list[str],
    message: str,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Spec G2: one line, exit code 2."""
    monkeypatch.chdir(tmp_path)
    assert main(["label", *arguments, "--out", "marked"]) == 2
    assert message in capsys.readouterr().err and not list(tmp_path.iterdir())


@pytest.mark.atari
@pytest.mark.parametrize("source", ["ALE/Freeway-v5", "ale_py:ALE/Freeway-v5", "MiniGrid-Empty-5x5-v0"])
def test_environments_are_known_by_their_ids(source: str) -> None:
    """Spec B6: MiniGrid's and Atari's, which Gymnasium knows when their packages are loaded."""
    with own_code.given(source):
        env = environment_of(source, {})
    assert env.reset(seed=0) is not None
    env.close()


@pytest.mark.skipif(os.name != "posix", reason="elsewhere there is always a screen")
def test_without_a_screen_that_is_said(tmp_path: Path) -> None:
    """Spec G2: pygame would open a window that nobody sees."""
    hidden = ("DISPLAY", "WAYLAND_DISPLAY", "SDL_VIDEODRIVER", "XDG_RUNTIME_DIR")
    environment = {name: value for name, value in os.environ.items() if name not in hidden}
    command = [sys.executable, "-m", "hypogoal", "label", "doorkey", "--out", str(tmp_path / "marked")]
    done = subprocess.run(command, env=environment, capture_output=True, text=True, timeout=120)
    assert done.returncode == 2 and "no window can be opened" in done.stderr
    assert not list(tmp_path.iterdir())
