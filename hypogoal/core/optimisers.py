"""Optimisers of torch that leave its compiler alone: loading that takes longer than all else of a stage's start."""

from __future__ import annotations

import inspect

import torch


class Adam(torch.optim.Adam):
    """torch's Adam, to the last bit; it cannot be compiled or differentiated through, and starts 1.5 s sooner.

    Torch wraps these methods in others that load ``torch._dynamo``; these are what is wrapped.
    """

    add_param_group = inspect.unwrap(torch.optim.Adam.add_param_group)
    state_dict = inspect.unwrap(torch.optim.Adam.state_dict)
    load_state_dict = inspect.unwrap(torch.optim.Adam.load_state_dict)
    zero_grad = inspect.unwrap(torch.optim.Adam.zero_grad)
    step = torch.no_grad()(inspect.unwrap(torch.optim.Adam.step))
