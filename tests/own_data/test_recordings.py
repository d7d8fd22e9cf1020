"""Recorded episodes: LeRobotDataset, robomimic's HDF5, mp4 files with a table; what is wrong is one line (Spec I6)."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from pathlib import Path

import h5py
import numpy as np
import pytest
from command_line import refuses, run, settings

pytest.importorskip("pyarrow", reason="the extra hypogoal[lerobot]")
pytest.importorskip("av", reason="the extra hypogoal[lerobot]")

from hypogoal.cli import main
from hypogoal.data import Dataset, open_dataset
from hypogoal.own_data.recordings import kept
from tests.own_data import robot_data
from tests.own_data.robot_data import LENGTHS, STATE, TOP, WRIST

FORMATS = [("v2.1", "video"), ("v3.0", "video"), ("v2.1", "image"), ("v3.0", "image")]
LABEL = ["--label", "reached=next.success"]


@pytest.fixture(scope="module")
def datasets(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """One dataset of each format, ``v3.0-video`` and so on, a robomimic file and a folder of videos."""
    folder = tmp_path_factory.mktemp("recorded")
    for version, kind in FORMATS:
        robot_data.write_lerobot(folder / f"{version}-{kind}", version, kind)
    robot_data.write_robomimic(folder / "demo.hdf5")
    robot_data.write_videos(folder / "takes")
    return folder


def imported(source: Path, out: Path, *words: str) -> Dataset:
    run("import", source, "--out", out, "-q", "--force", *words)
    return open_dataset(out)


def frames_of(data: Dataset, goal: str = "reached") -> list[tuple[np.ndarray, bool | None]]:
    """Every state of a file, with its label where it has one."""
    parts = [data.labelled(goal), data.heldout(goal)]
    known = [
        (state, bool(label)) for part in parts for state, label in zip(part.observations, part.labels, strict=True)
    ]
    return known + [(state, None) for state in data.unlabelled()]


@pytest.mark.parametrize(("version", "kind"), FORMATS)
def test_a_lerobot_dataset_is_read_frame_by_frame(datasets: Path, tmp_path: Path, version: str, kind: str) -> None:
    """Spec I6: each frame once, with its own state, picture and label; whole episodes are held out."""
    data = imported(datasets / f"{version}-{kind}", tmp_path / "data.h5", *LABEL, "--resize", "64")
    dtype = data.observation_dtype
    assert {key: dtype[key].shape for key in dtype.names} == {TOP: (48, 64, 3), WRIST: (64, 64, 3), STATE: (3,)}
    assert data.sub_goals == ("reached",)
    frames = frames_of(data)
    assert len(frames) == sum(LENGTHS)
    wanted = {(round(float(at), 4), episode) for episode in range(6) for at in robot_data.places(episode)}
    met = set()
    for state, label in frames:
        at = float(state[STATE][0])
        level = float(np.median(state[WRIST]))  # the background says which episode
        episode = round((level - 20) / 10)
        met.add((round(at, 4), episode))
        assert label in (None, at > 0.5 and episode != 2)
        for key, camera in ((TOP, "top"), (WRIST, "wrist")):
            whole = robot_data.picture(camera, at, episode)
            small = np.asarray(state[key], dtype=float)
            exact = whole.reshape(small.shape[0], whole.shape[0] // small.shape[0], small.shape[1], -1, 3).mean((1, 3))
            assert np.abs(small - exact).mean() < (0.6 if kind == "image" else 8), "another frame, or other colours"
    assert met == wanted
    held = {round((float(np.median(state[WRIST])) - 20) / 10) for state in data.heldout("reached").observations}
    learned = {round((float(np.median(state[WRIST])) - 20) / 10) for state in data.labelled("reached").observations}
    assert held and learned and not held & learned


def test_both_versions_hold_the_same_states(datasets: Path, tmp_path: Path) -> None:
    """The formats differ in files only."""
    for kind in ("video", "image"):
        one, other = (imported(datasets / f"{v}-{kind}", tmp_path / f"{v}.h5", *LABEL) for v in ("v2.1", "v3.0"))
        for ours, theirs in zip(frames_of(one), frames_of(other), strict=True):
            np.testing.assert_array_equal(ours[0][STATE], theirs[0][STATE])
            assert ours[1] == theirs[1]
            assert np.abs(ours[0][TOP].astype(int) - theirs[0][TOP].astype(int)).mean() < 4  # videos are compressed


@pytest.mark.parametrize("codec", ["libsvtav1", "libx264"])
def test_videos_of_any_codec_hold_the_same_frames(datasets: Path, tmp_path: Path, codec: str) -> None:
    """LeRobot writes AV1 by default; the pictures are those of the table, up to compression."""
    if codec not in robot_data.av.codecs_available:
        pytest.skip(f"this build of FFmpeg has no {codec}")
    source = robot_data.write_lerobot(tmp_path / "source", codec=codec)
    ours, exact = (
        frames_of(imported(folder, tmp_path / f"{number}.h5", *LABEL))
        for number, folder in enumerate([source, datasets / "v3.0-image"])
    )
    for (state, label), (whole, wanted) in zip(ours, exact, strict=True):
        np.testing.assert_array_equal(state[STATE], whole[STATE])
        assert label == wanted
        for key in (TOP, WRIST):
            assert np.abs(state[key].astype(int) - whole[key].astype(int)).mean() < 4


def test_keys_are_chosen_and_one_picture_alone_is_a_picture(datasets: Path, tmp_path: Path) -> None:
    source, out = datasets / "v3.0-image", tmp_path / "data.h5"
    assert imported(source, out, *LABEL, "--key", TOP).observation_shape == (96, 128, 3)
    assert imported(source, out, *LABEL, "--key", STATE).observation_shape == (3,)
    both = imported(source, out, *LABEL, "--key", TOP, "--key", STATE, "--resize", f"{TOP}=32")
    assert both.observation_dtype[TOP].shape == (24, 32, 3)


def test_labels_of_last_frames_and_of_a_table(datasets: Path, tmp_path: Path) -> None:
    """Spec I6: the last n frames of successful episodes; a table's frames, where other episodes are unlabelled."""
    source, out = datasets / "v2.1-image", tmp_path / "data.h5"
    words = ["--key", STATE, "--label", "reached=last:3"]
    frames = frames_of(imported(source, out, *words))
    for state, label in frames:
        episode = next(e for e in range(6) for at in robot_data.places(e) if abs(at - state[0]) < 1e-6)
        if label is not None:
            last = robot_data.places(episode)[-3]
            assert label == (state[0] >= last and episode != 2)
    table = tmp_path / "marks.csv"
    table.write_text("episode,from,to\n0,8,12\n1,0,0\n3,7,10\n0,0,1\n")
    data = imported(source, out, "--key", STATE, "--label", f"reached={table}")
    assert len(data.unlabelled()) == LENGTHS[2] + LENGTHS[4] + LENGTHS[5]
    positives = sorted(round(float(state[0]), 4) for state, label in frames_of(data) if label)
    zero, three = robot_data.places(0), robot_data.places(3)
    assert positives == sorted(round(float(at), 4) for at in [zero[0], *zero[8:], *three[7:]])


