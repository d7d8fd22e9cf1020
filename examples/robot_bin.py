"""Is the block in the bin? A simulated arm with two cameras, its recordings, and the truth to judge classifiers by.

    python robot_bin.py record takes                     # a LeRobotDataset, labels of its demonstrations
    python robot_bin.py answer AUDIT takes labels.csv    # a person's answers to `hypogoal label --next`
    python robot_bin.py judge ENSEMBLE ...               # whom does an arm fool that stops at the first positive frame?

docs/robot.md tells the story. Needs `pip install 'hypogoal[lerobot]' mujoco` and, without a screen, an EGL driver.
"""

import argparse
import csv
import hashlib
import io
import json
import os
from collections.abc import Iterator
from pathlib import Path
from typing import Any

os.environ.setdefault("MUJOCO_GL", "egl")  # renders without a screen
import mujoco
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from PIL import Image

import hypogoal
from hypogoal.core.artefacts import open_artefact
from hypogoal.dataset import digest, open_dataset

GOAL, CAMERAS, HEIGHT, WIDTH, FPS = "block-in-bin", ("front", "wrist"), 48, 64, 5
KEYS = [f"observation.images.{camera}" for camera in CAMERAS]
SCENE = """
<mujoco>
  <option timestep="0.004"/>
  <visual><headlight ambient=".35 .35 .35" diffuse=".5 .5 .5"/></visual>
  <worldbody>
    <light name="lamp" castshadow="false" pos="0 0 1.5" diffuse=".5 .5 .5"/>
    <camera name="front" pos="0 -.55 .35" xyaxes="1 0 0 0 .45 .89" fovy="45"/>
    <geom type="box" pos="0 0 -.02" size=".5 .4 .02" rgba=".75 .68 .58 1"/>
    <body name="bin" mocap="true">
      <geom type="box" pos="0 0 .003" size=".05 .05 .003" rgba=".25 .3 .4 1"/>
      <geom type="box" pos=".05 0 .025" size=".004 .054 .025" rgba=".25 .3 .4 1"/>
      <geom type="box" pos="-.05 0 .025" size=".004 .054 .025" rgba=".25 .3 .4 1"/>
      <geom type="box" pos="0 .05 .025" size=".054 .004 .025" rgba=".25 .3 .4 1"/>
      <geom type="box" pos="0 -.05 .025" size=".054 .004 .025" rgba=".25 .3 .4 1"/>
    </body>
    <body name="block"><freejoint/><geom type="box" size=".015 .015 .015" mass=".05" rgba=".8 .25 .2 1"/></body>
    <body name="hand" mocap="true" pos="0 0 .2">
      <camera name="wrist" pos="0 -.07 .06" xyaxes="1 0 0 0 .91 .42" fovy="75"/>
      <geom type="box" pos="0 0 .05" size=".045 .02 .02" rgba=".9 .9 .9 1" contype="0" conaffinity="0"/>
      <geom type="cylinder" pos="0 0 .2" size=".02 .13" rgba=".5 .5 .55 1" contype="0" conaffinity="0"/>
    </body>
    <body name="left" mocap="true">
      <geom type="box" size=".006 .012 .03" rgba=".15 .15 .15 1" contype="0" conaffinity="0"/>
    </body>
    <body name="right" mocap="true">
      <geom type="box" size=".006 .012 .03" rgba=".15 .15 .15 1" contype="0" conaffinity="0"/>
    </body>
  </worldbody>
  <equality><weld name="grip" body1="hand" body2="block" relpose="0 0 -.02 1 0 0 0" active="false"/></equality>
</mujoco>
"""


