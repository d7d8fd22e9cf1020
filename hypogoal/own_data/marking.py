"""Marking states by hand, recorded ones or those of an environment that is played: the window that shows them, and the
folder of images for ``import``, which is valid at any moment (Spec B6).
"""

from __future__ import annotations

import io
import os
from collections.abc import Callable, Sequence, Set
from hashlib import blake2b
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
from numpy.typing import NDArray

from hypogoal.core.drafts import sweep_up
from hypogoal.core.errors import UserError
from hypogoal.core.files import inside, replacing, sync
from hypogoal.core.own_code import UsersCode
from hypogoal.dataset import open_dataset
from hypogoal.domains.gymnasium_engine import begun, make_checked, reader_of, stepped
from hypogoal.own_data.arrays import read_states
from hypogoal.own_data.images import image_files, read_image, size_text
from hypogoal.own_data.marks import MarkedTable

KINDS = ("positive", "negative", "unlabelled")
HEIGHT = 520  # pixels of a picture, about
TEXT, LINE, WIDTH = 15, 20, 680
BACKGROUND, INK, MUTED = (250, 250, 250), (34, 34, 34), (110, 110, 110)
COLOURS = {"positive": (0, 120, 80), "negative": (190, 70, 0), "unlabelled": (0, 100, 170)}
UNSEEN = ("offscreen", "dummy")  # drivers that pygame silently uses without a screen
WAIT_MS = 100  # waiting for a key, before Ctrl-C in the terminal is noticed
REPEAT_MS = (300, 80)  # of a key held down: delay, interval
HELD = ("up", "down", "left", "right", "w", "a", "s", "d", "space")  # keys that may be held together


class Marks:
    """One file per state, ``folder/KIND/DIGEST.png`` (``.npy`` for a state that is no grey or colour image).

    Each mark is on the disk before the next key is read: a crash loses none. The last mark of a state counts. The
    folder is made with the first mark; existing marks are kept. A link that leads out of it is a ``UserError``.
    """

    def __init__(self, folder: Path, kinds: Sequence[str] = KINDS):
        self.folder, self.kinds = folder, tuple(kinds)
        self._files: dict[str, Path] = {}
        self._before: list[tuple[str, str | None]] = []
        for kind in self.kinds:
            if inside(folder, kind) is None:
                raise UserError("a folder of marks leads elsewhere", folder / kind, "Give another --out.")
            sweep_up(folder / kind)
            for file in sorted((folder / kind).glob("[!.]*")):
                if file.suffix in (".png", ".npy"):
                    self._files[file.stem] = file

    def of(self, state: NDArray[np.uint8]) -> str | None:
        """The mark of a state (H, W, C), or None."""
        file = self._files.get(_name(state))
        return file.parent.name if file else None

    def mark(self, state: NDArray[np.uint8], kind: str) -> None:
        """Mark a state, uint8 (H, W, C), or change its mark; a ``UserError`` if earlier states have another shape."""
        name, before = _name(state), self.of(state)
        if before is not None:
            self._move(name, kind)
            self._before.append((name, before))
            return
        if self._files and (shape := read_image(next(iter(self._files.values()))).shape) != state.shape:
            fault = f"the states are {size_text(state.shape)}, those marked before {size_text(shape)}"
            raise UserError(fault, self.folder, "Give another --out.")
        for each in self.kinds:
            (self.folder / each).mkdir(parents=True, exist_ok=True)
        suffix, content = _encoded(state)
        file = self.folder / kind / f"{name}{suffix}"
        with replacing(file) as fresh:
            fresh.write_bytes(content)
        self._files[name] = file
        self._before.append((name, None))

    def undo(self) -> bool:
        """Take back the last mark of this session; false if there is none."""
        if not self._before:
            return False
        name, kind = self._before.pop()
        if kind is None:
            self._files.pop(name).unlink(missing_ok=True)
        else:
            self._move(name, kind)
        return True

    def counts(self) -> dict[str, int]:
        """The number of states of each kind."""
        kinds = [file.parent.name for file in self._files.values()]
        return {kind: kinds.count(kind) for kind in self.kinds}

    def _move(self, name: str, kind: str) -> None:
        before = self._files[name]
        self._files[name] = before.replace(self.folder / kind / before.name)
        sync(self.folder / kind)