def test_every_third_frame_and_the_last(datasets: Path, tmp_path: Path) -> None:
    assert kept(7, 3).tolist() == [0, 3, 6] and kept(8, 3).tolist() == [1, 4, 7] and kept(2, 5).tolist() == [1]
    few = imported(datasets / "v3.0-video", tmp_path / "few.h5", *LABEL, "--every", "3")
    every = imported(datasets / "v3.0-video", tmp_path / "all.h5", *LABEL)
    assert len(frames_of(few)) == sum(len(kept(length, 3)) for length in LENGTHS)
    whole = {state[STATE].tobytes(): state.tobytes() for state, _ in frames_of(every)}
    assert all(whole[state[STATE].tobytes()] == state.tobytes() for state, _ in frames_of(few))


def test_robomimics_file_is_read(datasets: Path, tmp_path: Path) -> None:
    data = imported(datasets / "demo.hdf5", tmp_path / "data.h5", "--label", "reached=rewards", "--resize", "64")
    assert data.observation_dtype["agentview_image"].shape == (48, 64, 3)
    for state, label in frames_of(data):
        assert label in (None, state["robot0_eef_pos"][0] > 0.5)
    assert len(frames_of(data)) == sum(LENGTHS)


def test_a_folder_of_videos_is_read(datasets: Path, tmp_path: Path) -> None:
    """Plain pictures, which all else takes, too; the video without labels is unlabelled."""
    label = f"reached={datasets / 'takes' / 'labels.csv'}"
    data = imported(datasets / "takes", tmp_path / "data.h5", "--label", label, "--resize", "64")
    assert data.observation_shape == (48, 64, 3)
    assert len(data.unlabelled()) == LENGTHS[-1]
    for state, label_of_state in frames_of(data):
        bright = np.flatnonzero(state[20, :, 0] > 150)
        if label_of_state is not None and abs(bright.mean() - 31.5) > 0.3:  # half a pixel from the middle
            assert label_of_state == (bright.mean() > 31.5), bright


