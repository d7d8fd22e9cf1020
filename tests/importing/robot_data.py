"""Writers of recorded episodes, field by field as their formats are published: LeRobotDataset, robomimic, mp4 files.

Each episode is a light that wanders from left to right in what two cameras see; its place is the state. It is at the
goal where the light is right of the middle of the picture.
"""

import io
import json
from fractions import Fraction
from itertools import product
from pathlib import Path
from typing import Any

import av
import h5py
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from PIL import Image

FPS, SIDES, LENGTHS = 10, {"top": (96, 128), "wrist": (64, 64)}, (12, 9, 15, 10, 14, 11)
TOP, WRIST, STATE = "observation.images.top", "observation.images.wrist", "observation.state"


def places(episode: int) -> np.ndarray:
    """Where the light is in each frame, 0 to 1."""
    return np.linspace(0.05 + 0.0031 * episode, 0.6 + 0.0517 * episode, LENGTHS[episode]).astype(np.float32)


def picture(camera: str, place: float, episode: int) -> np.ndarray:
    """A frame, uint8 (H, W, 3)."""
    height, width = SIDES[camera]
    frame = np.full((height, width, 3), 20 + 10 * episode, np.uint8)
    left = int(place * (width - 16))
    frame[height // 4 : height // 2, left : left + 16] = (250, 240, 200)
    return frame


def episode_of(wrist: np.ndarray) -> int:
    """Which episode a picture of the wrist's camera is of: its background says so."""
    return round((float(np.median(wrist)) - 20) / 10)


def write_film(path: Path, frames: list[np.ndarray], fps: int = FPS) -> None:
    """An mp4 file, by default of the best codec that this build of FFmpeg has."""
    path.parent.mkdir(parents=True, exist_ok=True)
    codec = next(name for name in ("libx264", "libopenh264", "mpeg4") if name in av.codecs_available)
    with av.open(str(path), "w") as container:
        stream = container.add_stream(codec, rate=fps)
        stream.height, stream.width = frames[0].shape[:2]
        stream.pix_fmt, stream.bit_rate, stream.time_base = "yuv420p", 4_000_000, Fraction(1, fps)
        for number, values in enumerate(frames):
            frame = av.VideoFrame.from_ndarray(values, format="rgb24")
            frame.pts = number
            container.mux(stream.encode(frame))
        container.mux(stream.encode())


def columns(episode: int) -> dict[str, Any]:
    """An episode's columns of numbers; the third episode fails."""
    count, at = LENGTHS[episode], places(episode)
    success = (at > 0.5) & (episode != 2)
    return {
        STATE: pa.array(np.stack([at, 1 - at, at**2], 1).tolist(), pa.list_(pa.float32(), 3)),
        "action": pa.array([[0.0, 1.0]] * count, pa.list_(pa.float32(), 2)),
        "episode_index": pa.array(np.full(count, episode)),
        "next.reward": pa.array(success.astype(np.float32)),
        "next.success": pa.array(success),
    }


def facts(version: str, kind: str) -> dict[str, Any]:
    """``meta/info.json``: what of it is read."""
    features = {key: {"dtype": kind, "shape": [*SIDES[key.rpartition(".")[2]], 3]} for key in (TOP, WRIST)}
    features |= {name: {"dtype": "float32", "shape": [size]} for name, size in ((STATE, 3), ("action", 2))}
    features |= {name: {"dtype": "float32", "shape": [1]} for name in ("next.reward", "next.success")}
    files = "chunk-{chunk_index:03d}/file-{file_index:03d}"
    episodes = "episode_{episode_index:06d}"
    data, film = f"data/{files}.parquet", f"videos/{{video_key}}/{files}.mp4"
    if version == "v2.1":
        chunk = "chunk-{episode_chunk:03d}"
        data, film = f"data/{chunk}/{episodes}.parquet", f"videos/{chunk}/{{video_key}}/{episodes}.mp4"
    return {"fps": FPS, "chunks_size": 1000, "features": features, "data_path": data, "video_path": film}


def cells(camera: str, episode: int) -> pa.Array:
    """Frames as a table keeps them: ``{bytes, path}``."""
    rows = []
    for place in places(episode):
        file = io.BytesIO()
        Image.fromarray(picture(camera, place, episode)).save(file, format="png")
        rows.append({"bytes": file.getvalue(), "path": "frame.png"})
    return pa.array(rows, pa.struct({"bytes": pa.binary(), "path": pa.string()}))


def write_lerobot(folder: Path, version: str = "v3.0", kind: str = "video") -> Path:
    """A LeRobotDataset; in v3.0 two files share the episodes of each camera, and one table all of them."""
    for part in ("meta/episodes/chunk-000", "data/chunk-000"):
        (folder / part).mkdir(parents=True)
    (folder / "meta" / "info.json").write_text(json.dumps(facts(version, kind)))
    tables, listed = [], []
    for episode, length in enumerate(LENGTHS):
        rows = columns(episode)
        file, row = episode // 3, {"episode_index": episode, "length": length}
        for key in (TOP, WRIST):
            camera = key.rpartition(".")[2]
            begin = sum(LENGTHS[3 * file : episode])
            films = {"chunk_index": 0, "file_index": file, "from_timestamp": begin / FPS}
            if kind == "image":
                rows[key] = cells(camera, episode)
            elif version == "v2.1":
                shown = [picture(camera, place, episode) for place in places(episode)]
                write_film(folder / f"videos/chunk-000/{key}/episode_{episode:06d}.mp4", shown)
            else:
                row |= {f"videos/{key}/{name}": value for name, value in films.items()}
        tables.append(pa.table(rows))
        listed.append(row | ({} if version == "v2.1" else {"data/chunk_index": 0, "data/file_index": 0}))
        if version == "v2.1":
            pq.write_table(tables[-1], folder / f"data/chunk-000/episode_{episode:06d}.parquet")
    if version == "v2.1":
        (folder / "meta" / "episodes.jsonl").write_text("".join(json.dumps(row) + "\n" for row in listed))
        return folder
    pq.write_table(pa.concat_tables(tables), folder / "data/chunk-000/file-000.parquet")
    pq.write_table(pa.Table.from_pylist(listed), folder / "meta/episodes/chunk-000/file-000.parquet")
    for key, file in product((TOP, WRIST), (0, 1) if kind == "video" else ()):
        some = [(at, place) for at in range(3 * file, 3 * file + 3) for place in places(at)]
        frames = [picture(key.rpartition(".")[2], place, at) for at, place in some]
        write_film(folder / f"videos/{key}/chunk-000/file-{file:03d}.mp4", frames)
    return folder


def write_robomimic(path: Path) -> Path:
    """HDF5 as robomimic's ``dataset_states_to_obs.py`` writes it."""
    with h5py.File(path, "w") as file:
        file.create_group("data").attrs["total"] = sum(LENGTHS)
        for episode, length in enumerate(LENGTHS):
            demo = file["data"].create_group(f"demo_{episode}")
            demo.attrs["num_samples"] = length
            at = places(episode)
            demo["obs/agentview_image"] = np.stack([picture("top", place, episode) for place in at])
            demo["obs/robot0_eef_pos"] = np.stack([at, 1 - at, at**2], 1).astype(np.float64)
            demo["actions"] = np.zeros((length, 7))
            demo["rewards"] = (at > 0.5).astype(np.float64)
            demo["dones"] = np.arange(length) == length - 1
    return path


def write_films(folder: Path) -> Path:
    """A folder of mp4 files, and a table of where the light is at the goal; the last episode is not in it."""
    folder.mkdir()
    lines = ["episode,from,to"]
    for episode, length in enumerate(LENGTHS):
        write_film(folder / f"take-{episode}.mp4", [picture("top", place, episode) for place in places(episode)])
        if episode < len(LENGTHS) - 1:
            lines.append(f"take-{episode},{int((places(episode) <= 0.5).sum())},{length}")
    (folder / "labels.csv").write_text("\n".join(lines) + "\n")
    return folder
