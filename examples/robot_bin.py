"""Is the block in the bin? Recordings of a simulated arm, and the truth to judge classifiers by.

    python robot_bin.py record takes                     # a LeRobotDataset, labels of its demonstrations
    python robot_bin.py answer AUDIT takes labels.csv    # a person's answers to what an audit proposes
    python robot_bin.py judge ENSEMBLE ...               # is an arm fooled that stops at the first positive frame?

docs/audit.md tells the story; in this folder:

    hypogoal import takes --label block-in-bin=takes/labels.csv --out runs/bin/data.h5
    LIKE="--set steps=150 --set learning_rate=1e-3 --set members=1 --set diversity=none"
    hypogoal train-ensemble runs/bin/data.h5 --out runs/bin/first $LIKE
    hypogoal audit runs/bin/first --out runs/bin/audit
    hypogoal import runs/bin/data.h5 --label block-in-bin=labels.csv --out runs/bin/more.h5
    hypogoal train-ensemble runs/bin/more.h5 --out runs/bin/second $LIKE

Needs `pip install 'hypogoal[lerobot]' mujoco` and, without a screen, an EGL driver.
"""

import csv
import hashlib
import io
import json
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import typer
from PIL import Image
from robot_arm import FPS, HEIGHT, KEYS, WIDTH, play

import hypogoal
from hypogoal.core.artefacts import TO_FILL_IN, open_artefact
from hypogoal.data import open_dataset
from hypogoal.observations import digest

GOAL = "block-in-bin"
FEATURES = {key: {"dtype": "image", "shape": [HEIGHT, WIDTH, 3]} for key in KEYS} | {
    "timestamp": {"dtype": "float32", "shape": [1]},
    "episode_index": {"dtype": "int64", "shape": [1]},
}
app = typer.Typer(help=__doc__, rich_markup_mode=None)


def name_of(pictures: Any) -> str:
    """A name for what the cameras see."""
    return hashlib.sha256(b"".join(pictures[key].tobytes() for key in KEYS)).hexdigest()


def cell(picture: np.ndarray) -> dict[str, Any]:
    """A picture as a table keeps it."""
    file = io.BytesIO()
    Image.fromarray(picture).save(file, format="png")
    return {"bytes": file.getvalue(), "path": ""}


@app.command()
def record(folder: Path, seed: int = 0, demos: int = 9, others: int = 6) -> None:
    """Write plays as a LeRobotDataset v2.1, a table of the demonstrations' positive frames, and each frame's truth."""
    (folder / "meta").mkdir(parents=True)
    (folder / "data").mkdir()
    facts = {"codebase_version": "v2.1", "fps": FPS, "features": FEATURES}
    facts["data_path"] = "data/episode_{episode_index:06d}.parquet"
    (folder / "meta/info.json").write_text(json.dumps(facts))
    listed, labels, truth = "", "episode,from,to\n", {}
    for number, kind in enumerate(["demo"] * demos + ["success", "miss", "slip"] * others):
        frames = play(np.random.default_rng([seed, number]), kind)
        table = {"timestamp": [at / FPS for at in range(len(frames))], "episode_index": [number] * len(frames)}
        pictures = {key: [cell(seen[key]) for seen, _ in frames] for key in KEYS}
        pq.write_table(pa.table({**table, **pictures}), folder / f"data/episode_{number:06d}.parquet")
        listed += json.dumps({"episode_index": number, "tasks": [GOAL], "length": len(frames)}) + "\n"
        if kind == "demo":  # the block stays in the bin
            labels += f"{number},{[inside for _, inside in frames].index(True)},{len(frames)}\n"
        truth |= {name_of(seen): inside for seen, inside in frames}
    (folder / "meta/episodes.jsonl").write_text(listed)
    (folder / "labels.csv").write_text(labels)
    (folder / "truth.json").write_text(json.dumps(truth))
    print(f"{demos + 3 * others} episodes, {len(truth)} different frames")


@app.command()
def answer(audit: Path, takes: Path, out: Path, count: int = 20, random: int | None = None) -> tuple[list[int], int]:
    """Fill the first rows of an audit's table with the truth, and draw the first that fools a member.

    With --random, a seed, as many rows that are drawn at random instead: what the audit's choice is worth.
    """
    ensemble = open_artefact(audit, "recorded-audit").input("ensemble")
    states = open_dataset(open_artefact(ensemble, "ensemble").input("data")).unlabelled()
    truth = json.loads((takes / "truth.json").read_text())
    with (audit / f"next/{GOAL}/{TO_FILL_IN}").open(newline="") as file:
        rows = list(csv.DictReader(file))[:count]
    if random is not None:
        drawn = np.random.default_rng(random).choice(len(states), count, replace=False).tolist()
        rows = [{**rows[0], "row": str(row), "digest": digest(states[row]).hex()} for row in drawn]
    shown = states[[int(row["row"]) for row in rows]]
    inside = np.array([truth[name_of(state)] for state in shown])
    members = hypogoal.load_ensemble(ensemble, GOAL)
    fooled = (members.predict(shown) > members.thresholds.cpu().numpy()) & ~inside[:, None]
    for row, label in zip(rows, inside, strict=True):
        row["label"] = str(int(label))
    with out.open("w", newline="") as file:
        writer = csv.DictWriter(file, list(rows[0]))
        writer.writeheader()
        writer.writerows(rows)
    print(f"{len(rows)} frames, {inside.sum()} successes; false positives by member: {fooled.sum(0).tolist()}")
    if fooled.any():
        state = shown[fooled.any(1).argmax()]
        picture = Image.fromarray(np.concatenate([state[key] for key in KEYS], axis=1))
        picture.resize((6 * picture.width, 6 * picture.height), Image.Resampling.NEAREST).save(out.with_suffix(".png"))
    return fooled.sum(0).tolist(), int(inside.sum())


@app.command()
def judge(ensembles: list[Path], seed: int = 0, plays: int = 20) -> dict[str, list[list[int]]]:
    """Where the first positive frame of each fresh play is: at a false positive, at a success, nowhere."""
    tests = [play(np.random.default_rng([seed, number, 1]), "test") for number in range(plays)]
    counts: dict[str, list[list[int]]] = {}
    for path in ensembles:
        members = hypogoal.load_ensemble(path, GOAL)
        thresholds, ends = members.thresholds.cpu().numpy(), []
        for frames in tests:
            states = np.empty(len(frames), [(key, np.uint8, (HEIGHT, WIDTH, 3)) for key in KEYS])
            for key in KEYS:
                states[key] = [seen[key] for seen, _ in frames]
            positive, inside = members.predict(states) > thresholds, np.array([inside for _, inside in frames])
            first = positive.argmax(0)
            ends.append(np.where(positive.any(0), np.where(inside[first], 1, 0), 2))
        counts[path.name] = [[int((column == end).sum()) for end in range(3)] for column in np.transpose(ends)]
        for member, (fooled, there, never) in enumerate(counts[path.name]):
            print(f"{path.name} {member}: fooled {fooled}, there {there}, never positive {never}")
    return counts


if __name__ == "__main__":
    app()