def test_members_learn_from_recordings(datasets: Path, tmp_path: Path) -> None:
    """Spec A2, I6: from a dataset to scores."""
    imported(datasets / "v3.0-video", tmp_path / "run" / "data.h5", *LABEL, "--resize", "64")
    few = settings("steps=60", "members=2", "learning_rate=1e-3")
    folder = tmp_path / "run"
    run("train-ensemble", folder / "data.h5", "--out", folder / "ensemble", "-q", *few)
    run("evaluate", folder, "-q")
    metrics = json.loads((folder / "evaluation" / "metrics.json").read_text(encoding="utf-8"))
    assert metrics["hypotheses"][0]["best"]["mean"] > 0.8


def without(name: str) -> Callable[[Path], None]:
    return lambda folder: (folder / name).unlink()


def cut(name: str, share: float = 0.6) -> Callable[[Path], None]:
    def work(folder: Path) -> None:
        whole = (folder / name).read_bytes()
        (folder / name).write_bytes(whole[: int(share * len(whole))])

    return work


def info(**changes: object) -> Callable[[Path], None]:
    def work(folder: Path) -> None:
        file = folder / "meta" / "info.json"
        file.write_text(json.dumps(json.loads(file.read_text()) | changes))

    return work


def features(key: str, **changes: object) -> Callable[[Path], None]:
    def work(folder: Path) -> None:
        file = folder / "meta" / "info.json"
        whole = json.loads(file.read_text())
        whole["features"][key] |= changes
        file.write_text(json.dumps(whole))

    return work


def short_video(folder: Path) -> None:
    frames = [robot_data.picture("top", 0.5, 0)] * 5
    robot_data.write_video(folder / f"videos/{TOP}/chunk-000/file-000.mp4", frames)


def other_size(folder: Path) -> None:
    frames = [robot_data.picture("wrist", 0.5, 0)] * 60
    robot_data.write_video(folder / f"videos/{TOP}/chunk-000/file-000.mp4", frames)


def slower_video(folder: Path) -> None:
    frames = [robot_data.picture("top", 0.5, 0)] * 60
    robot_data.write_video(folder / f"videos/{TOP}/chunk-000/file-000.mp4", frames, fps=3)


VIDEO = f"videos/{WRIST}/chunk-000/file-001.mp4"
TABLE, LIST = "data/chunk-000/file-000.parquet", "meta/episodes/chunk-000/file-000.parquet"


