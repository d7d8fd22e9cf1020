"""Checkpoints: all that a stage needs to go on where it was, saved while it works (Spec G1, G3).

A state is nested dicts and lists of arrays, tensors and plain JSON values; what has a state gives it as ``snapshot()``
and takes it back as ``restore(snapshot)``. One state is one safetensors file, its JSON part in it as bytes; no pickle.
Such a file is private to its stage and to the version that wrote it: what is read must be built like the state of what
is to go on (:func:`require_alike`).
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
from hypogoal.core.files import MOST_INTEGER, replace_file
from hypogoal.core.stopping import SIGNALS, stop

if TYPE_CHECKING:
    import torch

State = dict[str, Any]

FEWEST_SECONDS = 10.0  # between two checkpoints
WAIT_PER_COST = 30.0  # and at least so many times as long as one took: 3 % of a run at most
PACE = "HYPOGOAL_CHECKPOINT_SECONDS"  # in the environment: the seconds between two instead, for tests
FOLDER = "checkpoint"  # beside the folder that a stage fills
JSON_PART, SUM_PART = "json-5", "crc32"  # the number rises with what stages keep
ARRAY, TENSOR = "$array", "$tensor"
ANEW = "Give --force and no --resume to begin anew."


def checkpoints_of(folder: Path, name: str = "stage") -> Checkpoints:
    """The checkpoints called ``name`` of the stage that fills ``folder`` (see ``create_artefact``)."""
    return Checkpoints(folder.parent / FOLDER / f"{name}.safetensors")


class Checkpoints:
    """One state on disk, replaced by a later one now and then; the earlier stays until the later is whole.

    As a context, Ctrl-C and SIGTERM wait for the next :meth:`offer`, which saves and raises ``KeyboardInterrupt`` with
    the signal's number. A second Ctrl-C does not wait. Where the ``path`` is None, nothing is ever saved.
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
        if threading.current_thread() is threading.main_thread():  # no other may have handlers
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
            signal.raise_signal(self._signal)  # a pool's process that fails and is told to end, or it would never

    def _note(self, number: int, frame: FrameType | None) -> None:
        if number == signal.SIGINT and self._interrupted:
            stop(number, frame)
        self._interrupted |= number == signal.SIGINT  # the first; a run sends SIGTERM on
        self._signal = self._signal or number

    @property
    def saved(self) -> bool:
        """Whether there is one."""
        return self.path is not None and self.path.is_file()

    def offer(self, state: Callable[[], State]) -> None:
        """Where the state is whole: save it if it is time to, or if a signal came: then a ``KeyboardInterrupt``."""
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
        """Write ``state``, or raise a ``UserError``; the one before is still there then.

        One with a tensor that holds NaN or Inf is not written: the last good one stays (Spec G3).
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
            what = f"a checkpoint cannot be written ({error})"
            raise UserError(what, self.path, "Make room, then give --resume to go on.") from None

    def load(self) -> State | None:
        """The state last saved; None where none was. A damaged file is a ``UserError``."""
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
            what = "the checkpoint is damaged, or of an earlier version"
            raise UserError(what, self.path, ANEW) from None
        return state

    @contextlib.contextmanager
    def restoring(self) -> Iterator[None]:
        """Take back a state in the block; one that does not fit is a ``UserError``, whatever it makes the block raise.

        Its checksum was right, so that it is another stage's or version's, or was written by somebody else.
        """
        from hypogoal.core.own_code import users_own

        try:
            yield
        except (LookupError, ValueError, TypeError, AttributeError, ArithmeticError, RuntimeError) as error:
            if users_own(error) is not None:
                raise
            fault = str(error).partition("\n")[0] if isinstance(error, Unlike) else "at its values"
            raise UserError(f"the checkpoint does not fit what is to go on ({fault})", self.path, ANEW) from error


def _checksum(parts: Mapping[str, NDArray[Any]]) -> NDArray[np.uint32]:
    """The CRC-32 of all that is saved: a byte that a disk changed would be other weights, and not be noticed."""
    value = 0
    for place, values in sorted(parts.items()):
        value = zlib.crc32(f"{place} {values.dtype} {values.shape}".encode(), value)
        value = zlib.crc32(values.reshape(-1).view(np.uint8).data, value)
    return np.array([value], np.uint32)


def _taken_apart(value: Any, place: str, arrays: State, tensors: State) -> Any:
    """``value`` as plain JSON values, its arrays and tensors put aside by their place."""
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


class Unlike(ValueError):
    """A state is not built like that of what is to go on from it."""


class _Rows(np.ndarray[Any, Any]):
    """An array of which a later snapshot may have more or fewer rows."""


class _List(list[Any]):
    """A list of which a later snapshot may have more or fewer items, each like ``item``."""

    item: Any


class _Dict(dict[str, Any]):
    """A dict of which a later snapshot may have more or fewer keys, each value like ``item``."""

    item: Any


class Unknown(dict[str, Any]):
    """A part of a state of which only its owner knows how it is built, such as that of an own domain's engine."""


def growing(values: Any, item: Any = None) -> Any:
    """The same array (n, ...), list or dict, marked for :func:`require_alike`: its length changes, its items do not.

    ``item`` is like one of a list or dict, which may have none yet.
    """
    if isinstance(values, np.ndarray):
        return values.view(_Rows)
    marked = _Dict(values) if isinstance(values, dict) else _List(values)
    marked.item = item
    return marked