class Arm:
    """A hand over a table with a block and a bin; each move yields its frames."""

    def __init__(self, rng: np.random.Generator, bin_at: np.ndarray, block_at: np.ndarray):
        self.model, self.rng = mujoco.MjModel.from_xml_string(SCENE), rng
        self.data, self.renderer = mujoco.MjData(self.model), mujoco.Renderer(self.model, HEIGHT, WIDTH)
        self.model.light("lamp").diffuse[:] = rng.uniform(0.35, 0.6)
        self.bin_at, self.hand, self.width = np.array([*bin_at, 0.0]), np.array([0.0, 0.12, 0.2]), 0.04
        self.data.qpos[:3] = [*block_at, 0.015]
        self.data.mocap_pos[0] = self.bin_at

    @property
    def block(self) -> np.ndarray:
        """Where the block is, (3,) metres."""
        return self.data.qpos[:3].copy()

    def frame(self) -> tuple[dict[str, np.ndarray], bool]:
        """What the cameras see, uint8 (HEIGHT, WIDTH, 3) each, and whether the block lies in the bin."""
        pictures = {}
        for camera, key in zip(CAMERAS, KEYS, strict=True):
            self.renderer.update_scene(self.data, camera)
            pictures[key] = self.renderer.render().copy()
        apart = np.abs(self.block - self.bin_at)
        return pictures, bool(apart[:2].max() < 0.05 and apart[2] < 0.04 and not self.data.eq_active[0])

    def move(self, to: np.ndarray, height: float, width: float, frames: int) -> Iterator[tuple[dict, bool]]:
        """Go there in so many frames, the fingers ``width`` metres from the middle at the end."""
        begin, end = np.array([*self.hand, self.width]), np.array([*to[:2], height, width])
        for share in np.linspace(0, 1, frames + 1)[1:]:
            goal = begin + (end - begin) * share + [*self.rng.normal(0, 0.003, 3), 0]
            start = np.array([*self.hand, self.width])
            steps = round(1 / FPS / self.model.opt.timestep)
            for step in range(1, steps + 1):
                *self.hand, self.width = start + (goal - start) * step / steps
                self.hand = np.array(self.hand)
                self.data.mocap_pos[1] = self.hand
                for finger, side in ((2, -1), (3, 1)):
                    self.data.mocap_pos[finger] = self.hand + np.array([side * self.width, 0, 0])
                mujoco.mj_step(self.model, self.data)
            yield self.frame()

    def fetch(self, grip: bool = True) -> Iterator[tuple[dict, bool]]:
        """Take the block, or close the fingers without it."""
        at = self.block
        yield from self.move(at, 0.12, 0.04, 4)
        yield from self.move(at, 0.04 if grip else 0.09, 0.04, 2)
        yield from self.move(at, 0.04 if grip else 0.09, 0.02, 1)
        self.data.eq_active[0] = grip
        yield from self.move(at, 0.16, 0.02, 2)

    def release(self, slip: float = 0) -> Iterator[tuple[dict, bool]]:
        """To the bin, open and wait there; with ``slip`` the block falls after that share of the way."""
        if slip:
            yield from self.move(self.hand + (self.bin_at - self.hand) * slip, 0.16, 0.02, 2)
            self.data.eq_active[0] = False
        yield from self.move(self.bin_at, 0.16, 0.02, 3)
        yield from self.move(self.bin_at, 0.12, 0.02, 2)
        self.data.eq_active[0] = False
        yield from self.move(self.bin_at, 0.13, 0.04, 1)
        yield from self.move(self.bin_at, 0.16, 0.04, 8)


Frames = list[tuple[dict[str, np.ndarray], bool]]


def play(rng: np.random.Generator, kind: str) -> Frames:
    """The frames of an episode: a ``demo`` in the one set-up; elsewhere a ``success``, ``miss``, ``slip`` or ``test``.

    In a test the arm first waits over the bin without the block, and then fetches it.
    """
    spread = 0.01 if kind == "demo" else 0.06
    bin_at, block_at = rng.normal(0, 1, (2, 2)).clip(-1.5, 1.5) * spread * [[1], [0.7]] + [[0.18, 0.04], [-0.14, 0]]
    slips = kind == "slip" or (kind == "test" and rng.random() < 0.5)
    arm = Arm(rng, bin_at, block_at)
    frames = [*arm.fetch(grip=slips or kind in ("demo", "success")), *arm.release(rng.uniform(0.3, 0.6) * slips)]
    frames += [*arm.fetch(), *arm.release()] if kind == "test" else []
    arm.renderer.close()
    return frames


def name_of(pictures: Any) -> str:
    """A name for what the cameras see."""
    return hashlib.sha256(b"".join(pictures[key].tobytes() for key in KEYS)).hexdigest()


def cell(picture: np.ndarray) -> dict[str, Any]:
    """A picture as a table keeps it."""
    file = io.BytesIO()
    Image.fromarray(picture).save(file, format="png")
    return {"bytes": file.getvalue(), "path": ""}


