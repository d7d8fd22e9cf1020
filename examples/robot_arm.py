"""A simulated arm over a table with a block and a bin, seen by two cameras: what `robot_bin.py` records."""

import os
from collections.abc import Iterator
from pathlib import Path

os.environ.setdefault("MUJOCO_GL", "egl")  # renders without a screen
import mujoco
import numpy as np

CAMERAS, HEIGHT, WIDTH, FPS = ("front", "wrist"), 48, 64, 5
KEYS = [f"observation.images.{camera}" for camera in CAMERAS]
Frames = list[tuple[dict[str, np.ndarray], bool]]


class Arm:
    """Each move yields its frames."""

    def __init__(self, rng: np.random.Generator, bin_at: np.ndarray, block_at: np.ndarray):
        self.model, self.rng = mujoco.MjModel.from_xml_path(str(Path(__file__).with_name("robot_bin.xml"))), rng
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
