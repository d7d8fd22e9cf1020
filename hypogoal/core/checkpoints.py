"""Checkpoints: all that a stage needs to resume, saved while it works (Spec G1, G3).

A state is nested dicts and lists of arrays, tensors and plain JSON values; objects give it as ``snapshot()`` and take
it back with ``restore(snapshot)``. One state is one safetensors file with its JSON part as bytes; no pickle. It is
private to its stage and version; a state that does not fit raises an error where it is restored.
"""

from __future__ import annotations

import contextlib
import copy
import json
import os
import signal
import threading
import time
import zlib
from collections import deque
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from types import FrameType
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from hypogoal.core.errors import UserError
from hypogoal.core.files import replace_file
from hypogoal.core.processes import SIGNALS, stop

if TYPE_CHECKING:
    import torch

State = dict[str, Any]

FEWEST_SECONDS = 10.0  # between two checkpoints
WAIT_PER_COST = 30.0  # and at least 30 times as long as saving took: at most 3 % of a run
PACE = "HYPOGOAL_CHECKPOINT_SECONDS"  # in the environment: the seconds between two instead, for tests
JSON_PART, SUM_PART = "json-7", "crc32"  # raise the number when the contents of states change
ARRAY, TENSOR = "$array", "$tensor"
ANEW = "Give --force and no --resume to begin anew."


class Checkpoints:
    """One state on disk, replaced from time to time; the old file stays until the new one is whole.

    As a context, Ctrl-C and SIGTERM wait for the next :meth:`offer`, which saves and raises ``KeyboardInterrupt`` with
    the signal's number. A second Ctrl-C does not wait. With ``path`` None nothing is ever saved.
    """

    def __init__(self, path: Path | None):
        self.path = path
        pace = os.environ.get(PACE)
        self._fixed = float(pace) if pace else None
        self._next = time.monotonic() + (FEWEST_SECONDS if self._fixed is None else self._fixed)
        self._signal: int | None = None
        self._interrupted = False
        self._handlers: dict[int, Any] = {}

    def __enter__(self) -> Checkpoints:
        self._signal, self._interrupted, self._handlers = None, False, {}
        if threading.current_thread() is threading.main_thread():  # other threads cannot set handlers
            for number in SIGNALS:
                if signal.getsignal(number) is not signal.SIG_IGN:
                    self._handlers[number] = signal.signal(number, self._note)
        return self

    def __exit__(self, kind: object, error: BaseException | None, trace: object) -> None:
        for number, handler in self._handlers.items():
            signal.signal(number, handler)
        if self._signal is not None and kind is None:
            raise KeyboardInterrupt(self._signal)
        if self._signal is None or isinstance(error, KeyboardInterrupt):
            return
        if self._handlers.get(self._signal) is signal.SIG_DFL:
            signal.raise_signal(self._signal)  # a pool's process that failed must still obey the signal

    def _note(self, number: int, frame: FrameType | None) -> None:
        if number == signal.SIGINT and self._interrupted:
            stop(number, frame)
        self._interrupted |= number == signal.SIGINT  # the first Ctrl-C; a run forwards SIGTERM
        self._signal = self._signal or number

    @property
    def saved(self) -> bool:
        """Whether a checkpoint exists."""
        return self.path is not None and self.path.is_file()

    def offer(self, state: Callable[[], State]) -> None:
        """Save ``state()`` if it is due or a signal came; after a signal raise ``KeyboardInterrupt``."""
        if self._signal is None and time.monotonic() < self._next:
            return
        begun = time.monotonic()
        if self.path is not None:
            self.save(state())
        now = time.monotonic()
        pace = max(FEWEST_SECONDS, WAIT_PER_COST * (now - begun)) if self._fixed is None else self._fixed
        self._next = now + pace
        if self._signal is not None:
            raise KeyboardInterrupt(self._signal)

    def save(self, state: State) -> None:
        """Write ``state``. If that fails, a ``UserError``; the previous checkpoint stays.

        A state with NaN or Inf in a tensor is not written: the last good one stays (Spec G3).
        """
        from safetensors import SafetensorError
        from safetensors.numpy import save_file

        if self.path is None:
            return
        arrays: dict[str, NDArray[Any]] = {}
        tensors: dict[str, NDArray[Any]] = {}
        tree = _taken_apart(state, "", arrays, tensors)
        if not all(np.isfinite(values).all() for values in tensors.values() if values.dtype.kind == "f"):
            return
        text = np.frombuffer(json.dumps(tree).encode(), np.uint8)
        fresh = self.path.with_suffix(".new")
        try:
            self.path.parent.mkdir(exist_ok=True)
            parts = {**arrays, **tensors, JSON_PART: text}
            save_file({**parts, SUM_PART: _checksum(parts)}, fresh)
            replace_file(fresh, self.path)
        except (OSError, SafetensorError) as error:
            fresh.unlink(missing_ok=True)
            fault = f"a checkpoint cannot be written ({error})"
            raise UserError(fault, self.path, "Free some disk space, then continue with --resume.") from None

    def load(self) -> State | None:
        """The saved state, or None. A damaged file is a ``UserError``."""
        from safetensors import SafetensorError
        from safetensors.numpy import load_file

        if self.path is None or not self.saved:
            return None
        try:
            arrays = load_file(self.path)
            if not np.array_equal(arrays.pop(SUM_PART), _checksum(arrays)):
                raise ValueError
            state: State = _put_together(json.loads(arrays.pop(JSON_PART).tobytes()), arrays)
        except (SafetensorError, KeyError, TypeError, ValueError, RecursionError):
            fault = "the checkpoint is damaged, or of an earlier version"
            raise UserError(fault, self.path, ANEW) from None
        return state

    @contextlib.contextmanager
    def restoring(self) -> Iterator[None]:
        """Restore a state in the block; any error that a state which does not fit raises becomes a ``UserError``.

        Its checksum was right, so it is from another stage, version or author.
        """
        from hypogoal.core.own_code import of_user

        try:
            yield
        except (LookupError, ValueError, TypeError, AttributeError, ArithmeticError, RuntimeError) as error:
            if of_user(error) is not None:
                raise
            fault = f"{type(error).__name__}: {error}".partition("\n")[0]
            raise UserError(f"the checkpoint does not fit this stage ({fault})", self.path, ANEW) from error


