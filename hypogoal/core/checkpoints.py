"""Checkpoints: all that a stage needs to resume, saved while the stage works.

A state is nested dicts and lists of arrays, tensors and plain JSON values. Objects return their state by ``snapshot()``
and continue from a state by ``restore(snapshot)``. One state is one safetensors file, with the JSON part of the state
as bytes. No pickle is used.
"""

import copy
import json
import os
import time
from collections import deque
from collections.abc import Callable, Mapping
from functools import partial
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from hypogoal.core.errors import UserError
from hypogoal.core.files import reading, replacing

State = dict[str, Any]

FEWEST_SECONDS = 10.0  # the shortest time between two checkpoints
# For each second that saving takes, the time between checkpoints is this many times FEWEST_SECONDS. So saving takes at
# most 3 % of a run.
WAIT_PER_COST = 3.0
PACE = "HYPOGOAL_CHECKPOINT_SECONDS"  # an environment variable that replaces FEWEST_SECONDS, for tests
JSON_PART = "json"
ARRAY, TENSOR = "$array", "$tensor"
ANEW = "Give --force and no --resume to begin anew."
FORMAT = 2  # the format of a state, raised in a version that cannot go on with the states of earlier versions


class Checkpoints:
    """One state on disk, which is replaced from time to time. The old file stays until the new file is whole.

    If ``path`` is None, nothing is ever saved.
    """

    def __init__(self, path: Path | None):
        self.path = path
        self._fewest = float(os.environ.get(PACE, FEWEST_SECONDS))
        self._next = time.monotonic() + self._fewest

    def offer(self, state: Callable[[], State]) -> None:
        """Save ``state()`` if a checkpoint is due."""
        begun = time.monotonic()
        if self.path is None or begun < self._next:
            return
        self.save(state())
        now = time.monotonic()
        self._next = now + self._fewest * max(1.0, WAIT_PER_COST * (now - begun))

    def save(self, state: State) -> None:
        """Write ``state``. Raises ``UserError`` if that fails, and then the previous checkpoint stays.

        A state with NaN or Inf in a tensor is not written, so that the last good state stays.
        """
        from safetensors import SafetensorError
        from safetensors.numpy import save_file

        if self.path is None:
            return
        arrays: dict[str, NDArray[Any]] = {}
        try:
            text = json.dumps({"format": FORMAT, "state": state}, default=partial(_without_array, arrays))
        except FloatingPointError:
            return
        arrays[JSON_PART] = np.frombuffer(text.encode(), np.uint8)
        try:
            self.path.parent.mkdir(exist_ok=True)
            with replacing(self.path) as fresh:
                save_file(arrays, fresh)
        except (OSError, SafetensorError) as error:
            fault = f"a checkpoint cannot be written ({error})"
            raise UserError(fault, self.path, "Free some disk space, then continue with --resume.") from None

    def load(self) -> State | None:
        """Return the saved state, or None if there is none.

        Raises ``UserError`` if the file is damaged or of another version.
        """
        from safetensors.numpy import load_file

        if self.path is None or not self.path.is_file():
            return None
        with reading(self.path, ANEW, "the checkpoint"):
            arrays = load_file(self.path)
            text = arrays.pop(JSON_PART).tobytes()
            saved = json.loads(text, object_hook=partial(_with_array, arrays))
        if saved.get("format") != FORMAT:
            raise UserError("another version of hypogoal wrote this checkpoint", self.path, ANEW)
        return dict(saved["state"])


def _without_array(arrays: dict[str, NDArray[Any]], value: Any) -> Any:
    """Return what JSON has in place of ``value``, which JSON cannot hold. An array or tensor is put into ``arrays``."""
    if isinstance(value, np.generic):
        return value.item()
    kind, array = ARRAY, value
    if hasattr(value, "detach"):
        kind, tensor = TENSOR, value.detach().cpu()
        if str(tensor.dtype) == "torch.bfloat16":  # NumPy lacks the type, and float32 has all of its values
            tensor = tensor.float()
        array = tensor.numpy()
        if array.dtype.kind == "f" and not np.isfinite(array).all():
            raise FloatingPointError
    number = str(len(arrays))
    arrays[number] = np.asarray(array, order="C")
    return {kind: number}


def _with_array(arrays: Mapping[str, NDArray[Any]], part: State) -> Any:
    if part.keys() == {ARRAY}:
        return arrays[part[ARRAY]]
    if part.keys() == {TENSOR}:
        import torch

        return torch.from_numpy(arrays[part[TENSOR]]).clone()
    return part


class Resumable:
    """An object that continues after a break as if there had been no break, from a snapshot of what changes.

    Attributes:
        CHANGING: the names of the attributes that change. Such an attribute is a network, an optimiser, a random
            generator, a tensor, a deque, a ``Resumable``, or a list of any of them. It may also be made of arrays,
            numbers, lists, dicts by name and None.
    """

    CHANGING: ClassVar[tuple[str, ...]] = ()

    def snapshot(self) -> State:
        """Return all that a resumed run needs to continue exactly. The snapshot is valid until the next step."""
        return {name: snapshot_of(getattr(self, name)) for name in self.CHANGING}

    def restore(self, snapshot: Mapping[str, Any]) -> None:
        """Continue from a ``snapshot`` of an object that was made with the same arguments."""
        for name in self.CHANGING:
            setattr(self, name, restored(getattr(self, name), snapshot[name]))


def snapshot_of(value: Any) -> Any:
    """Return what :func:`restored` needs of ``value``.

    Of an optimiser, that is its moments and step counts only, because its settings are configured.
    """
    if isinstance(value, Resumable):
        return value.snapshot()
    if isinstance(value, list | deque):
        return [snapshot_of(item) for item in value]
    if isinstance(value, np.random.Generator):
        return value.bit_generator.state
    if hasattr(value, "set_state"):  # a random generator of torch
        return value.get_state()
    if hasattr(value, "param_groups"):  # an optimiser
        return value.state_dict()["state"]
    return value.state_dict() if hasattr(value, "state_dict") else value


def restored(value: Any, saved: Any) -> Any:
    """Return ``value`` with the saved contents. It is changed in place if other objects may share it."""
    if isinstance(value, Resumable):
        value.restore(saved)
    elif isinstance(value, deque):
        value.clear()
        value.extend(saved)
    elif isinstance(value, list) and len(value) == len(saved):
        value[:] = map(restored, value, saved)
    elif isinstance(value, np.random.Generator):
        value.bit_generator.state = saved
    elif hasattr(value, "set_state"):
        value.set_state(saved)
    elif hasattr(value, "param_groups"):
        state = {int(number): moments for number, moments in saved.items()}
        value.load_state_dict({"state": state, "param_groups": value.state_dict()["param_groups"]})
    elif hasattr(value, "load_state_dict"):
        value.load_state_dict(saved)
    elif hasattr(value, "copy_"):  # a tensor
        value.copy_(saved)
    else:
        return copy.deepcopy(saved)
    return value
