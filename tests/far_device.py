"""A device that is not the CPU, for machines without a GPU (Spec G5).

Tensors on it compute what the CPU computes, to the bit, and refuse to meet tensors that are not on it and to be read as
arrays: what a GPU refuses. Torch knows the device as ``meta``, whose own tensors have no numbers.
"""

from __future__ import annotations

import contextlib
import warnings
from collections.abc import Iterator
from typing import Any

import pytest
import torch
from torch.optim import optimizer
from torch.overrides import TorchFunctionMode
from torch.utils import _foreach_utils
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils._pytree import tree_flatten, tree_map, tree_unflatten

FAR = "meta"
MOVED = torch.ops.aten._to_copy.default
COPIED = torch.ops.aten.copy_.default
TURNED = torch.ops.aten.transpose_.default  # in place: what torch knows of the shape has to follow (GRU's last step)
READ = (torch.ops.aten._local_scalar_dense.default,)
PACKED = torch.ops.aten._pack_padded_sequence.default
# Lengths of sequences are on the CPU whatever the device: here one argument of each, and of PACKED the second result.
WITH_LENGTHS = (PACKED, torch.ops.aten._pack_padded_sequence_backward.default, torch.ops.aten.gru.data)


class FarTensor(torch.Tensor):
    """A tensor of the device; its numbers are ``near``."""

    near: torch.Tensor

    @staticmethod
    def __new__(cls, near: torch.Tensor) -> FarTensor:
        found = torch.Tensor._make_wrapper_subclass(
            cls, near.shape, strides=near.stride(), storage_offset=near.storage_offset(), dtype=near.dtype, device=FAR
        )
        found.near = near
        return found

    __torch_function__ = torch._C._disabled_torch_function_impl

    @classmethod
    def __torch_dispatch__(cls, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        return _compute(func, args, kwargs or {})

    def numpy(self, *args: Any, **kwargs: Any) -> Any:
        raise AssertionError("a tensor of another device is read as an array")


class _Made(TorchFunctionMode):
    def __torch_function__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        kwargs = dict(kwargs or {})
        if func is torch.tensor and "device" in kwargs:  # which is not an operation to torch
            return torch.tensor(*args, **{**kwargs, "device": "cpu"}).to(kwargs["device"])
        return func(*args, **kwargs)


class _Mode(TorchDispatchMode):
    def __torch_dispatch__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        if torch.is_inference_mode_enabled():  # there what is made of other operations comes here in one piece
            with self:
                found = func.decompose(*args, **(kwargs or {}))
            if found is not NotImplemented:
                return found
        return _compute(func, args, kwargs or {})


def _compute(func: Any, args: Any, kwargs: dict[str, Any]) -> Any:
    flat, spec = tree_flatten((args, kwargs))
    tensors = [one for one in flat if isinstance(one, torch.Tensor)]
    far = [one for one in tensors if isinstance(one, FarTensor)]
    device = kwargs.get("device")
    to_far = torch.device(device).type == FAR if device is not None else bool(far) and func not in READ
    if to_far and func not in (COPIED, *WITH_LENGTHS) and not (func is MOVED and device is not None):
        strangers = [one for one in tensors if not isinstance(one, FarTensor) and one.dim()]
        assert not strangers, f"{func} with tensors of two devices: {[tuple(one.shape) for one in strangers]}"
    back = {id(one.near): one for one in far}
    args, kwargs = tree_unflatten([one.near if isinstance(one, FarTensor) else one for one in flat], spec)
    if "device" in kwargs:
        kwargs = {**kwargs, "device": torch.device("cpu")}
    found = func(*args, **kwargs)
    if func is TURNED and to_far:
        with torch._C._DisableTorchDispatch():
            func(far[0], *args[1:])
    if not to_far:
        return found
    inference = torch.is_inference_mode_enabled() and all(one.is_inference() for one in far)  # a view is as its base
    with torch.inference_mode(inference), torch.set_grad_enabled(torch.is_grad_enabled()):
        if func is PACKED:
            return FarTensor(found[0]), found[1]
        return tree_map(lambda one: back.get(id(one), FarTensor(one)) if isinstance(one, torch.Tensor) else one, found)


@contextlib.contextmanager
def far_device(patch: pytest.MonkeyPatch) -> Iterator[str]:
    """Within it the device, by the name that is given, can be used."""

    def supported() -> list[str]:
        return ["cpu", "cuda", FAR]

    patch.setattr(_foreach_utils, "_get_foreach_kernels_supported_devices", supported)
    patch.setattr(_foreach_utils, "_foreach_supported_types", [torch.Tensor, torch.nn.Parameter, FarTensor])
    patch.setattr(optimizer, "_get_fused_kernels_supported_devices", supported)
    with warnings.catch_warnings(), _Mode(), _Made():
        warnings.filterwarnings("ignore", message=".*from a non-meta parameter")  # of other tensors of this name
        yield FAR
