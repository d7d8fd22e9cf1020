"""Members of a sub-goal, with torch and safetensors alone: ``load("door-open")(observations)`` -> P (N, K)."""

import json
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import Any

import torch
from safetensors.torch import load_file

HERE = Path(__file__).parent
DEVIATIONS = 10.0  # numbers are clipped this far from their mean


class ByKey(torch.nn.Module):
    """An encoder for each key of mixed observations: inputs of all keys in a row, (N, D) -> their outputs (N, F)."""

    def __init__(self, shapes: Sequence[Sequence[int]], encoders: Iterable[torch.nn.Module]):
        super().__init__()
        self.shapes, self.encoders = shapes, torch.nn.ModuleList(encoders)

    def forward(self, values: torch.Tensor) -> torch.Tensor:
        """Encode each key's part."""
        parts = values.split([torch.Size(shape).numel() for shape in self.shapes], dim=1)
        encoded = zip(self.encoders, parts, self.shapes, strict=True)
        return torch.cat([encoder(part.reshape(-1, *shape)) for encoder, part, shape in encoded], dim=1)


def built(layers: list[Any]) -> torch.nn.Sequential:
    """A network from the names and arguments of its layers."""
    return torch.nn.Sequential(
        *(
            ByKey(rest["shapes"], map(built, rest["encoders"])) if kind == "ByKey" else getattr(torch.nn, kind)(**rest)
            for kind, rest in layers
        )
    )


def load(sub_goal: str) -> Callable[[Any], torch.Tensor]:
    """A function from observations (N, ...), or such arrays by key, to members' probabilities, float32 (N, K)."""
    config = json.loads((HERE / "config.json").read_text(encoding="utf-8"))
    state = load_file(HERE / f"{sub_goal}.safetensors")
    standard = [state[name].flatten() for name in ("view.mean", "view.deviation") if name in state]
    weights = {name.removeprefix("members."): tensor for name, tensor in state.items() if name.startswith("members.")}
    members = torch.nn.ModuleList(built(config["layers"]) for _ in range(config["members"]))
    members.load_state_dict(weights)
    members.eval()

    def predict(observations: Any) -> torch.Tensor:
        rows, place = [], 0
        for key, (kind, shape) in config["observations"].items():
            values = torch.as_tensor(observations[key] if key else observations).float()
            if kind == "uint8":
                values = values / 255
            else:
                place += (size := torch.Size(shape).numel())
                mean, deviation = (part[place - size : place].view(shape) for part in standard)
                values = ((values - mean) / deviation).clip(-DEVIATIONS, DEVIATIONS)
            values = values.permute(0, 3, 1, 2) if values.ndim == 4 else values
            rows.append(values.flatten(1) if key else values)
        with torch.no_grad():
            return torch.stack([member(torch.cat(rows, dim=1)).softmax(-1)[:, 1] for member in members], dim=1)

    return predict