@pytest.mark.parametrize(
    ("damage", "words"),
    [
        (without(VIDEO), "file-001.mp4. Download"),
        (cut(VIDEO), "file-001.mp4"),  # which is no mp4 file, or whose frames do not match the table
        (cut(VIDEO, 0), "no mp4 file, or it is damaged"),
        (short_video, " s: its frames do not match the table"),
        (slower_video, " s: its frames do not match the table"),
        (other_size, "a frame of observation.images.top is uint8 (64, 64, 3), which does not match"),
        (cut(TABLE), "the table is truncated or damaged"),
        (without(TABLE), " has no table"),
        (cut(LIST), "the table is truncated or damaged"),
        (without(LIST), "the list of episodes is empty"),
        (cut("meta/info.json"), "the dataset's facts are not valid JSON"),
        (info(codebase_version="v1.6"), "these are not the facts of a LeRobotDataset that is read"),
        (info(features=[1]), "these are not the facts of a LeRobotDataset that is read"),
        (info(fps=0), "these are not the facts of a LeRobotDataset that is read"),
        (info(chunks_size="many"), "these are not the facts of a LeRobotDataset that is read"),
        (info(video_path="../../{video_key}.mp4"), "has no video"),
        (info(data_path="{episode_index.__class__}"), "has no table"),
        (features(TOP, shape=[3]), "observation.images.top is video (3,), neither pictures nor numbers"),
        (features(STATE, dtype="string"), "observation.state is string (3,), neither pictures nor numbers"),
        (features(STATE, shape=[4]), "observation.state has the shape (3,), not (4,)"),
    ],
)
def test_a_damaged_dataset_is_one_line(
    datasets: Path, tmp_path: Path, damage: Callable[[Path], None], words: str
) -> None:
    """Spec G2: what, where, what to do; nothing half-written."""
    source = tmp_path / "source"
    shutil.copytree(datasets / "v3.0-video", source)
    damage(source)
    refuses(words, "import", source, "--out", tmp_path / "data.h5", *LABEL)


@pytest.mark.parametrize(
    ("table", "words"),
    [
        ("episode,from,to\n99,0,1\n", "line 2. They are 0 to 5."),
        ("episode,from,to\n0,0,99\n", "a label is of frames 0 up to 99, episode 0 has 12"),
        ("episode,from,to\n0,5,2\n", "a label is of frames 5 up to 2"),
        ("episode,from,to\n0,a,2\n", "a label is of frames a up to 2"),
        ("episode,from,to\n0,1\n", "a label is of frames 1 up to None"),
        ("take,begin\n0,1\n", "lacks a column of episode, from, to"),
        ("", "lacks a column of episode, from, to"),
        ("episode;from;to\n0;1;2\n", "with commas between"),
        ("episode,from,to\n0,1,2" + "9" * 200_000, "the table of labels is damaged"),
        ("\ufeffepisode,from,to\n99,0,1\n", "a label is of an unknown episode, '99'"),
        ("episode,from,to\n0,1,2\n", "1 episodes cannot be labelled, and held out"),
    ],
)
def test_labels_that_fit_no_frame_are_one_line(datasets: Path, tmp_path: Path, table: str, words: str) -> None:
    (tmp_path / "marks.csv").write_text(table)
    rule = ["--label", f"reached={tmp_path / 'marks.csv'}"]
    refuses(words, "import", datasets / "v3.0-image", "--out", tmp_path / "data.h5", *rule)


