"""Loading of a sub-goal's members with torch and safetensors alone: ``load("door-open")(observations)`` -> P (N, K)."""

import json
from collections.abc import (
    Callable,
    Iterable,
    Sequence,
)
from pathlib import Path
from typing import Any

import torch
from safetensors.torch import load_file

HERE = Path(__file__).parent
DEVIATIONS = 10.0  # numbers are clipped at this many standard deviations from their mean


class ByKey(torch.nn.Module):
    """One encoder for each key of mixed observations: from all keys' numbers in a row (N, D) to features (N, F)."""

    def __init__(
        self,
        shapes: Sequence[Sequence[int]],
        encoders: Iterable[torch.nn.Module],
    ):
        super().__init__()
        self.shapes, self.encoders = shapes, torch.nn.ModuleList(encoders)

    def forward(self, values: torch.Tensor) -> torch.Tensor:
        """Encode the part of each key, and return the features of all keys in a row, (N, F)."""
        sizes = [torch.Size(shape).numel() for shape in self.shapes]
        parts = values.split(sizes, dim=1)
        encoded = []
        for encoder, part, shape in zip(
            self.encoders,
            parts,
            self.shapes,
            strict=True,
        ):
            encoded.append(encoder(part.reshape(-1, *shape)))
        return torch.cat(encoded, dim=1)


def built(layers: list[Any]) -> torch.nn.Sequential:
    """Return a network with the layers whose names and arguments are given."""
    network = torch.nn.Sequential()
    for kind, arguments in layers:
        if kind == "ByKey":
            encoders = map(built, arguments["encoders"])
            network.append(ByKey(arguments["shapes"], encoders))
        else:
            layer = getattr(torch.nn, kind)
            network.append(layer(**arguments))
    return network


def load(sub_goal: str) -> Callable[[Any], torch.Tensor]:
    """Return a function from observations to the members' probabilities, float32 (N, K).

    The function takes an array (N, ...), or a dictionary of such arrays by key, of the type and shape of training.
    Pictures are bytes. The function raises ``ValueError`` for other observations.
    """
    config = json.loads((HERE / "config.json").read_bytes())
    state = load_file(HERE / f"{sub_goal}.safetensors")
    standard = [state[name].flatten() for name in ("view.mean", "view.deviation") if name in state]
    weights = {}
    for name, tensor in state.items():
        if name.startswith("members."):
            weights[name.removeprefix("members.")] = tensor
    members = torch.nn.ModuleList(built(config["layers"]) for _ in range(config["members"]))
    members.load_state_dict(weights)
    members.eval().to("cpu", torch.float32)  # whatever torch's defaults are

    def predict(observations: Any) -> torch.Tensor:
        rows, place = [], 0
        for key, (kind, shape) in config["observations"].items():
            values = observations[key] if key else observations
            if not isinstance(values, torch.Tensor):
                import numpy  # torch takes no arrays without numpy

                values = torch.from_numpy(numpy.array(values, order="C"))
            values = values.cpu() if kind == "uint8" else values.cpu().float()
            form, usual = (values.dtype, *values.shape[1:]), (getattr(torch, kind), *shape)
            if form != usual:
                raise ValueError(f"{key or 'a state'} is {form}. Give (N, ...) as in training, each {usual}.")
            if kind == "uint8":
                values = values.float() / 255
            else:
                size = torch.Size(shape).numel()
                mean, deviation = (part[place : place + size].view(shape) for part in standard)
                values = ((values - mean) / deviation).clip(-DEVIATIONS, DEVIATIONS)
                place += size
            if values.ndim == 4:
                values = values.permute(0, 3, 1, 2)
            rows.append(values.flatten(1) if key else values)
        inputs = torch.cat(rows, dim=1)
        with torch.no_grad(), torch.autocast("cpu", enabled=False):
            logits = torch.stack([member(inputs) for member in members], dim=1)
        return logits.softmax(-1)[..., 1]

    return predict
