"""Recorded episodes: LeRobotDataset, robomimic's HDF5, Minari, films; what is wrong is one line (Spec I6)."""

import os
import shutil
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any, TypeAlias

import h5py
import numpy as np
import pandas as pd
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from command_line import refuses, run

from hypogoal.data import Dataset, open_dataset
from hypogoal.importing import pictures
from hypogoal.importing.assemble import with_roles
from hypogoal.importing.recordings import read_robomimic
from hypogoal.importing.states import ROLES
from hypogoal.observations import digest
from tests.importing import robot_data
from tests.importing.robot_data import LENGTHS, STATE, TOP, WRIST
from tests.importing.states import SIDE, save_minari
from tests.importing.test_odd import turned

FORMATS = [("v2.1", "video"), ("v3.0", "video"), ("v3.0", "image")]
LABEL = ["--label", "reached=next.success"]
UPRIGHT = np.random.default_rng(0).integers(0, 255, (3, 5, 3), dtype=np.uint8).repeat(16, 0).repeat(16, 1)
Change: TypeAlias = Callable[[Path], None]


@pytest.fixture(scope="module")
def datasets(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """One dataset of each format, ``v3.0-video`` and so on, a robomimic file and a folder of films."""
    folder = tmp_path_factory.mktemp("recorded")
    for version, kind in FORMATS:
        robot_data.write_lerobot(folder / f"{version}-{kind}", version, kind)
    robot_data.write_robomimic(folder / "demo.hdf5")
    robot_data.write_films(folder / "takes")
    return folder


def imported(source: Path, out: Path, *words: str) -> Dataset:
    run("import", source, "--out", out, "-q", "--force", *words)
    return open_dataset(out)


def frames_of(data: Dataset, goal: str = "reached") -> list[tuple[np.ndarray, bool | None]]:
    """Every state of a file, with its label where it has one."""
    known = []
    for part in (data.labelled(goal), data.heldout(goal)):
        known += zip(part.observations, part.labels.tolist(), strict=True)
    return known + [(state, None) for state in data.unlabelled()]


@pytest.mark.parametrize(("version", "kind"), FORMATS)
def test_a_lerobot_dataset_is_read_frame_by_frame(datasets: Path, tmp_path: Path, version: str, kind: str) -> None:
    """Spec I6: each frame once, with its own state, picture and label; whole episodes are held out."""
    data = imported(datasets / f"{version}-{kind}", tmp_path / "data.h5", *LABEL, "--resize", "64")
    dtype = data.observation_dtype
    assert {key: dtype[key].shape for key in dtype.names} == {TOP: (48, 64, 3), WRIST: (64, 64, 3), STATE: (3,)}
    frames = frames_of(data)
    assert len(frames) == sum(LENGTHS)
    met = set()
    for state, label in frames:
        at, episode = float(state[STATE][0]), robot_data.episode_of(state[WRIST])
        met.add((round(at, 4), episode))
        assert label in (None, at > 0.5 and episode != 2)
        for key, camera in ((TOP, "top"), (WRIST, "wrist")):
            whole = robot_data.picture(camera, at, episode)
            small = np.asarray(state[key], dtype=float)
            exact = whole.reshape(small.shape[0], whole.shape[0] // small.shape[0], small.shape[1], -1, 3).mean((1, 3))
            assert np.abs(small - exact).mean() < (0.6 if kind == "image" else 8), "another frame, or other colours"
    assert met == {(round(float(at), 4), episode) for episode in range(6) for at in robot_data.places(episode)}
    held = {robot_data.episode_of(state[WRIST]) for state in data.heldout("reached").observations}
    learned = {robot_data.episode_of(state[WRIST]) for state in data.labelled("reached").observations}
    assert held and learned and not held & learned


def test_keys_are_chosen_and_one_picture_alone_is_a_picture(datasets: Path, tmp_path: Path) -> None:
    source, out = datasets / "v3.0-image", tmp_path / "data.h5"
    assert imported(source, out, *LABEL, "--key", TOP).observation_shape == (96, 128, 3)
    assert imported(source, out, *LABEL, "--key", STATE).observation_shape == (3,)
    both = imported(source, out, *LABEL, "--key", TOP, "--key", STATE, "--resize", "32")
    assert both.observation_dtype[TOP].shape == (24, 32, 3)


def test_labels_of_last_frames_and_of_a_table(datasets: Path, tmp_path: Path) -> None:
    """Spec I6: the last n frames of successful episodes; a table's frames, where other episodes are unlabelled."""
    source, out = datasets / "v3.0-image", tmp_path / "data.h5"
    for state, label in frames_of(imported(source, out, "--key", STATE, "--label", "reached=last:3")):
        episode = next(e for e in range(6) if np.abs(robot_data.places(e) - state[0]).min() < 1e-6)
        assert label in (None, state[0] >= robot_data.places(episode)[-3] and episode != 2)
    table = tmp_path / "labels.csv"
    table.write_text("episode,from,to\n0,8,12\n1,0,0\n3,7,10\n0,0,1\n")
    data = imported(source, out, "--key", STATE, "--label", f"reached={table}")
    assert len(data.unlabelled()) == LENGTHS[2] + LENGTHS[4] + LENGTHS[5]
    positives = sorted(round(float(state[0]), 4) for state, label in frames_of(data) if label)
    zero, three = robot_data.places(0), robot_data.places(3)
    assert positives == sorted(round(float(at), 4) for at in [zero[0], *zero[8:], *three[7:]])


def test_labels_of_a_function(datasets: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Spec I6: of what is seen in a frame, of several keys a dictionary."""
    monkeypatch.syspath_prepend(str(tmp_path))
    far = f"def far(state): return state[0] > 0.5\ndef by_key(seen): return far(seen[{STATE!r}])\n"
    (tmp_path / "rules.py").write_text(far)
    source, out = datasets / "v3.0-image", tmp_path / "data.h5"
    for rule, keys, every in (("far", [STATE], "1"), ("by_key", [STATE, TOP], "2")):
        chosen = [word for key in keys for word in ("--key", key)]
        data = imported(source, out, *chosen, "--label", f"reached=rules:{rule}", "--every", every)
        labels = [(state[STATE] if data.observation_dtype.names else state, label) for state, label in frames_of(data)]
        assert {label for _, label in labels} == {None, True, False}
        assert all(label in (None, state[0] > 0.5) for state, label in labels)


def test_every_third_frame_and_the_last(datasets: Path, tmp_path: Path) -> None:
    few = imported(datasets / "v3.0-video", tmp_path / "few.h5", *LABEL, "--every", "3")
    every = imported(datasets / "v3.0-video", tmp_path / "all.h5", *LABEL)
    assert len(frames_of(few)) == sum(-(-length // 3) for length in LENGTHS)
    last = {np.float32(robot_data.places(episode)[-1]) for episode in range(6)}
    assert last <= {state[STATE][0] for state, _ in frames_of(few)}
    whole = {state[STATE].tobytes(): state.tobytes() for state, _ in frames_of(every)}
    assert all(whole[state[STATE].tobytes()] == state.tobytes() for state, _ in frames_of(few))


def test_episodes_are_split_whole_and_what_is_held_out_stays_so() -> None:
    """Spec B3: two fifths, two fifths, one fifth of those with labels; the recording's own choice goes first."""
    for roles, sizes in (
        ([""] * 10, (4, 4, 2)),
        ([""] * 3, (1, 1, 1)),
        ([""] * 6 + ["unlabelled"] * 4, (4, 4, 2)),
        ([""] * 8 + ["heldout"] * 2, (4, 4, 2)),
        (["heldout"] + [""] * 3 + ["unlabelled"] * 2, (3, 2, 1)),
    ):
        table = pd.DataFrame({"episode": range(len(roles)), "role": roles}).sample(30, replace=True, random_state=0)
        table = pd.concat([pd.DataFrame({"episode": range(len(roles)), "role": roles}), table], ignore_index=True)
        drawn = with_roles(table.copy(), 0)
        assert sorted(drawn.index) == [*range(len(table))] and (drawn.groupby("episode")["role"].nunique() == 1).all()
        role_of = drawn.groupby("episode")["role"].first()
        assert tuple((role_of == role).sum() for role in ROLES) == sizes
        assert all(role in ("", role_of[number]) for number, role in enumerate(roles))


def test_robomimics_file_is_read(datasets: Path, tmp_path: Path) -> None:
    """Spec I6: links followed, groups within ``obs`` by their path, ``mask/valid`` held out, texts told."""
    data = imported(datasets / "demo.hdf5", tmp_path / "data.h5", "--label", "reached=rewards", "--resize", "64")
    assert data.observation_dtype["agentview_image"].shape == (48, 64, 3)
    assert len(frames_of(data)) == sum(LENGTHS)
    for state, label in frames_of(data):
        assert label in (None, state["robot0_eef_pos"][0] > 0.5)
    shutil.copy(datasets / "demo.hdf5", tmp_path / "part.hdf5")
    with h5py.File(tmp_path / "merged.hdf5", "w") as file:
        for demo in range(5):
            file[f"data/demo_{demo}"] = h5py.ExternalLink("part.hdf5", f"/data/demo_{demo}")
        file.copy(file["data/demo_0"], "data/demo_7")
        for demo in file["data"].values():
            del demo["obs/agentview_image"]
            demo["obs/arm/speed"] = np.zeros((len(demo["rewards"]), 2))
            demo["obs/task"] = ["open"] * len(demo["rewards"])
        file["data/demo_9/obs/robot0_eef_pos"] = np.zeros((0, 3))
        file["mask/valid"] = np.array([b"demo_1", b"demo_4"])
    said = run("import", tmp_path / "merged.hdf5", "--out", tmp_path / "m.h5", "--label", "reached=rewards", "-q").err
    assert "not read: 1 episodes without frames, 6 times 'task', neither pictures nor numbers" in said
    held = open_dataset(tmp_path / "m.h5").heldout("reached").observations
    assert held.dtype.names == ("arm.speed", "robot0_eef_pos") and len(held) == LENGTHS[1] + LENGTHS[4]


def small_robomimic(path: Path, change: Callable[[h5py.File], object]) -> Path:
    """Six demonstrations of five frames, whose first number is theirs, rewarded in the last two; then changed."""
    with h5py.File(path, "w") as file:
        for demo in range(6):
            file[f"data/demo_{demo}/obs/state"] = np.stack([np.full(5, demo), np.arange(5)], 1)
            file[f"data/demo_{demo}/rewards"] = np.arange(5) > 2
        change(file)
    return path


def filtered(file: h5py.File) -> None:
    """Values behind a filter, blosc, that HDF5 does not have."""
    kind = h5py.h5p.create(h5py.h5p.DATASET_CREATE)
    kind.set_chunk((5, 1))
    kind.set_filter(32001, h5py.h5z.FLAG_OPTIONAL)
    space = h5py.h5s.create_simple((5, 1))
    data = h5py.h5d.create(file["data/demo_0/obs"].id, b"far", h5py.h5t.NATIVE_DOUBLE, space, kind)
    data.write_direct_chunk((0, 0), b"0" * 40)


def unwritten(file: h5py.File) -> None:
    """A chunk that was never written, for which HDF5 gives zeros."""
    del file["data/demo_0/obs/state"]
    data = file.create_dataset("data/demo_0/obs/state", (5, 2), "f8", chunks=(2, 2))
    data[:2] = 1.0


def put(name: str, values: Any) -> Callable[[h5py.File], object]:
    def change(file: h5py.File) -> None:
        if name in file:
            del file[name]
        file[name] = values

    return change


CHANGES: list[tuple[Callable[[h5py.File], object], str, str]] = [
    (put("mask/valid", [b"demo_50", b"demo_1"]), "", "mask/valid names no demonstrations"),
    (put("mask/valid", np.array([], "S3")), "", "mask/valid names no demonstrations"),
    (put("mask/valid", h5py.SoftLink("/nowhere")), "", "the recording cannot be read (KeyError"),
    (
        put("data/demo_0/obs/fps", 20),
        "state",
        "not all of these have an entry for each frame: demo_0: {'fps': (), 'state",
    ),
    (put("data/demo_0/obs/lens", np.eye(3)), "state", "demo_0: {'lens': (3, 3), 'state': (5, 2)}"),
    (put("data/demo_0/obs/link", h5py.SoftLink("/nowhere")), "state", "demo_0: {'link': None, 'state'"),
    (put("data/demo_0/obs/index", np.arange(99)), "state", "demo_0: {'index': (99,), 'state'"),
    (
        put("data/demo_0/rewards", np.ones(4)),
        "",
        "a number for each frame: rewards, not in demo_0[4]. There are rewards",
    ),
    (put("data/demo_0/rewards", np.ones(9)), "", "a number for each frame: rewards, not in demo_0[0]"),
    (put("data/demo_0/rewards", np.ones(1)), "", "a number for each frame: rewards, not in demo_0[1]"),
    (unwritten, "", "lacks values, for which HDF5 would give others"),
    (filtered, "", "this is compressed by a filter of HDF5 that is not installed"),
]


@pytest.mark.parametrize(("change", "key", "said"), CHANGES)
def test_what_a_demonstration_lacks_is_named(
    tmp_path: Path, change: Callable[[h5py.File], object], key: str, said: str
) -> None:
    """Spec G2: masks of others, what has no entry for each frame, filters; another key can be read."""
    source, label = small_robomimic(tmp_path / "x.hdf5", change), ["--label", "on=rewards"]
    refuses(said, "import", source, "--out", tmp_path / "data.h5", *label)
    if key:
        assert len(frames_of(imported(source, tmp_path / "data.h5", *label, "--key", key), "on")) == 30


def test_padded_names_are_held_out_and_unknown_success_is_unlabelled(tmp_path: Path) -> None:
    """``last:2`` of an episode of which nothing says whether it succeeds are not negative; any frame may say so."""

    def change(file: h5py.File) -> None:
        file["mask/valid"] = np.array([b"demo_0  ", b"demo_5\0"])
        file["data/demo_1/success"] = np.ones(9)
        for demo in (0, 2, 3, 4, 5):
            file[f"data/demo_{demo}/success"] = np.array([0, demo % 2, 0])

    source = small_robomimic(tmp_path / "x.hdf5", change)
    data = imported(source, tmp_path / "data.h5", "--label", "on=last:2")
    assert {state[0] for state in data.heldout("on").observations} == {0, 5}
    for state, label in frames_of(data, "on"):
        assert label in (None, state[0] % 2 == 1 and state[1] > 2)
        assert label is None or state[0] != 1


def test_held_out_demonstrations_without_labels_are_left_out(tmp_path: Path) -> None:
    """They are not trained on, and the others are divided as if they were not there."""
    source = small_robomimic(tmp_path / "x.hdf5", put("mask/valid", [b"demo_0", b"demo_5"]))
    table = tmp_path / "labels.csv"
    spans = [f"demo_{demo},3,5" for demo in range(5)]
    table.write_text("\n".join(["episode,from,to", *spans]))
    said = run("import", source, "--out", tmp_path / "data.h5", "--label", f"on={table}", "-q").err
    assert "hypogoal: 5 held-out states have no label: they are left out\n" in said
    data = open_dataset(tmp_path / "data.h5")
    assert {state[0] for state in data.heldout("on").observations} == {0}
    assert len(data.labelled("on").labels) == len(data.unlabelled()) == 10
    assert {state[0] for state, _ in frames_of(data, "on")} == {0, 1, 2, 3, 4}


def test_minari_is_read(tmp_path: Path) -> None:
    """Spec B6: whole episodes are labelled, unlabelled or held out, the same for the same seed."""
    folder, data = save_minari(tmp_path / "own-v0"), tmp_path / "data.h5"
    right = ["--label", f"right={folder / 'right.csv'}"]
    found = imported(folder, data, *right)
    counts = found.counts()
    assert counts["labelled"]["right"] == {"states": 24, "positives": 12}
    assert counts["heldout"]["right"] == {"states": 12, "positives": 6} and counts["unlabelled"] == 24
    labelled = found.labelled("right")
    np.testing.assert_array_equal(labelled.observations[:, 20, 35, 0] == 255, labelled.labels)
    before = found.unlabelled()
    np.testing.assert_array_equal(imported(folder, data, *right).unlabelled(), before)
    nested = save_minari(tmp_path / "nested-v0", nested=True)
    assert imported(nested, data, *right, "--key", "image").observation_shape == (SIDE, SIDE, 3)
    states = imported(nested, data, *right).labelled("right").observations
    assert states.dtype.names == ("arm", "image") and set(states["arm"][:, 0]) == {0, 2, 4, 6, 8, 10}


def write_turned(path: Path, orientation: int) -> None:
    """A film of two frames that lie as :func:`turned` puts them, and the display matrix that turns them back."""
    stored = np.ascontiguousarray(turned(UPRIGHT, orientation))
    robot_data.write_film(path, [stored, stored])
    matrix = {
        2: (-1, 0, 0, 1), 3: (-1, 0, 0, -1), 6: (0, 1, -1, 0), 7: (0, -1, -1, 0),
    }[orientation]  # fmt: skip
    data = bytearray(path.read_bytes())
    place = data.index(b"tkhd") + 44
    values = [matrix[0] << 16, matrix[1] << 16, 0, matrix[2] << 16, matrix[3] << 16, 0, 0, 0, 1 << 30]
    data[place : place + 36] = np.array(values, ">i4").tobytes()
    path.write_bytes(data)


@pytest.mark.parametrize("orientation", [2, 3, 6, 7])
def test_a_film_is_turned_as_players_turn_it(tmp_path: Path, orientation: int) -> None:
    write_turned(tmp_path / "x.mp4", orientation)
    assert pictures.count_frames(tmp_path / "x.mp4") == 2
    [seen] = pictures.frames_in(tmp_path / "x.mp4", np.array([1]))
    assert seen.shape == UPRIGHT.shape
    assert np.abs(seen[4::16, 4::16].mean(-1) - UPRIGHT[4::16, 4::16].mean(-1)).max() < 40  # colours are compressed


def test_a_folder_of_films_is_read(datasets: Path, tmp_path: Path) -> None:
    """Spec B6: suffixes in any case; the film without labels is unlabelled; what is no film is counted."""
    takes = tmp_path / "takes"
    shutil.copytree(datasets / "takes", takes)
    (takes / "take-1.mp4").rename(takes / "take-1.MP4")
    (takes / "notes.txt").write_text("x")
    words = ["--label", f"reached={takes / 'labels.csv'}", "--resize", "64"]
    said = run("import", takes, "--out", tmp_path / "data.h5", *words, "-q").err
    assert said == "hypogoal: not read: 1 .txt\n"
    data = open_dataset(tmp_path / "data.h5")
    assert data.observation_shape == (48, 64, 3) and len(data.unlabelled()) == LENGTHS[-1]
    assert len(frames_of(data)) == sum(LENGTHS)
    for state, label in frames_of(data):
        bright = np.flatnonzero(state[20, :, 0] > 150).mean()
        if label is not None and abs(bright - 31.5) > 0.3:  # half a pixel from the middle
            assert label == (bright > 31.5), bright


def test_what_channels_mean_is_kept(tmp_path: Path) -> None:
    """Spec B6: of a stack of pictures in a recording, and when its states are labelled later."""
    states = np.random.default_rng(0).integers(0, 255, (5, 6, 4, 24, 28, 3), dtype=np.uint8)
    with h5py.File(tmp_path / "x.hdf5", "w") as file:
        for demo, frames in enumerate(states):
            file[f"data/demo_{demo}/obs/front"] = frames
            file[f"data/demo_{demo}/rewards"] = np.arange(6) > 2
    data = imported(tmp_path / "x.hdf5", tmp_path / "data.h5", "--label", "on=rewards", "--stack", "--resize", "14")
    assert data.observation_shape == (12, 14, 12) and data.channels == {"": [4, 3]}
    (tmp_path / "t.csv").write_text(f"row,label,digest\n1,1,{digest(data.unlabelled()[1]).hex()}\n")
    more = imported(tmp_path / "data.h5", tmp_path / "more.h5", "--label", f"on={tmp_path / 't.csv'}")
    assert more.channels == data.channels


def without(name: str) -> Change:
    return lambda folder: (folder / name).unlink()


def cut(name: str) -> Change:
    return lambda folder: os.truncate(folder / name, 6 * (folder / name).stat().st_size // 10)


def other_film(camera: str, count: int) -> Change:
    frames = [robot_data.picture(camera, 0.5, 0)] * count
    return lambda folder: robot_data.write_film(folder / f"videos/{TOP}/chunk-000/file-000.mp4", frames)


FILM = f"videos/{WRIST}/chunk-000/file-001.mp4"
TABLE, LIST = "data/chunk-000/file-000.parquet", "meta/episodes/chunk-000/file-000.parquet"


@pytest.mark.parametrize(
    ("damage", "words"),
    [
        (without(FILM), "no such file"),
        (cut(FILM), "file-001.mp4"),  # which cannot be read, or whose frames do not match the table
        (other_film("top", 5), "frames that are listed"),
        (other_film("wrist", 60), "states differ in size"),
        (cut(TABLE), "this cannot be read"),
        (without(LIST), "this cannot be read"),
        (cut("meta/info.json"), "this cannot be read"),
    ],
)
def test_a_damaged_dataset_is_one_line(datasets: Path, tmp_path: Path, damage: Change, words: str) -> None:
    """Spec G2: what, where, what to do; nothing half-written."""
    source = tmp_path / "source"
    shutil.copytree(datasets / "v3.0-video", source)
    damage(source)
    keys = ["--key", TOP, "--key", WRIST, "--key", STATE]
    refuses(words, "import", source, "--out", tmp_path / "data.h5", *LABEL, *keys)


def test_pictures_in_files_of_their_own_are_one_line(datasets: Path, tmp_path: Path) -> None:
    """Spec G2: a table that has paths in place of bytes."""
    source = tmp_path / "source"
    shutil.copytree(datasets / "v3.0-image", source)
    frames = pq.read_table(source / TABLE)
    kind = frames.schema.field(TOP).type
    paths = pa.array([{"bytes": None, "path": "images/frame-0.png"}] * len(frames), kind)
    column = frames.schema.get_field_index(TOP)
    pq.write_table(frames.set_column(column, TOP, paths), source / TABLE)
    said = "pictures in files of their own are not read: "
    assert "images/frame-0.png. Write" in refuses(said, "import", source, "--out", tmp_path / "data.h5", *LABEL)


REFUSED = [
    ("", "Recordings are labelled by --label NAME=RULE"),
    ("--label a", "--label needs NAME=RULE"),
    ("--label a=next.sucess", "no column with a number for each frame: next.sucess. There are next"),
    ("--label a=last:0", "a has no positives"),
    ("--label a=missing.csv", "no such file: missing.csv"),
    ("--label a=last:3 --key observation.stat", "no pictures or numbers 'observation.stat'"),
    ("--label a=last:3 --resize big", "Invalid value for '--resize'"),
    ("--label a=last:3 --group task", "--group is for arrays"),
    ("episode,from,to\n99,0,1\n", "a label is of frames 0 up to 1 of 0 in '99'"),
    ("episode,from,to\n0,0,99\n", "a label is of frames 0 up to 99 of 12 in '0'"),
    ("episode,from,to\n0,a,2\n", "this cannot be read (ValueError: "),
    ("episode;from;to\n0;1;2\n", "Give a CSV file, with commas"),
    ("\ufeffepisode,from,to\n99,0,1\n", "a label is of frames 0 up to 1 of 0 in '99'"),
    ("episode,from,to\n0,1,2\n", "there are no heldout states"),
]


@pytest.mark.parametrize(("words", "said"), REFUSED)
def test_what_does_not_fit_is_one_line(datasets: Path, tmp_path: Path, words: str, said: str) -> None:
    """Spec G2: options, and tables of labels."""
    given = words.split()
    if "episode" in words:
        (tmp_path / "labels.csv").write_text(words)
        given = ["--label", f"reached={tmp_path / 'labels.csv'}", "--key", STATE]
    refuses(said, "import", datasets / "v3.0-image", "--out", tmp_path / "data.h5", *given)


def test_what_other_recordings_lack_is_one_line(datasets: Path, tmp_path: Path) -> None:
    few, some = (save_minari(tmp_path / f"{count}-v0", count, nested=True) for count in (2, 3))
    for source, rule, key, said in (
        (datasets / "demo.hdf5", "actions", "robot0_eef_pos", "no column with a number for each frame: actions"),
        (datasets / "takes", "last:3", "top", "Its keys are video"),
        (datasets / "takes", "rewards", "video", "There are none"),
        (few, few / "right.csv", "image", "there are no heldout states"),
        (some, some / "right.csv", "imag", "'imag': episode_0. Its keys are image, arm/speed, task"),
        (some, some / "right.csv", "task", "no pictures or numbers 'task'"),
    ):
        refuses(said, "import", source, "--out", tmp_path / "data.h5", "--label", f"a={rule}", "--key", key)


def test_the_missing_extra_is_named(datasets: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "av", None)
    words = ["import", datasets / "v3.0-video", "--out", tmp_path / "data.h5", *LABEL]
    refuses("pip install 'hypogoal[lerobot,minari]'", *words)


def test_demonstrations_come_in_the_order_of_their_numbers(tmp_path: Path) -> None:
    """The eleventh last, not second as HDF5 lists names."""
    source = small_robomimic(tmp_path / "x.hdf5", put("data/demo_10/obs/state", np.zeros((5, 2))))
    assert [episode.name for episode in read_robomimic(source, [])] == [f"demo_{n}" for n in (0, 1, 2, 3, 4, 5, 10)]
