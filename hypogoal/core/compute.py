"""Where computation runs: one thread per process, on the device asked for (Spec G5)."""

from __future__ import annotations

from hypogoal.core.errors import UserError


def prepare(device: str = "auto") -> None:
    """Use one torch thread, and refuse a device that cannot be used.

    One thread per process is as fast on small networks, does not suffer from busy neighbours, and makes results
    the same bytes again on the same machine.
    """
    import torch

    torch.set_num_threads(1)
    if device not in ("auto", "cpu", "cuda"):
        raise UserError("unknown device", device, "Choose one of auto, cpu, cuda.")
    if device == "cuda":
        raise UserError("training runs on the CPU only in this version", "--device cuda", "Use --device cpu.")