def _name(state: NDArray[np.uint8]) -> str:
    return blake2b(np.ascontiguousarray(state).tobytes(), digest_size=8).hexdigest()


def _encoded(state: NDArray[np.uint8]) -> tuple[str, bytes]:
    """Suffix and contents of a file that holds exactly this state."""
    from PIL import Image

    file = io.BytesIO()
    if state.shape[2] in (1, 3):
        Image.fromarray(state if state.shape[2] == 3 else state[..., 0]).save(file, format="png")
        return ".png", file.getvalue()
    np.save(file, np.ascontiguousarray(state), allow_pickle=False)
    return ".npy", file.getvalue()


def mark_states(source: Source, marks: Marks | MarkedTable, sub_goal: str) -> None:
    """Show the states of ``source`` and mark them by keyboard until the window is closed.

    A missing screen or pygame is a ``UserError``.
    """
    keys = {kind[0]: kind for kind in marks.kinds}  # p, n, u
    modes: list[str | None] = [None, *(kind for kind in ("negative", "unlabelled", "positive") if kind in marks.kinds)]
    mode: str | None = None
    with _Window(f"hypogoal: {sub_goal}") as window:
        while True:
            current = marks.of(source.state)
            lines = _lines(source, marks, sub_goal, mode, keys, current)
            window.draw(as_rgb(source.state), lines)
            key, held = window.next_key()
            if key == "escape":
                return
            if key in keys:
                marks.mark(source.state, keys[key])
                source.marked()
            elif key == "backspace":
                marks.undo()
            elif key == "m":
                mode = modes[(modes.index(mode) + 1) % len(modes)]
            elif source.press(key, held) and mode is not None and marks.of(source.state) is None:
                marks.mark(source.state, mode)


def _lines(
    source: Source,
    marks: Marks | MarkedTable,
    sub_goal: str,
    mode: str | None,
    keys: dict[str, str],
    current: str | None,
) -> list[tuple[str, tuple[int, int, int]]]:
    """The lines below the picture, each with its colour."""
    counts = ", ".join(f"{count} {kind}" for kind, count in marks.counts().items())
    says = ", ".join(f"{key}: {kind}" for key, kind in keys.items())
    meanwhile = f"every new state is marked {mode}" if mode else "states are marked by hand only"
    lines = [
        (f"{sub_goal}: {current or 'not marked'}", COLOURS.get(current or "", INK)),
        (f"{source.note}", INK),
        (f"marked: {counts}", INK),
        (f"m: {meanwhile}", COLOURS.get(mode or "", MUTED)),
        (f"{says}, backspace: undo, escape: end", MUTED),
    ]
    return lines + [(line, MUTED) for line in source.help]


