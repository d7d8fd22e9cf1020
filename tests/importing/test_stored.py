"""Generated recordings and films are read as they were made, or refused (Spec B6, G2)."""

import json
from collections import Counter
from fractions import Fraction
from pathlib import Path
from typing import Any

import av
import minari
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from gymnasium import spaces
from minari.data_collector import EpisodeBuffer
from minari.dataset.minari_storage import MinariStorage

from hypogoal.core.errors import UserError
from hypogoal.data import Collected
from hypogoal.domains.gymnasium.reader import reader_of
from hypogoal.importing.assemble import assemble
from hypogoal.importing.labels import labels_of
from hypogoal.importing.pictures import count_frames, frames_in
from hypogoal.importing.recordings import reader_of as recordings_reader_of
from hypogoal.importing.states import frames_of
from tests.importing import robot_data

Draw = np.random.Generator
DEMOS = 5


def stored(source: Path, rule: str, keys: tuple[str, ...] = ()) -> Collected:
    """What a data file of a recording has."""
    left: Counter[str] = Counter()
    reader = recordings_reader_of(source, left)
    assert reader
    frames = frames_of(source, reader(source, keys), left, keys=keys)
    return assemble(source, frames, labels_of(frames, {"on": rule}), ["on"])[0]


def states_in(data: Collected) -> list[tuple[Any, bool | None]]:
    """Each state, and its label where it has one."""
    states: list[tuple[Any, bool | None]] = [(state, None) for state in data.unlabelled.observations]
    for part in (data.labelled, data.heldout):
        states += zip(part.observations, part.labels[:, 0].tolist(), strict=True)
    return states


RATES = (7, 10, 15, 29.97, 30, 24000 / 1001, 50)
FAULTS = (
    "", "", "", "short", "short and unsaid", "twice the rate", "rows shuffled", "row lost", "begins early", "long",
)  # fmt: skip
BLOCK = 8


def marked(episode: int, frame: int) -> np.ndarray:
    """A frame whose blocks say in black and white which it is."""
    bits = [(episode * 64 + frame) >> place & 1 for place in range(16)]
    blocks = np.array(bits, np.uint8).reshape(4, 4) * 200 + 28
    grey = blocks.repeat(BLOCK, 0).repeat(BLOCK, 1)
    return np.stack([grey] * 3, 2)


