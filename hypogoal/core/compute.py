"""Where computation runs: one thread per process, on the requested device (Spec G5)."""

from __future__ import annotations

from typing import TYPE_CHECKING

from hypogoal.core.errors import UserError

if TYPE_CHECKING:
    pass


DEVICES = ("auto", "cpu", "cuda")


def prepare(device: str = "auto") -> str:
    """Use one torch thread without denormal numbers; returns ``cpu`` or ``cuda`` (``auto`` is the CPU, decision 26).

    One thread per process is as fast on small networks, does not suffer from busy neighbours, and gives the same bytes
    again on the same machine; other processors round differently. Denormal numbers (below 1e-38, where Adam's moments
    of unused weights end) count as 0: arithmetic with them takes many times as long. An unknown device, or one that
    torch does not find, is a ``UserError``.
    """
    import torch

    torch.set_num_threads(1)
    torch.set_flush_denormal(True)
    check_name(device)
    if device == "cuda" and not torch.cuda.is_available():
        installed = f"torch {torch.__version__}, {'for CUDA' if torch.version.cuda else 'built for the CPU only'}"
        raise UserError("torch finds no GPU", installed, "Use --device cpu, or see docs/gpu.md.")
    return "cuda" if device == "cuda" else "cpu"


def check_name(device: str) -> None:
    """Refuse (``UserError``) an unknown device; whether this machine has it is not checked."""
    if device not in DEVICES:
        raise UserError("unknown device", device, f"Choose one of {', '.join(DEVICES)}.")