def as_rgb(state: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """A state (H, W, C) as a picture (H', W', 3); of a stack of frames the last is large, earlier ones beside it."""
    channels = state.shape[2]
    if channels == 3:
        return state
    *before, last = (state[..., channel] for channel in range(channels))
    if before:
        large = last.repeat(channels - 1, axis=0).repeat(channels - 1, axis=1)
        last = np.concatenate([large, np.concatenate(before, axis=0)], axis=1)
    return np.repeat(last[..., None], 3, axis=2)


class _Window:
    """A window of pygame: a picture with lines of text below it, and the keys."""

    def __init__(self, title: str):
        os.environ.setdefault("PYGAME_HIDE_SUPPORT_PROMPT", "1")
        try:
            import pygame
        except ImportError:
            raise UserError("the window needs pygame", None, "pip install pygame-ce") from None
        self._pygame, self._title = pygame, title
        self._surface: Any = None

    def __enter__(self) -> _Window:
        pygame = self._pygame
        try:
            pygame.display.init()
            pygame.font.init()
            pygame.key.set_repeat(*REPEAT_MS)
            pygame.display.set_caption(self._title)
            driver = pygame.display.get_driver()
            if driver in UNSEEN and os.environ.get("SDL_VIDEODRIVER") != driver:
                raise pygame.error("no screen")
            self._surface = pygame.display.set_mode((WIDTH, HEIGHT))
        except pygame.error as error:
            pygame.quit()
            do = "Use a machine with a screen, or ssh -X."
            raise UserError(f"no window can be opened: {error}", None, do) from None
        self._font = pygame.font.SysFont("dejavusans, arial, sans", TEXT)
        return self

    def __exit__(self, *_exception: object) -> None:
        self._pygame.quit()

    def draw(self, picture: NDArray[np.uint8], lines: Sequence[tuple[str, tuple[int, int, int]]]) -> None:
        """The picture (H, W, 3), as large as fits by a whole factor, and the lines."""
        pygame: Any = self._pygame
        height, width = picture.shape[:2]
        factor = max(1, min(HEIGHT // height, WIDTH // width))
        whole = (max(WIDTH, width * factor), height * factor + LINE * (len(lines) + 1))
        if self._surface.get_size() != whole:
            self._surface = pygame.display.set_mode(whole)
        self._surface.fill(BACKGROUND)
        large = picture.repeat(factor, axis=0).repeat(factor, axis=1)
        left = (whole[0] - width * factor) // 2
        self._surface.blit(pygame.surfarray.make_surface(large.swapaxes(0, 1)), (left, 0))
        for number, (line, colour) in enumerate(lines):
            drawn = self._font.render(line, True, colour)
            self._surface.blit(drawn, (10, height * factor + LINE // 2 + number * LINE))
        pygame.display.flip()

    def next_key(self) -> tuple[str, frozenset[str]]:
        """The next key pressed, and the keys held; closing the window is ``escape``."""
        pygame: Any = self._pygame
        while True:
            event = pygame.event.wait(WAIT_MS)
            if event.type == pygame.QUIT:
                return "escape", frozenset()
            if event.type == pygame.KEYDOWN:
                pressed = pygame.key.get_pressed()
                held = frozenset(name for name in HELD if pressed[pygame.key.key_code(name)])
                return pygame.key.name(event.key), held


GRID_KEYS = {
    "left": ("left", "a"),
    "right": ("right", "d"),
    "forward": ("up", "w"),
    "toggle": ("space",),
    "pickup": ("page up", "e"),
    "drop": ("page down", "q"),
    "done": ("return",),
}
"""Keys of actions with MiniGrid's names; the first key is that of MiniGrid's manual control."""

DIRECTIONS = {
    "UP": ("up", "w"), "RIGHT": ("right", "d"), "LEFT": ("left", "a"), "DOWN": ("down", "s"), "FIRE": ("space",)
}  # fmt: skip
WAITS = "return"  # the key of NOOP
FALLBACK = tuple("0123456789bcfghijkotvxyz")
"""Keys of other actions: their number, from 10 on a letter that is not used otherwise."""


class Source:
    """States shown one at a time."""

    state: NDArray[np.uint8]  # the one shown, (H, W, C)
    note: str  # where it is from
    help: tuple[str, ...]  # lines that explain the keys

    def press(self, key: str, held: Set[str]) -> bool:
        """React to a key while others are ``held``; returns whether the state changed."""
        raise NotImplementedError

    def marked(self) -> None:
        """React to a mark; by default nothing happens."""


class Recorded(Source):
    """Recorded states, (N, H, W, C); after a mark the next one is shown."""

    help = ("left, right: the state before, the next one", "page up, page down: ten at once")

    def __init__(self, states: Sequence[NDArray[np.uint8]] | NDArray[np.uint8]):
        self._states = states
        self._show(0)

    def _show(self, index: int) -> None:
        self._index, self.state = index, self._states[index]
        self.note = f"state {index + 1} of {len(self._states)}"

    def press(self, key: str, held: Set[str]) -> bool:
        """Go one or ten states forward or back."""
        before, steps = self._index, {"left": -1, "right": 1, "page up": -10, "page down": 10}
        self._show(min(max(before + steps.get(key, 0), 0), len(self._states) - 1))
        return self._index != before

    def marked(self) -> None:
        """Show the next state."""
        self.press("right", frozenset())


class Played(Source):
    """An environment played by keyboard; its states are those that an agent would see.

    ``make`` makes it, with observations uint8 (H, W, C) or (H, W) and ``Discrete`` actions, else a ``UserError``.
    ``reset`` gets ``layout_seed``; the next layout has the next seed. ``recorded``: layout seed and actions of each
    episode.
    """

    def __init__(self, make: Callable[[], gymnasium.Env], layout_seed: int = 0):
        self._env = make_checked(make)
        self._look = reader_of(self._env)
        _require_images(self._look.dtype, self._env.observation_space)
        self._names = action_names(self._env)
        self._layout = layout_seed
        self.recorded: list[tuple[int, list[int]]] = []
        self.help = (*action_help(self._names), "r: begin again, l: next layout")
        self._begin()

    def _begin(self) -> None:
        observation, _info = begun(self._env, seed=self._layout)
        self.recorded.append((self._layout, []))
        self._show(observation, 0, over=False)

    def _show(self, observation: Any, steps: int, *, over: bool) -> None:
        self.state = self._look.read(self._env, observation)
        self._steps, self._over = steps, over
        ended = "; the episode is over, any action begins another" if over else ""
        self.note = f"layout seed {self._layout}, step {steps}{ended}"

    def press(self, key: str, held: Set[str]) -> bool:
        """Play the action of a key, or of the keys held together."""
        if key in ("r", "l"):
            self._layout += key == "l"
            self._begin()
            return True
        action = action_of(self._names, key, held)
        if action is None:
            return False
        if self._over:
            self._begin()
            return True
        observation, _reward, terminated, truncated, _info = stepped(self._env, action)
        self.recorded[-1][1].append(action)
        self._show(observation, self._steps + 1, over=terminated or truncated)
        return True


def action_names(env: gymnasium.Env) -> tuple[str, ...]:
    """The names of an environment's actions (MiniGrid's ``actions``, Atari's meanings), or their numbers."""
    count = int(env.action_space.n)  # type: ignore[attr-defined]
    with UsersCode("the names of the environment's actions", env):
        inner = env.unwrapped
        if hasattr(inner, "get_action_meanings"):
            names = tuple(map(str, inner.get_action_meanings()))
        else:
            names = tuple(str(getattr(action, "name", action)) for action in getattr(inner, "actions", ()))
    return names if len(names) == count else tuple(map(str, range(count)))


def action_of(names: Sequence[str], key: str, held: Set[str]) -> int | None:
    """The action of a key: by name for MiniGrid, by the keys held together for Atari, else by number."""
    if "NOOP" in names:
        if key == WAITS:
            return names.index("NOOP")
        down = {key, *held}
        axes = (("UP", "DOWN"), ("RIGHT", "LEFT"), ("FIRE",))  # the first one held of each
        name = "".join(next((part for part in axis if down & set(DIRECTIONS[part])), "") for axis in axes)
        return names.index(name) if name in names else None
    return next((index for index, keys in enumerate(keys_of(names)) if key in keys), None)


def keys_of(names: Sequence[str]) -> list[tuple[str, ...]]:
    """The keys of each action: those of its name, else one of ``FALLBACK``, which may run out."""
    return [GRID_KEYS.get(name) or FALLBACK[index : index + 1] for index, name in enumerate(names)]


def action_help(names: Sequence[str]) -> tuple[str, ...]:
    """Lines that list the keys of the actions."""
    if "NOOP" in names:
        return (f"arrows or w a s d, space: move, fire; together, too; {WAITS}: wait",)
    texts = [f"{' or '.join(keys) or 'no key'}: {name}" for name, keys in zip(names, keys_of(names), strict=True)]
    return tuple(", ".join(texts[first : first + 3]) for first in range(0, len(texts), 3))


def recorded_states(path: Path) -> Sequence[NDArray[np.uint8]]:
    """The unlabelled states of a data file or ``.npz`` file, or the images of a folder; else a ``UserError``."""
    if path.is_dir():
        return [read_image(file) for file in image_files(path)]
    states: Any = read_states(path) if path.suffix == ".npz" else open_dataset(path).unlabelled()
    _require_images(states.dtype, path)
    return states


def _require_images(dtype: np.dtype[Any], where: object) -> None:
    if dtype != np.uint8:
        raise UserError("only observations that are images can be shown", where, "Label states by functions: collect.")