def record(folder: Path, seed: int, demos: int, others: int) -> None:
    """Write plays as a LeRobotDataset v2.1, a table of the demonstrations' positive frames, and each frame's truth."""
    kinds = ["demo"] * demos + ["success", "miss", "slip"] * others
    (folder / "meta").mkdir(parents=True)
    (folder / "data").mkdir()
    features = {key: {"dtype": "image", "shape": [HEIGHT, WIDTH, 3]} for key in KEYS}
    features |= {"timestamp": {"dtype": "float32", "shape": [1]}, "episode_index": {"dtype": "int64", "shape": [1]}}
    facts = {"codebase_version": "v2.1", "fps": FPS, "features": features}
    facts["data_path"] = "data/episode_{episode_index:06d}.parquet"
    (folder / "meta/info.json").write_text(json.dumps(facts))
    listed, labels, truth = "", "episode,from,to\n", {}
    for number, kind in enumerate(kinds):
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
    print(f"{len(kinds)} episodes, {len(truth)} different frames")


def answer(audit: Path, takes: Path, out: Path, count: int, random: int | None, table: Path | None) -> None:
    """Fill the first rows of an audit's table with the truth, and draw the first that fools a member.

    With ``random``, a seed, as many rows that are drawn at random instead: what the audit's choice is worth.
    """
    ensemble = open_artefact(audit, "recorded-audit").input("ensemble")
    states = open_dataset(open_artefact(ensemble, "ensemble").input("data")).unlabelled()
    truth = json.loads((takes / "truth.json").read_text())
    with (audit / f"next/{GOAL}.csv").open(newline="") as file:
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
    note(table, *([out.stem, member, count, inside.sum(), ""] for member, count in enumerate(fooled.sum(0))))
    if fooled.any():
        state = shown[fooled.any(1).argmax()]
        picture = Image.fromarray(np.concatenate([state[key] for key in KEYS], axis=1))
        picture.resize((6 * picture.width, 6 * picture.height), Image.Resampling.NEAREST).save(out.with_suffix(".png"))


def note(table: Path | None, *rows: list[Any]) -> None:
    """Append rows to a CSV: of answers the frames' false positives and successes, of a judge where plays ended."""
    if table is not None:
        new = not table.exists()
        with table.open("a", newline="") as file:
            writer = csv.writer(file, lineterminator="\n")
            writer.writerows([["name", "member", "false_positives", "successes", "never"]] * new + [*rows])


def judge(ensembles: list[Path], seed: int, count: int, table: Path | None) -> None:
    """Where the first positive frame of each fresh play is: at a false positive, at a success, nowhere."""
    plays = [play(np.random.default_rng([seed, number, 1]), "test") for number in range(count)]
    for path in ensembles:
        members = hypogoal.load_ensemble(path, GOAL)
        thresholds, ends = members.thresholds.cpu().numpy(), []
        for frames in plays:
            states = np.empty(len(frames), [(key, np.uint8, (HEIGHT, WIDTH, 3)) for key in KEYS])
            for key in KEYS:
                states[key] = [seen[key] for seen, _ in frames]
            positive, inside = members.predict(states) > thresholds, np.array([inside for _, inside in frames])
            first = positive.argmax(0)
            ends.append(np.where(positive.any(0), np.where(inside[first], 1, 0), 2))
        for member, column in enumerate(np.transpose(ends)):
            fooled, there, never = (int((column == end).sum()) for end in range(3))
            print(f"{path.name} {member}: fooled {fooled}, there {there}, never positive {never}")
            note(table, [path.name, member, fooled, there, never])


def main() -> None:
    """The command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    commands = parser.add_subparsers(dest="command", required=True)
    recorder, answers, judges = (commands.add_parser(name) for name in ("record", "answer", "judge"))
    recorder.add_argument("takes", type=Path)
    recorder.add_argument("--demos", type=int, default=9)
    recorder.add_argument("--others", type=int, default=6)
    answers.add_argument("audit", type=Path)
    answers.add_argument("takes", type=Path)
    answers.add_argument("out", type=Path)
    answers.add_argument("--random", type=int, metavar="SEED", help="frames drawn at random instead")
    answers.add_argument("--next", type=int, default=20)
    judges.add_argument("ensembles", type=Path, nargs="+")
    judges.add_argument("--plays", type=int, default=20)
    for part in (recorder, judges):
        part.add_argument("--seed", type=int, default=0)
    for part in (answers, judges):
        part.add_argument("--csv", type=Path, help="append the numbers")
    words = parser.parse_args()
    if words.command == "record":
        record(words.takes, words.seed, words.demos, words.others)
    elif words.command == "answer":
        answer(words.audit, words.takes, words.out, words.next, words.random, words.csv)
    else:
        judge(words.ensembles, words.seed, words.plays, words.csv)


if __name__ == "__main__":
    main()