def _checksum(parts: Mapping[str, NDArray[Any]]) -> NDArray[np.uint32]:
    """The CRC-32 of all parts: without it, a byte changed on disk would silently change weights."""
    value = 0
    for place, values in sorted(parts.items()):
        value = zlib.crc32(f"{place} {values.dtype} {values.shape}".encode(), value)
        value = zlib.crc32(values.reshape(-1).view(np.uint8).data, value)
    return np.array([value], np.uint32)


def _taken_apart(value: Any, place: str, arrays: State, tensors: State) -> Any:
    """``value`` as plain JSON values; its arrays and tensors go into ``arrays`` and ``tensors`` by place."""
    if isinstance(value, dict):
        return {key: _taken_apart(item, f"{place}/{key}", arrays, tensors) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [_taken_apart(item, f"{place}/{number}", arrays, tensors) for number, item in enumerate(value)]
    if isinstance(value, np.ndarray):
        arrays[place] = np.asarray(value, order="C")
        return {ARRAY: place}
    if isinstance(value, np.generic):
        return value.item()
    if hasattr(value, "detach"):
        tensors[place] = np.asarray(value.detach().cpu().numpy(), order="C")
        return {TENSOR: place}
    return value


def _put_together(value: Any, arrays: Mapping[str, NDArray[Any]]) -> Any:
    if isinstance(value, list):
        return [_put_together(item, arrays) for item in value]
    if not isinstance(value, dict):
        return value
    if value.keys() == {ARRAY}:
        return arrays[value[ARRAY]]
    if value.keys() == {TENSOR}:
        import torch

        return torch.from_numpy(arrays[value[TENSOR]]).clone()
    return {key: _put_together(item, arrays) for key, item in value.items()}


def optimiser_snapshot(optimiser: torch.optim.Optimizer) -> State:
    """Adam's moments and step counts of each parameter that was updated; its settings come from the configuration."""
    return {str(number): moments for number, moments in optimiser.state_dict()["state"].items()}


def restore_optimiser(optimiser: torch.optim.Optimizer, snapshot: State) -> None:
    """Continue from an ``optimiser_snapshot`` of an optimiser of the same parameters."""
    state = {int(number): moments for number, moments in snapshot.items()}
    optimiser.load_state_dict({"state": state, "param_groups": optimiser.state_dict()["param_groups"]})


class Resumable:
    """An object that continues after a break as if there had been none, from a snapshot of what changes.

    Attributes:
        CHANGING: the names of the attributes that change. Each is a network, an optimiser, a random generator, a
            tensor, a deque, itself resumable, a list of such, or of arrays, numbers, lists, dicts by name and None.
    """

    CHANGING: ClassVar[tuple[str, ...]] = ()

    def snapshot(self) -> State:
        """All that a resumed run needs to continue exactly; valid until the next step."""
        return {name: _taken(getattr(self, name)) for name in self.CHANGING}

    def restore(self, snapshot: Mapping[str, Any]) -> None:
        """Continue from a ``snapshot`` of an object made with the same arguments."""
        for name in self.CHANGING:
            setattr(self, name, _restored(getattr(self, name), snapshot[name]))


def _taken(value: Any) -> Any:
    import torch

    if isinstance(value, Resumable):
        return value.snapshot()
    if isinstance(value, list | deque):
        return list(map(_taken, value))
    if isinstance(value, torch.nn.Module):
        return value.state_dict()
    if isinstance(value, torch.optim.Optimizer):
        return optimiser_snapshot(value)
    if isinstance(value, torch.Generator):
        return value.get_state()
    return value.bit_generator.state if isinstance(value, np.random.Generator) else value


def _restored(value: Any, saved: Any) -> Any:
    """``value`` with the saved contents, changed in place where other objects share it."""
    import torch

    if isinstance(value, Resumable):
        value.restore(saved)
    elif isinstance(value, deque):
        value.clear()
        value.extend(saved)
    elif isinstance(value, list) and value and isinstance(value[0], Resumable | deque | np.random.Generator):
        for item, saved_item in zip(value, saved, strict=True):
            _restored(item, saved_item)
    elif isinstance(value, torch.nn.Module):
        value.load_state_dict(saved)
    elif isinstance(value, torch.optim.Optimizer):
        restore_optimiser(value, saved)
    elif isinstance(value, torch.Generator):
        value.set_state(saved)
    elif isinstance(value, np.random.Generator):
        value.bit_generator.state = saved
    elif isinstance(value, torch.Tensor):
        value.copy_(saved)
    else:
        return copy.deepcopy(saved)
    return value