def mark_in(picture: np.ndarray) -> tuple[int, int]:
    middle = picture[BLOCK // 2 :: BLOCK, BLOCK // 2 :: BLOCK, 1].ravel() > 128
    number = sum(1 << place for place in range(16) if middle[place])
    return divmod(number, 64)


def write_marked(path: Path, frames: list[np.ndarray], rate: Fraction, draw: Draw) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    options = {"g": str(draw.integers(1, 30)), "bf": str(draw.integers(3)), "crf": "12"}
    codec = "libx264" if "libx264" in av.codecs_available else "mpeg4"
    with av.open(str(path), "w") as container:
        stream = container.add_stream(codec, rate=rate, options=options)
        stream.width = stream.height = 4 * BLOCK
        stream.pix_fmt = "yuv420p"
        for values in frames:
            container.mux(stream.encode(av.VideoFrame.from_ndarray(values, format="rgb24")))
        container.mux(stream.encode())


def write_lerobot(folder: Path, draw: Draw) -> None:
    """Episodes that share films, in some order; one of them has a fault."""
    rate = RATES[draw.integers(len(RATES))]
    exact = Fraction(rate).limit_denominator(1001)
    fault, faulty = FAULTS[draw.integers(len(FAULTS))], int(draw.integers(DEMOS))
    lengths = draw.integers(5, 20, DEMOS)
    order = draw.permutation(DEMOS)
    begins: dict[int, tuple[int, float, float]] = {}
    version = ("v2.1", "v3.0", "v3.0")[draw.integers(3)]
    facts = robot_data.facts(version, "video") | {"fps": rate}
    groups = np.array_split(order, draw.integers(1, 3))
    for file, episodes in enumerate(groups if version == "v3.0" else np.arange(DEMOS)[:, None]):
        frames: list[np.ndarray] = []
        speed = 2 if fault == "twice the rate" else 1
        for episode in episodes:
            harm = fault if episode == faulty else ""
            count = lengths[episode] - (2 if harm.startswith("short") else 0) + (2 if harm == "long" else 0)
            begin = len(frames) / speed / rate
            end = begin + (lengths[episode] if harm == "short and unsaid" else count) / rate
            frames += [marked(int(episode), frame // speed) for frame in range(count * speed)]
            begins[int(episode)] = (file, begin - (3 / rate if harm == "begins early" else 0), end)
        numbers = {"chunk_index": 0, "file_index": file, "episode_chunk": 0, "episode_index": file}
        film = facts["video_path"].format(video_key="observation.eye", **numbers)
        write_marked(folder / film, frames, exact * speed, draw)
    tables, rows = [], []
    for episode, length in enumerate(lengths):
        frame = np.arange(length)
        if fault == "rows shuffled" and episode == faulty:
            frame = draw.permutation(frame)
        if fault == "row lost" and episode == faulty:
            frame = np.delete(frame, 2)
        where = np.stack([np.full(len(frame), episode), frame], 1).astype(np.float32)
        columns = {
            "episode_index": np.full(len(frame), episode), "timestamp": (frame / rate).astype(np.float32),
            "frame_index": frame, "next.success": frame > length - 3, "observation.tag": where.tolist(),
        }  # fmt: skip
        tables.append(pa.table(columns))
        file, begin, end = begins[episode]
        row: dict[str, Any] = {"episode_index": episode, "length": len(frame)}
        if version == "v3.0":
            names = ("chunk_index", "file_index", "from_timestamp", "to_timestamp")
            row |= zip([f"videos/observation.eye/{name}" for name in names], (0, file, begin, end), strict=True)
            row |= {"data/chunk_index": 0, "data/file_index": 0}
        rows.append(row)
    (folder / "meta/episodes/chunk-000").mkdir(parents=True)
    (folder / "data/chunk-000").mkdir(parents=True)
    if version == "v3.0":
        pq.write_table(pa.Table.from_pylist(rows), folder / "meta/episodes/chunk-000/file-000.parquet")
        pq.write_table(pa.concat_tables(tables), folder / "data/chunk-000/file-000.parquet")
    else:
        lines = [json.dumps(row) for row in rows]
        (folder / "meta/episodes.jsonl").write_text("\n".join(lines))
        for episode, table in enumerate(tables):
            pq.write_table(table, folder / f"data/chunk-000/episode_{episode:06d}.parquet")
    kinds = {"observation.eye": "video", "observation.tag": "float32", "next.success": "bool"}
    facts["features"] = {key: {"dtype": kind} for key, kind in kinds.items()}
    (folder / "meta/info.json").write_text(json.dumps(facts))


def check_lerobot(folder: Path, draw: Draw) -> str:
    write_lerobot(folder, draw)
    try:
        states = states_in(stored(folder, "next.success"))
    except UserError:
        return "refused"
    for state, _ in states:
        assert mark_in(state["observation.eye"]) == tuple(state["observation.tag"].astype(int))
    return "equal"


MANY = pytest.param(300, marks=pytest.mark.slow)


@pytest.mark.parametrize("count", [10, MANY])
def test_each_is_stored_as_it_is_or_refused(tmp_path: Path, count: int) -> None:
    outcomes: Counter[str] = Counter()
    for seed in range(count):
        folder = tmp_path / str(seed)
        folder.mkdir()
        outcomes[check_lerobot(folder, np.random.default_rng(seed))] += 1
    assert outcomes["equal"] > count / 4, outcomes


@pytest.mark.parametrize("kind", ["hdf5", "arrow", "parquet"])
def test_minaris_observations_are_those_of_the_environment(tmp_path: Path, kind: str) -> None:
    """Parts in parts, of several types, not in the order of their names."""
    pair = spaces.Tuple([spaces.MultiDiscrete([3, 4]), spaces.Box(-9, 9, (2, 2), np.float64)])
    space = spaces.Dict([("z", spaces.Discrete(4, start=-1)), ("arm", pair), ("eye", spaces.MultiBinary(2))])
    space.seed(0)
    (tmp_path / "data").mkdir()
    storage = MinariStorage.new(tmp_path / "data", space, spaces.Discrete(2), data_format=kind, jpeg_encoding=False)
    steps: list[Any] = [space.sample() for _ in range(4 * DEMOS)]
    for number in range(DEMOS):
        seen = steps[4 * number : 4 * number + 4]
        observations = {key: np.array([step[key] for step in seen]) for key in ("z", "eye")}
        observations["arm"] = tuple(np.array([step["arm"][part] for step in seen]) for part in (0, 1))
        ends = [False, False, True]
        buffer = EpisodeBuffer(
            id=number, observations=observations, actions=[0] * 3, rewards=[0.0, 1.0, 1.0], terminations=ends,
            truncations=[False] * 3,
        )  # fmt: skip
        storage.update_episodes([buffer])
    storage.update_metadata({"dataset_id": "own-v0", "minari_version": minari.__version__})
    reader = reader_of(space)
    found = {state.tobytes() for state, _ in states_in(stored(tmp_path, "rewards"))}
    assert found == {reader.read(step).tobytes() for step in steps}


SOME = [10, pytest.param(300, marks=pytest.mark.slow)]
FILMS = [
    ("mp4", "mp4", "libx264", "yuv420p"),
    ("mkv", "matroska", "libx264", "yuv444p"),
    ("mov", "mov", "mpeg4", "yuv420p"),
    ("avi", "avi", "mjpeg", "yuvj420p"),
    ("webm", "webm", "libvpx-vp9", "yuv420p"),
    ("mkv", "matroska", "ffv1", "yuv420p"),
    ("avi", "avi", "mpeg4", "yuv420p"),
    ("mkv", "matroska", "ffv1", "bgr0"),
    ("mkv", "matroska", "ffv1", "bgra"),
]


def write_blocks(path: Path, form: str, codec: str, pixels: str, draw: np.random.Generator) -> None:
    """A film of blocks of random colours; some with B-frames, some with key frames close together."""
    options = {"bf": str(draw.integers(3)), "g": str(draw.integers(1, 12))} if codec == "libx264" else {}
    with av.open(str(path), "w", format=form) as container:
        stream = container.add_stream(codec, rate=10, options=options)
        stream.width, stream.height, stream.pix_fmt, stream.bit_rate = 64, 48, pixels, 2_000_000
        for _ in range(draw.integers(2, 12)):
            values = draw.integers(0, 256, (3, 4, 4), dtype=np.uint8).repeat(16, 0).repeat(16, 1)
            container.mux(stream.encode(av.VideoFrame.from_ndarray(values, format="rgba")))
        container.mux(stream.encode())


def decoded_slowly(path: Path) -> list[np.ndarray]:
    """All frames, made of their planes here: BT.601, of a narrow range unless it says full."""
    frames = []
    with av.open(str(path)) as container:
        for frame in container.decode(video=0):
            name = frame.format.name
            if name.startswith("bgr"):
                [plane] = frame.planes
                rows = np.frombuffer(plane, np.uint8).reshape(48, plane.line_size)[:, : 4 * 64]
                frames.append(rows.reshape(48, 64, 4)[..., 2::-1].astype(float))
                continue
            planes = []
            for plane in frame.planes:
                rows = np.frombuffer(plane, np.uint8).reshape(plane.height, plane.line_size)[:, : plane.width]
                planes.append(rows.repeat(48 // plane.height, 0).repeat(64 // plane.width, 1).astype(float))
            full = name.startswith("yuvj") or frame.color_range == 2
            light = planes[0] if full else (planes[0] - 16) * 255 / 219
            blue, red = ((plane - 128) * (1 if full else 255 / 224) for plane in planes[1:])
            colours = (light + 1.402 * red, light - 0.344136 * blue - 0.714136 * red, light + 1.772 * blue)
            frames.append(np.stack(colours, axis=2).clip(0, 255))
    return frames


@pytest.mark.parametrize("count", SOME)
def test_films_are_as_decoded_slowly_or_refused(tmp_path: Path, count: int, capsys: pytest.CaptureFixture[str]) -> None:
    """A third is cut off: what was to follow is told."""
    for seed in range(count):
        draw = np.random.default_rng(seed)
        suffix, form, codec, pixels = FILMS[seed % len(FILMS)]
        path = tmp_path / f"x.{suffix}"
        write_blocks(path, form, codec, pixels, draw)
        whole = decoded_slowly(path)
        if is_cut := seed % 3 == 0:
            data = path.read_bytes()
            path.write_bytes(data[: len(data) // 3])
        try:
            listed = count_frames(path)
            seen = [*frames_in(path, np.arange(listed))] if listed else []
        except UserError:
            assert is_cut or pixels == "bgra", seed
            continue
        assert pixels != "bgra" or not listed, seed
        is_short = len(whole) - listed > 6  # more than half a second
        assert is_cut or listed == len(whole), seed
        assert ("ends earlier than it says" in capsys.readouterr().err) or not is_short, seed
        for one, other in zip(seen, whole, strict=False):
            assert np.abs(one - other)[8::16, 8::16].max() < 8, seed