def require_alike(saved: Any, fresh: Any, place: str = "") -> None:
    """Refuse (``Unlike``) a state with other keys, types, dtypes or shapes than that of what is to go on, ``fresh``.

    Only what is marked as :func:`growing` may have another length; a number may stand where None does. Texts, such as
    the kind of a generator, never change.
    """
    fresh = fresh.item() if isinstance(fresh, np.generic) else fresh
    where = place or "/"
    if isinstance(fresh, Unknown):
        return
    if isinstance(fresh, dict):
        if not isinstance(saved, dict):
            raise Unlike(f"no dict at {where}")
        if isinstance(fresh, _Dict):
            fresh = dict.fromkeys(saved, fresh.item)
        if differ := sorted(fresh.keys() ^ saved.keys()):
            raise Unlike(f"{'unknown' if differ[0] in saved else 'missing'}: {place}/{differ[0]}")
        for key, value in saved.items():
            require_alike(value, fresh[key], f"{place}/{key}")
    elif isinstance(fresh, list | tuple):
        if isinstance(fresh, _List) and isinstance(saved, list):
            fresh = [fresh.item] * len(saved)
        if not isinstance(saved, list) or len(saved) != len(fresh):
            raise Unlike(f"no list of {len(fresh)} at {where}")
        for number, (value, like) in enumerate(zip(saved, fresh, strict=True)):
            require_alike(value, like, f"{place}/{number}")
    elif hasattr(fresh, "dtype"):
        kind, shape = str(fresh.dtype), tuple(fresh.shape)
        saved_shape = tuple(getattr(saved, "shape", ()))
        grows = isinstance(fresh, _Rows) and len(saved_shape) == len(shape)
        if str(getattr(saved, "dtype", "")) != kind or saved_shape[grows:] != shape[grows:]:
            raise Unlike(f"not {kind} {shape} at {where}")
    elif not (
        (saved == fresh if isinstance(fresh, str) else type(saved) is type(fresh))
        or (type(saved) is int and isinstance(fresh, float))
        or (type(saved) in (int, float) and fresh is None)
    ):
        raise Unlike(f"not {type(fresh).__name__} at {where}")
    elif type(saved) is int and abs(saved) > MOST_INTEGER >= abs(fresh or 0):  # a generator's own are as large
        raise Unlike(f"no such count at {where}")


def optimiser_snapshot(optimiser: torch.optim.Optimizer) -> State:
    """What Adam knows of each parameter that has moved, step counts included; its settings are the configuration's."""
    import torch

    state = optimiser.state
    parameters = [parameter for group in optimiser.param_groups for parameter in group["params"]]
    items = [{"step": torch.zeros(()), "exp_avg": each, "exp_avg_sq": each} for each in parameters]
    pairs = enumerate(zip(parameters, items, strict=True))
    return {str(number): growing([state[each]] if each in state else [], item) for number, (each, item) in pairs}


def restore_optimiser(optimiser: torch.optim.Optimizer, snapshot: State) -> None:
    """Continue from an ``optimiser_snapshot`` of one of the same parameters."""
    state = {int(number): moments[0] for number, moments in snapshot.items() if moments}
    optimiser.load_state_dict({"state": state, "param_groups": optimiser.state_dict()["param_groups"]})


class Resumable:
    """What goes on after a break as if there had been none: it gives what changes as a snapshot, and takes it back.

    Attributes:
        CHANGING: the names of the attributes that do. Each is a network, an optimiser, a generator of random numbers, a
            tensor, a deque, itself resumable, a list of such, or of arrays, numbers, lists, dicts by name and None.
    """

    CHANGING: ClassVar[tuple[str, ...]] = ()

    def items(self) -> Mapping[str, Any]:
        """What an item is like of those in ``CHANGING`` whose length changes: a deque, a list, an array's rows.

        Of a list of lists or deques, one for each option or environment, an item of each of these.
        """
        return {}

    def snapshot(self) -> State:
        """What a resumed run needs to go on exactly; valid until the next step."""
        items = self.items()
        return {name: _taken(getattr(self, name), items.get(name)) for name in self.CHANGING}

    def restore(self, snapshot: Mapping[str, Any]) -> None:
        """Continue from a ``snapshot`` of one made with the same arguments."""
        for name in self.CHANGING:
            setattr(self, name, _restored(getattr(self, name), snapshot[name]))


def _taken(value: Any, item: Any = None) -> Any:
    import torch

    if isinstance(value, Resumable):
        return value.snapshot()
    if isinstance(value, list | deque):
        fixed = bool(value) and isinstance(value[0], Resumable | list | deque | np.random.Generator)
        return [_taken(each, item) for each in value] if fixed else growing(list(map(_taken, value)), item)
    if isinstance(value, np.ndarray) and item is not None:
        return growing(value)
    if isinstance(value, torch.nn.Module):
        return value.state_dict()
    if isinstance(value, torch.optim.Optimizer):
        return optimiser_snapshot(value)
    if isinstance(value, torch.Generator):
        return value.get_state()
    return value.bit_generator.state if isinstance(value, np.random.Generator) else value


def _restored(value: Any, saved: Any) -> Any:
    """``value`` as it was; changed in place where others hold it too."""
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
