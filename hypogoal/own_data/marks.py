"""States that a person marks one by one: the folder of images that ``import`` takes, whole at any moment (Spec B6)."""

from __future__ import annotations

import io
from collections.abc import Sequence
from hashlib import blake2b
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from hypogoal.core.errors import UserError
from hypogoal.core.files import replace_file, sync
from hypogoal.own_data.images import read_image

KINDS = ("positive", "negative", "unlabelled")


class Marks:
    """One file a state, ``folder/KIND/DIGEST.png`` (``.npy`` where a state is no grey or colour image).

    Each mark is on the disk before the next key is read: a crash loses none. A state is marked once, the last word
    counts.

    Args:
        folder: where, made with the first mark; what is in it already is gone on with.
        kinds: the marks that there are.
    """

    def __init__(self, folder: Path, kinds: Sequence[str] = KINDS):
        self.folder, self.kinds = folder, tuple(kinds)
        self._files: dict[str, Path] = {}
        self._before: list[tuple[str, str | None]] = []
        for kind in self.kinds:
            for file in sorted((folder / kind).glob("[!.]*")):
                if file.suffix in (".png", ".npy"):
                    self._files[file.stem] = file

    def of(self, state: NDArray[np.uint8]) -> str | None:
        """How a state (H, W, C) is marked."""
        file = self._files.get(_name(state))
        return file.parent.name if file else None

    def mark(self, state: NDArray[np.uint8], kind: str) -> None:
        """Mark a state, uint8 (H, W, C); another mark of it is taken back.

        Raises:
            UserError: states marked before are of another shape.
        """
        name, before = _name(state), self.of(state)
        if before is not None:
            self._move(name, kind)
            self._before.append((name, before))
            return
        self._require_like(state)
        for each in self.kinds:
            (self.folder / each).mkdir(parents=True, exist_ok=True)
        suffix, content = _encoded(state)
        file = self.folder / kind / f"{name}{suffix}"
        fresh = file.with_name(f".{file.name}.new")
        try:
            fresh.write_bytes(content)
            replace_file(fresh, file)
        finally:
            fresh.unlink(missing_ok=True)
        self._files[name] = file
        self._before.append((name, None))

    def undo(self) -> bool:
        """Take back the last mark made since this was opened; false where there is none."""
        if not self._before:
            return False
        name, kind = self._before.pop()
        if kind is None:
            self._files.pop(name).unlink(missing_ok=True)
        else:
            self._move(name, kind)
        return True

    def counts(self) -> dict[str, int]:
        """States of each kind."""
        found = [file.parent.name for file in self._files.values()]
        return {kind: found.count(kind) for kind in self.kinds}

    def _move(self, name: str, kind: str) -> None:
        before = self._files[name]
        self._files[name] = before.replace(self.folder / kind / before.name)
        sync(self.folder / kind)

    def _require_like(self, state: NDArray[np.uint8]) -> None:
        known = next(iter(self._files.values()), None)
        if known is None:
            return
        shape = read_image(known).shape
        if shape != state.shape:
            what = f"the states are {_text(state.shape)}, those marked before {_text(shape)}"
            raise UserError(what, self.folder, "Give another --out.")


def _name(state: NDArray[np.uint8]) -> str:
    return blake2b(np.ascontiguousarray(state).tobytes(), digest_size=8).hexdigest()


def _encoded(state: NDArray[np.uint8]) -> tuple[str, bytes]:
    """Suffix and content of a file that holds exactly this state."""
    from PIL import Image

    file = io.BytesIO()
    if state.shape[2] in (1, 3):
        Image.fromarray(state if state.shape[2] == 3 else state[..., 0]).save(file, format="png")
        return ".png", file.getvalue()
    np.save(file, np.ascontiguousarray(state), allow_pickle=False)
    return ".npy", file.getvalue()


def _text(shape: Sequence[int]) -> str:
    return " x ".join(map(str, shape))
