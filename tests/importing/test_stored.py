"""Generated recordings of each format: what is stored is what a second, slow reader finds, or the recording is refused.

The second reader knows what was drawn (HDF5), reads the marks in each frame (LeRobot), or reads each observation as the
environment's reader does (Minari).
"""

import json
from collections import Counter, OrderedDict
from collections.abc import Callable
from fractions import Fraction
from itertools import pairwise
from pathlib import Path
from typing import Any

import av
import h5py
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


# HDF5

TYPES = ("u1", "u1", "i1", "<u2", ">i2", "<i4", ">u4", "<i8", "<u8", "<f2", ">f4", "<f8", ">f8", "?")
FILTERS: tuple[dict[str, Any], ...] = (
    {}, {"compression": "gzip"}, {"compression": "lzf"}, {"shuffle": True, "compression": "gzip"}, {"fletcher32": True},
)  # fmt: skip
DAMAGES = ("", "", "", "", "", "gone", "short", "gap", "other name", "unwritten")


def part_of(group: h5py.Group, key: str, values: np.ndarray, file: Path, draw: Draw, damage: str) -> None:
    """Write values in a raw file, or as one or two parts of a virtual dataset; ``damage`` is done to it."""
    count = len(values)
    if draw.random() < 0.3:
        stays = {"gone": 0, "short": values.nbytes - 1}.get(damage, values.nbytes)
        if damage != "gone":
            file.write_bytes(values.tobytes()[:stays])
        group.create_dataset(key, values.shape, values.dtype, external=[(str(file), 0, values.nbytes)])
        return
    ends = [0, count] if draw.random() < 0.5 else [0, count // 2, count]
    layout = h5py.VirtualLayout(values.shape, values.dtype)
    with h5py.File(file, "w") as other:
        for begin, end in pairwise(ends):
            written = values[begin:end]
            whole = h5py.VirtualSource(file.name, f"x{begin}", written.shape)
            is_last = end == count
            if not (is_last and damage == "gap"):
                layout[begin:end] = whole
            elif end - begin > 1:
                layout[begin : end - 1] = whole[:-1]
            if is_last and damage == "unwritten":
                other.create_dataset(f"x{begin}", written.shape, written.dtype, chunks=written.shape)
            else:
                kept = written[:-1] if is_last and damage == "short" else written
                other[f"y{begin}" if is_last and damage == "other name" else f"x{begin}"] = kept
    if damage == "gone":
        file.unlink()
    if draw.random() < 0.3:  # a part that has parts itself
        joined = file.with_name(f"{file.name}-joined")
        with h5py.File(joined, "w") as other:
            other.create_virtual_dataset("x", layout)
        layout = h5py.VirtualLayout(values.shape, values.dtype)
        layout[:] = h5py.VirtualSource(joined.name, "x", values.shape)
    group.create_virtual_dataset(key, layout)


def write_hdf5(path: Path, draw: Draw) -> dict[str, np.ndarray]:
    """A file with a key beside ``tag``; what was drawn for it, by demonstration."""
    kind = np.dtype(TYPES[draw.integers(len(TYPES))])
    shape = [(), (3,), (2, 2), (20, 24, 3), (20, 24)][draw.integers(5 if kind == np.uint8 else 3)]
    storage, filters = draw.integers(5), FILTERS[draw.integers(len(FILTERS))]
    damage, damaged = DAMAGES[draw.integers(len(DAMAGES))], draw.integers(DEMOS)
    drawn = {}
    with h5py.File(path, "w") as file:
        for demo in range(DEMOS):
            count = int(draw.integers(4, 9))
            values = draw.integers(1, 100, (count, *shape)).astype(kind)
            tags = np.stack([np.full(count, demo), np.arange(count)], 1)
            group = file.create_group(f"data/demo_{demo}")
            group["rewards"] = np.arange(count) > 2
            group["obs/tag"] = tags.astype(np.float64)
            drawn[f"demo_{demo}"] = values
            harm = damage if demo == damaged else ""
            if storage == 0:
                group["obs/x"] = values
            elif storage == 1:
                chunk = (2, *values.shape[1:])
                data = group.create_dataset("obs/x", values.shape, kind, chunks=chunk, **filters)
                written = count - 2 if harm else count
                data[:written] = values[:written]
            elif storage == 2 and harm:
                group.create_dataset("obs/x", values.shape, kind)
            elif storage == 2:
                file[f"elsewhere/{demo}"] = values
                group["obs/x"] = h5py.SoftLink(f"/elsewhere/{demo}")
            else:
                part_of(group["obs"], "x", values, path.with_name(f"part{demo}"), draw, harm)
    return drawn


def check_hdf5(folder: Path, draw: Draw) -> str:
    path = folder / "x.hdf5"
    drawn = write_hdf5(path, draw)
    try:
        states = states_in(stored(path, "rewards"))
    except UserError:
        return "refused"
    for state, label in states:
        demo, frame = state["tag"].astype(int)
        np.testing.assert_array_equal(state["x"].ravel(), drawn[f"demo_{demo}"][frame].astype(np.float32).ravel())
        assert label in (None, frame > 2)
    assert len(states) == sum(map(len, drawn.values()))
    return "equal"


# LeRobot

RATES = (7, 10, 15, 29.97, 30, 24000 / 1001, 50)
FAULTS = (
    "",
    "",
    "",
    "short",
    "short and unsaid",
    "twice the rate",
    "rows shuffled",
    "row lost",
    "begins early",
    "long",
)
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


# Minari


def drawn_space(draw: Draw, depth: int = 0) -> spaces.Space[Any]:
    """Any space that Minari can write; more often a simple one the deeper it lies."""
    kind = draw.integers(12 if depth < 2 else 9)
    size = int(draw.integers(1, 4))
    if kind < 3:
        dtype = (np.float32, np.float64, np.int64)[kind]
        return spaces.Box(-9, 9, [(), (size,), (size, 2)][draw.integers(3)], dtype)
    if kind == 3:
        return spaces.Box(0, 255, [(20, 18, 3), (20, 18), (3, 20, 18), (4,)][draw.integers(4)], np.uint8)
    if kind < 6:
        return spaces.Discrete(size + 2, start=int(draw.integers(-2, 3)))
    if kind < 8:
        return spaces.MultiDiscrete([size + 1] * size) if kind == 6 else spaces.MultiBinary(size)
    names = draw.permutation(["arm", "eye", "speed", "z"])[: size + 1]
    if kind == 8 and depth:
        return spaces.Text(4)
    parts = [(str(name), drawn_space(draw, depth + 1)) for name in names]
    return spaces.Tuple([part for _, part in parts]) if kind == 11 else spaces.Dict(OrderedDict(parts))


def batched(space: spaces.Space[Any], steps: list[Any]) -> Any:
    """Observations one after another as Minari's buffers have them."""
    if isinstance(space, spaces.Dict):
        return {key: batched(part, [step[key] for step in steps]) for key, part in space.items()}
    if isinstance(space, spaces.Tuple):
        return tuple(batched(part, [step[place] for step in steps]) for place, part in enumerate(space))
    return steps if isinstance(space, spaces.Text) else np.array(steps)


def check_minari(folder: Path, draw: Draw) -> str:
    space = drawn_space(draw)
    space.seed(int(draw.integers(1 << 20)))
    (folder / "data").mkdir()
    kind = ("hdf5", "arrow", "parquet")[draw.integers(3)]
    storage = MinariStorage.new(folder / "data", space, spaces.Discrete(2), data_format=kind, jpeg_encoding=False)
    steps = []
    for number in range(DEMOS):
        seen = [space.sample() for _ in range(4)]
        steps += seen
        ends = [False, False, True]
        buffer = EpisodeBuffer(
            id=number, observations=batched(space, seen), actions=[0] * 3, rewards=[0.0, 1.0, 1.0], terminations=ends,
            truncations=[False] * 3,
        )  # fmt: skip
        storage.update_episodes([buffer])
    storage.update_metadata({"dataset_id": "own-v0", "minari_version": minari.__version__})
    try:
        reader = reader_of(space)
    except UserError:
        reader = None
    try:
        data = stored(folder, "rewards")
    except UserError:
        return "refused"
    if not reader:
        return "of no environment"
    found = {state.tobytes() for state, _ in states_in(data)}
    wanted = {reader.read(step).tobytes() for step in steps}
    assert (data.observation_shape, data.labelled.observations.dtype) == (reader.shape, reader.dtype), space
    assert found == wanted, space
    return "equal"


KINDS = [check_hdf5, check_lerobot, check_minari]
MANY = pytest.param(300, marks=pytest.mark.slow)


@pytest.mark.filterwarnings("ignore:observations are read without")
@pytest.mark.parametrize("count", [10, MANY])
@pytest.mark.parametrize("check", KINDS)
def test_each_is_stored_as_it_is_or_refused(tmp_path: Path, check: Callable[[Path, Draw], str], count: int) -> None:
    outcomes: Counter[str] = Counter()
    for seed in range(count):
        folder = tmp_path / str(seed)
        folder.mkdir()
        outcomes[check(folder, np.random.default_rng(seed))] += 1
    assert outcomes["equal"] > count / 4, outcomes
