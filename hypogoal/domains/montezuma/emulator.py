"""Montezuma's Revenge on the Arcade Learning Environment, with its RAM, its pictures, and the agent placed anywhere.

This module uses the raw emulator, because Gymnasium's wrappers cannot save, restore and write states, or skip drawing
frames that are not needed. The observations are those of the wrappers, pixel for pixel (a test compares them with
``AtariPreprocessing`` and ``FrameStackObservation``).
"""

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

from hypogoal.core.arrays import Bytes, Doubles, Ints
from hypogoal.core.errors import UserError

GAME = "montezuma_revenge"
FRAME_SKIP = 4  # frames per agent step; an observation takes the brighter of the last two frames, pixel by pixel
SIDE = 84  # pixels on a side of an observation
STACK = 4  # agent steps in an observation
OBSERVATION_SHAPE = (SIDE, SIDE, STACK)  # the oldest frame first
SCREEN = (210, 160)
N_ACTIONS = 18
ROOMS = 24

NOOP, FIRE, UP, RIGHT, LEFT, DOWN = range(6)

# Indices into the RAM, which are the console's addresses - 0x80. We found them by watching the emulator in play, and
# tests repeat that. Room, x, y and the inventory are also in the table of Anand et al. 2019, Unsupervised State
# Representation Learning in Atari.
RAM = {
    "room": 0x03,
    "x": 0x2A,
    "y": 0x2B,  # grows upwards, modulo 256
    "pose": 0x35,  # 8 idle or falling, 18 walking, 10 on a ladder, 6 jumping, 22 or 30 dying
    "dying": 0x37,  # counts down after a death; 0 alive
    "lives": 0x3A,  # spare lives
    "inventory": 0x41,  # bits: 01 hammer, 02-10 keys, 20 and 40 swords, 80 torch
    "object": 0x2C,  # x of a spider
    "skull": 0x2F,  # x of a skull, less an offset that the room sets
    "row": 0x50,  # the row of the pyramid, from the top
    "jump": 0x56,  # 255 on the ground, 19..0 in a jump
    "fall": 0x58,  # frames of free fall
}
# The bytes that are kept of a state. The state's labels and its kind follow from them.
FACTS = ("room", "x", "y", "skull", "object", "dying", "pose", "jump")
ROOM, X, Y, SKULL, OBJECT, DYING, POSE, JUMP = range(len(FACTS))
FACT_BYTES = [RAM[name] for name in FACTS]
TORCH = 0x80  # a bit of the inventory; without the torch, rooms 16 to 23 are dark
ON_LADDER = 10  # the pose on a ladder
FIRST_ROOM_OF_ROW = (0, 3, 8, 15)
RIGHT_EDGE, LEFT_EDGE, EDGE_Y = 146, 5, 235
ENTERED_FROM_RIGHT = (0, 3, 8, 10, 15, 16, 21)  # rooms with a wall on their left, or with no room there
FIRST_ROOM_FRAMES = 60  # frames until a new game accepts actions

# The agent is drawn in columns x - 1 .. x + 6 and rows 308 - y .. 327 - y, with x and y from RAM. We read this off the
# difference of screens with the agent at two places, and a test repeats it.
SPRITE_WIDTH, SPRITE_HEIGHT = 8, 20
SPRITE_LEFT, SPRITE_TOP = -1, 308
THREE_PLACES = (20, 75, 130)  # so far apart that the agent and its traces never overlap


Frames = tuple[Bytes, ...]  # the frames of the last four agent steps, uint8 (84, 84) each, the oldest first


class Position(NamedTuple):
    """The agent's position in RAM units."""

    room: int
    x: int
    y: int


class Snapshot(NamedTuple):
    """A state of the emulator, and the last frames before it, which the emulator does not keep."""

    state: Any  # an ``ALEState``
    seen: Frames


def stack_frames(seen: Sequence[Bytes]) -> Bytes:
    """Stack four frames (84, 84), the oldest first, as uint8 (84, 84, 4).

    This is ``np.stack(seen, axis=-1)``, but ten times faster.
    """
    import cv2

    merged: Any = cv2.merge(seen)
    return merged


def find_row(rooms: Any) -> Any:
    """Return the pyramid's row of a room 0..23, or of an array of rooms. The top row is 0."""
    return np.searchsorted(FIRST_ROOM_OF_ROW, rooms, side="right") - 1


