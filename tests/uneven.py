"""A processor on which a state's last bits depend on the batch around it, for machines whose own do not (Spec G1).

Libraries compute other sizes, and other places of a batch, in other ways, which on some processors round otherwise.
Here products and convolutions always do: what is computed again in the same way gives the same bits, all else others.
``pytest -p tests.uneven`` runs every test on it.
"""

from collections.abc import Iterator
from functools import cache
from typing import Any

import pytest
import torch
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils._pytree import tree_flatten

MOST = 3  # units in the last place that are added
PRODUCTS = {"_addmm_activation", "addmm", "addmv", "baddbmm", "bmm", "mm", "mv"}
OPERATIONS = PRODUCTS | {"convolution", "convolution_backward", "mkldnn_rnn_layer"}


class Uneven(TorchDispatchMode):
    """Within it, to each number of a product a few units in the last place are added, by its place and the size."""

    def __torch_dispatch__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        if torch.is_inference_mode_enabled():  # there what is made of other operations comes here in one piece
            with self:
                found = func.decompose(*args, **(kwargs or {}))
            if found is not NotImplemented:
                return found
        found = func(*args, **(kwargs or {}))
        if func.overloadpacket.__name__ in OPERATIONS:
            for one in tree_flatten(found)[0]:
                if isinstance(one, torch.Tensor) and one.dtype == torch.float32 and one.device.type == "cpu":
                    some = one.isfinite() & (one != 0)
                    one.view(torch.int32).add_(_units(tuple(one.shape)) * some)
        return found


@cache
def _units(shape: tuple[int, ...]) -> torch.Tensor:
    """What is added to numbers of this shape, int32: 0 to ``MOST``, as if at random."""
    places = torch.arange(torch.Size(shape).numel()).view(shape)
    mixed = (places + 1) * 2_654_435_761 + places.numel() * 40_503
    return (mixed >> 15).remainder(MOST + 1).to(torch.int32)


@pytest.fixture(autouse=True, scope="session")
def uneven() -> Iterator[None]:
    """Where this file is a plugin: every test, and every fixture of a module."""
    with Uneven():
        yield