@pytest.mark.parametrize(
    ("source", "words", "said"),
    [
        ("v3.0-image", [], "nothing says where the sub-goal holds"),
        ("v3.0-image", ["--label", "a=next.sucess"], "no column 'next.sucess' to label by"),
        ("v3.0-image", ["--label", "a=last:0"], "the number of last frames is not above 0"),
        ("v3.0-image", ["--label", "a=missing.csv"], "missing.csv"),
        ("v3.0-image", [*LABEL, "--key", "observation.stat"], "no observation 'observation.stat'"),
        ("demo.hdf5", ["--label", "a=actions"], "no column 'actions' to label by"),
        ("demo.hdf5", ["--label", "a=rewards", "--key", "joint"], "no observation 'joint'"),
        ("takes", ["--label", "a=last:3", "--key", "top"], "It has video"),
        ("takes", ["--label", "a=rewards"], "Its columns are none"),
        ("v3.0-image", [*LABEL, "--resize", "big"], "--resize needs a number of pixels"),
    ],
)
def test_what_is_not_there_is_one_line(
    datasets: Path, tmp_path: Path, source: str, words: list[str], said: str
) -> None:
    refuses(said, "import", datasets / source, "--out", tmp_path / "data.h5", *words)


@pytest.mark.parametrize("source", ["v2.1-video", "v3.0-video", "v3.0-image", "demo.hdf5", "takes"])
def test_whatever_is_damaged_is_read_or_refused(
    datasets: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], source: str
) -> None:
    """Spec G2: bytes changed, cut off or doubled anywhere: a data file, or one line and none."""
    outcomes = set()
    for case in range(12):
        rng, place = np.random.default_rng(case), tmp_path / f"{case}-{source}"
        (shutil.copytree if (datasets / source).is_dir() else shutil.copy)(datasets / source, place)
        files = sorted(file for file in ([place] if place.is_file() else place.rglob("*")) if file.is_file())
        damaged = files[int(rng.integers(len(files)))]
        values = bytearray(damaged.read_bytes())
        for at in rng.integers(len(values), size=int(rng.choice((1, 8, 64)))):
            values[at] = int(rng.integers(256))
        damaged.write_bytes(values[: int(rng.integers(len(values)))] if case % 3 == 0 else values)
        label = {"demo.hdf5": "a=rewards", "takes": f"a={place / 'labels.csv'}"}.get(source, "a=next.reward")
        out = tmp_path / f"{case}.h5"
        code = main(["import", str(place), "--out", str(out), "--label", label, "--resize", "48", "-q"])
        line = capsys.readouterr().err
        outcomes.add(code)
        assert (code, out.exists()) in ((0, True), (2, False)), line
        assert code == 0 or (line.startswith("hypogoal: ") and line.count("\n") == 1 and line.isascii()), line
    assert 2 in outcomes, "nothing was refused: are the files damaged at all?"


def test_other_hdf5_files_are_one_line(tmp_path: Path) -> None:
    """Spec G2: no demonstrations, demonstrations that differ, a link out of the file."""
    with h5py.File(tmp_path / "no.hdf5", "w") as file:
        file["x"] = [1]
    with h5py.File(tmp_path / "odd.hdf5", "w") as file:
        for demo, size in enumerate((3, 3, 4)):
            file[f"data/demo_{demo}/obs/pos"] = np.zeros((5, size))
            file[f"data/demo_{demo}/rewards"] = np.zeros(5)
    with h5py.File(tmp_path / "link.hdf5", "w") as file:
        file.create_group("data/demo_0/obs")["pos"] = h5py.ExternalLink("odd.hdf5", "data/demo_0/obs/pos")
    for name, said in (("no", "it has no data/demo_0/obs"), ("odd", "differ in shape or number"), ("link", "a link")):
        words = ["import", str(tmp_path / f"{name}.hdf5"), "--out", str(tmp_path / "d.h5"), "--label", "a=rewards"]
        refuses(said, *words)


def test_the_extra_is_named_where_it_is_missing(
    datasets: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(__import__("sys").modules, "av", None)
    words = ["import", str(datasets / "v3.0-video"), "--out", str(tmp_path / "data.h5"), *LABEL]
    refuses("this needs av, which is not installed. pip install 'hypogoal[lerobot]'", *words)