class Emulator:
    """One deterministic game, with agent steps of four frames, and stacks of the frames of four steps.

    The game begins in the first room. It is never played to its end, because a lost life ends an episode, and each
    episode begins with all lives.

    Attributes:
        seen: the frames of the last four agent steps. Each step makes a new tuple, so a tuple never changes.

    Raises:
        UserError: if a package that plays the game is missing.
    """

    def __init__(self) -> None:
        try:
            import cv2
            from ale_py import ALEInterface, LoggerMode
            from ale_py.roms import get_rom_path
        except ImportError as error:
            raise UserError(
                f"Montezuma's Revenge cannot be played ({error})", GAME, "pip install 'hypogoal[montezuma]'."
            ) from None
        self._cv2 = cv2
        ALEInterface.setLoggerMode(LoggerMode.Error)
        self.ale = ALEInterface()
        self.ale.setInt("random_seed", 0)  # nothing depends on the seed, because no action is sticky
        self.ale.setFloat("repeat_action_probability", 0.0)
        self.ale.setInt("frame_skip", 1)
        rom: Any = get_rom_path(GAME)
        self.ale.loadROM(rom)
        self.actions = [*self.ale.getLegalActionSet()]
        self.seen: Frames = ()
        self._screens = [np.zeros(SCREEN, np.uint8) for _ in range(2)]
        self._entered: dict[int, Any] = {}
        self.frames(NOOP, FIRST_ROOM_FRAMES)
        self._first_room = self.ale.cloneState()

    @property
    def stack(self) -> Bytes:
        """The observation, uint8 (84, 84, 4), in a new array."""
        return stack_frames(self.seen)

    def step(self, action: int) -> float:
        """Play four frames of ``action`` (0..17). Return the sum of their rewards."""
        act, number = self.ale.act, self.actions[action]
        reward = 0.0
        for _ in range(FRAME_SKIP - len(self._screens)):
            reward += act(number)
        for screen in self._screens:
            reward += act(number)
            self.ale.getScreenGrayscale(screen)
        # NumPy's maximum would slow down the emulator's next frames by a seventh, if it uses AVX-512.
        brighter = self._cv2.max(*self._screens)
        frame: Any = self._cv2.resize(brighter, (SIDE, SIDE), interpolation=self._cv2.INTER_AREA)
        self.seen = (*self.seen[1 - STACK :], frame)
        return reward

    def frames(self, action: int, count: int) -> None:
        """Play ``count`` single frames of ``action`` without drawing. This is no agent step, so the stack stays."""
        for _ in range(count):
            self.ale.act(self.actions[action])

    def facts(self) -> Bytes:
        """Return the bytes of ``FACTS``, uint8 (8,), in a new array."""
        return self.ale.getRAM()[FACT_BYTES]

    def read(self, name: str) -> int:
        """Return one byte of ``RAM`` by name."""
        return int(self.ale.getRAM()[RAM[name]])

    def write(self, name: str, value: int) -> None:
        """Write one byte of ``RAM`` by name. The screen shows the change with the next frame."""
        self.ale.setRAM(RAM[name], value)

    def position(self) -> Position:
        """Return the agent's position."""
        return Position(self.read("room"), self.read("x"), self.read("y"))

    def alive(self) -> bool:
        """Return whether the agent is not dying."""
        return self.read("dying") == 0

    def save(self) -> Snapshot:
        """Return the current state, for :meth:`restore`."""
        return Snapshot(self.ale.cloneState(), self.seen)

    def restore(self, snapshot: Snapshot) -> None:
        """Return to a state that this emulator or another one saved. The screen shows the state after the next step."""
        self.ale.restoreState(snapshot.state)
        self.seen = snapshot.seen

    def place(self, room: int, x: int, y: int, *, phase: int = 2, settle: int = STACK) -> Snapshot | None:
        """Place the agent at (x, y) of a room, with the torch, ``phase`` frames after it entered the room.

        The agent enters through the room's side, from the neighbouring room, because writing the room's number alone
        draws half a room. Then the agent waits for ``settle`` agent steps. Returns the state, or None if the agent died
        meanwhile or left the room.
        """
        if room not in self._entered:
            self._entered[room] = self._enter(room)
        self.ale.restoreState(self._entered[room])
        self.frames(NOOP, phase)
        self.write("x", x)
        self.write("y", y)
        for _ in range(settle):
            self.step(NOOP)
        stays = self.read("room") == room
        return self.save() if stays and self.alive() else None

    def new_game(self, phase: int) -> Snapshot:
        """Begin a new game, and return its state.

        Once the agent may act, it waits for ``phase`` frames, and then for the agent steps that fill the stack.
        """
        self.ale.restoreState(self._first_room)
        self.frames(NOOP, phase)
        for _ in range(STACK):
            self.step(NOOP)
        return self.save()

    def _enter(self, room: int) -> Any:
        """Return the emulator's state right after the agent entered a room."""
        if room in ENTERED_FROM_RIGHT:
            neighbour, x, action = room + 1, LEFT_EDGE, LEFT
        else:
            neighbour, x, action = room - 1, RIGHT_EDGE, RIGHT
        self.ale.restoreState(self._first_room)
        self.write("row", int(find_row(room)))
        self.write("inventory", self.read("inventory") | TORCH)
        self.write("room", neighbour)
        self.write("x", x)
        self.write("y", EDGE_Y)
        while self.read("room") != room:  # at most 40 frames
            self.frames(action, 1)
        self.frames(NOOP, 2 * FRAME_SKIP)  # the old room's picture, then a black one
        return self.ale.cloneState()


def pixel(positions: Ints) -> Doubles:
    """Return the column and row of the agent's middle in the console's picture, (n, 2).

    ``positions`` (n, 3) are room, x and y.
    """
    _, x, y = positions.T
    columns = x + SPRITE_LEFT + (SPRITE_WIDTH - 1) / 2
    rows = SPRITE_TOP - y + (SPRITE_HEIGHT - 1) / 2
    return np.stack([columns, rows], axis=1)


def picture(emulator: Emulator, room: int) -> Bytes:
    """Draw a room as the console shows it, with enemies but without the agent, uint8 (210, 160, 3).

    The picture is the median of three pictures with the agent at three places, two of which agree at every pixel.
    """
    shots = []
    for x in THREE_PLACES:
        emulator.place(room, x, EDGE_Y, settle=0)
        emulator.frames(NOOP, 1)  # the next frame shows what was written
        shots.append(emulator.ale.getScreenRGB())
    return np.median(shots, axis=0).astype(np.uint8)
