"""Random numbers for torch's modules, which ask for no generator when they draw their first weights."""

from collections.abc import Callable, Mapping
from typing import Any

import torch
from torch import Tensor
from torch.overrides import TorchFunctionMode

IN_PLACE = (Tensor.bernoulli_, Tensor.exponential_, Tensor.normal_, Tensor.random_, Tensor.uniform_)
NEW = (torch.bernoulli, torch.multinomial, torch.normal, torch.rand, torch.randint, torch.randn, torch.randperm)
DRAWING = {*IN_PLACE, *NEW}


class DrawsFrom(TorchFunctionMode):
    """A context in which draws from torch's generator, which all threads share, come from ``generator`` instead.

    The numbers are those that torch's generator would give in the same state. Only draws of the present thread are
    affected.
    """

    def __init__(self, generator: torch.Generator):
        super().__init__()
        self.generator = generator

    def __torch_function__(
        self,
        func: Callable[..., Any],
        types: Any,
        args: Any = (),
        kwargs: Mapping[str, Any] | None = None,
    ) -> Any:
        arguments = dict(kwargs or {})
        if arguments.get("generator") is None and ("generator" in arguments or func in DRAWING):
            arguments["generator"] = self.generator
        return func(*args, **arguments)
