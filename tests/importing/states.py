"""States that users bring: a white square at the left or at the right of grey noise."""

import tempfile
from collections import Counter
from collections.abc import Callable
from pathlib import Path
from typing import Any

import minari
import numpy as np
from gymnasium import spaces
from minari.data_collector import EpisodeBuffer
from minari.dataset.minari_storage import MinariStorage
from PIL import Image

from hypogoal.data import Collected
from hypogoal.importing.assemble import assemble
from hypogoal.importing.labels import labels_of
from hypogoal.importing.recordings import episodes_of, read_arrays
from hypogoal.importing.states import frames_of

SIDE = 48
KINDS = ("positive", "negative", "unlabelled")


def pictures(count: int, seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
    """Pictures uint8 (count, 48, 48, 3), and whether the square is at the right."""
    rng = np.random.default_rng(seed)
    images = rng.integers(0, 60, size=(count, SIDE, SIDE, 3), dtype=np.uint8)
    labels = np.arange(count) % 2 == 1
    for image, right in zip(images, labels, strict=True):
        image[10:30, (30 if right else 5) : (42 if right else 17)] = 255
    return images, labels


def arrays(**changes: Any) -> dict[str, Any]:
    """What ``numpy.savez`` is to write; a change to None leaves an array out."""
    (images, labels), (others, _), (held, known) = pictures(40), pictures(20, 1), pictures(16, 2)
    whole = {
        "observations": images, "labels": labels, "unlabelled": others, "heldout_observations": held,
        "heldout_labels": known,
    }  # fmt: skip
    return {name: value for name, value in (whole | changes).items() if value is not None}


def assembled(given: dict[str, Any], group: str = "") -> tuple[Collected, list[str]]:
    """Arrays as a data file has them, and what is said of them; their one sub-goal is called ``goal``."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder, "own.npz")
        np.savez(path, **given)
        left: Counter[str] = Counter()
        frames = frames_of(path, episodes_of(read_arrays(path, left), ["goal"], group, left), left)
        labels = labels_of(frames, {"goal": "goal"})
        collected, said = assemble(path, frames, labels, ["goal"], [*given.get("features", ())])
        return collected, [*said, *left]


def save_pictures(folder: Path, *, held: bool = True, change: Callable[[np.ndarray], np.ndarray] = lambda x: x) -> Path:
    """A folder of pictures of one sub-goal, each after ``change``."""
    for seed, count, inner in ((0, 24, ""), (2, 6 * held, "heldout")):
        for number, (image, label) in enumerate(zip(*pictures(count, seed), strict=True)):
            kinds = ["positive" if label else "negative", *(["unlabelled"] if number % 3 == 0 and not inner else [])]
            for kind in kinds:
                file = folder / inner / kind / f"{number:02d}.png"
                file.parent.mkdir(parents=True, exist_ok=True)
                Image.fromarray(change(image)).save(file)
    return folder


def save_minari(folder: Path, episodes: int = 10, *, nested: bool = False) -> Path:
    """A Minari dataset of six states an episode, three of them with the square at the right, and a table of these."""
    picture = spaces.Box(0, 255, (SIDE, SIDE, 3), np.uint8)
    speed = spaces.Box(-99, 99, (2,), np.float64)
    space = spaces.Dict(image=picture, arm=spaces.Dict(speed=speed), task=spaces.Text(9)) if nested else picture
    (folder / "data").mkdir(parents=True)
    storage = MinariStorage.new(folder / "data", space, spaces.Discrete(2), jpeg_encoding=False)
    for number in range(episodes):
        seen: Any = pictures(6, number)[0]
        if nested:
            seen = {"image": seen, "arm": {"speed": np.arange(12.0).reshape(6, 2)}, "task": ["open"] * 6}
        ends = [False] * 4 + [True]
        buffer = EpisodeBuffer(
            id=number, observations=seen, actions=[0] * 5, rewards=[0.0] * 5, terminations=ends, truncations=[False] * 5
        )
        storage.update_episodes([buffer])
    storage.update_metadata({"dataset_id": "own-v0", "minari_version": minari.__version__})
    lines = [f"episode_{number},{frame},{frame + 1}" for number in range(episodes) for frame in (1, 3, 5)]
    (folder / "right.csv").write_text("\n".join(["episode,from,to", *lines, ""]))
    return folder
