"""An ensemble as a folder for a model hub, which torch and safetensors load without hypogoal (Spec I6)."""

import json
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

from torch import nn

from hypogoal.core.artefacts import claim, open_artefact
from hypogoal.core.drafts import draft, put_in_place
from hypogoal.core.errors import UserError
from hypogoal.core.tensors import save_tensors
from hypogoal.dataset import fields_of
from hypogoal.hypotheses.ensemble import Ensemble, read_ensemble
from hypogoal.hypotheses.networks import ByKey, folded
from hypogoal.hypotheses.views import FullView
from hypogoal.own_data import load

# What builds each layer again; BatchNorm is folded into convolutions.
ARGUMENTS: dict[type[nn.Module], Sequence[str]] = {
    nn.Conv2d: ("in_channels", "out_channels", "kernel_size", "stride", "padding", "dilation", "groups"),
    nn.MaxPool2d: ("kernel_size", "stride", "padding"),
    nn.AvgPool2d: ("kernel_size", "stride", "padding"),
    nn.BatchNorm2d: ("num_features", "eps"),
    nn.Linear: ("in_features", "out_features"),
    nn.Flatten: ("start_dim", "end_dim"),
    nn.ReLU: (),
}
CARD = """---
library_name: hypogoal
pipeline_tag: image-classification
---

# Does the sub-goal hold? {count} hypotheses of {goals}

Members of an ensemble (hypogoal {version}, diversity {diversity}), each a hypothesis, from labels of one context, about
what makes the sub-goal. They agree on those labels, not elsewhere; a policy that optimises one finds its errors.

Observations (N, ...): {observations}

```python
from load import load  # needs torch and safetensors

probabilities = load({first!r})(observations)  # (N, {count})
```

Positive above the thresholds in `config.json`.
"""


def export_ensemble(source: Path, out: Path, *, force: bool = False) -> None:
    """Write the members of an ensemble artefact, ``load.py`` and a card into the folder ``out``.

    Members with layers of the user's own, or that see only the agent's surroundings, are a ``UserError``.
    """
    artefact = open_artefact(source, "ensemble").whole()
    out = claim(out, kind="hub", inputs=[source], force=force)
    config = artefact.config
    goals = config["sub_goals"]
    with draft(out, {"kind": "hub"}, force=force) as work:
        thresholds = {}
        for goal in goals:
            ensemble = read_ensemble(artefact.path, config, goal)
            if not isinstance(ensemble.view, FullView):
                raise UserError(
                    "members that see the agent's surroundings cannot be exported", source, "Train with view=full."
                )
            members = nn.ModuleList(map(_folded, ensemble.eval().members))
            state = {**members.state_dict(), **{f"view.{name}": part for name, part in ensemble.view.named_buffers()}}
            save_tensors(work.files / f"{goal}.safetensors", {name: part.clone() for name, part in state.items()})
            thresholds[goal] = [round(float(threshold), 6) for threshold in ensemble.thresholds]
        observations = {key: [str(kind), list(shape)] for key, (kind, shape) in _fields(ensemble).items()}
        layers = _described(members[0].children(), source)
        facts = {"format": 1, "members": len(members), "thresholds": thresholds, "observations": observations}
        (work.files / "config.json").write_text(
            json.dumps(facts | {"layers": layers}, indent=1) + "\n", encoding="utf-8"
        )
        (work.files / "load.py").write_text(Path(load.__file__).read_text(encoding="utf-8"), encoding="utf-8")
        texts = [f"{f'`{key}` ' if key else ''}{kind} {tuple(shape)}" for key, (kind, shape) in observations.items()]
        card = CARD.format(
            count=len(members), goals=", ".join(goals), first=goals[0], diversity=config["diversity"],
            version=artefact.manifest["versions"]["hypogoal"], observations=", ".join(texts),
        )  # fmt: skip
        (work.files / "README.md").write_text(card, encoding="utf-8")
        put_in_place(work.files, out)


def _fields(ensemble: Ensemble) -> Any:
    return fields_of(ensemble.observation_shape, ensemble.view.dtype)


def _folded(network: nn.Module) -> nn.Sequential:
    """A member with each BatchNorm folded into the convolution before it, in the encoders of keys, too."""
    layers = folded(nn.Sequential(*network.children()))
    for at, layer in enumerate(layers):
        if isinstance(layer, ByKey):
            layers[at] = ByKey(layer.shapes, map(_folded, layer.encoders))
    return layers


def _described(layers: Iterable[nn.Module], source: Path) -> list[Any]:
    """Names and arguments of layers, for ``load.py``."""
    rows: list[Any] = []
    for layer in layers:
        if isinstance(layer, ByKey):
            encoders = [_described(encoder.children(), source) for encoder in layer.encoders]
            rows.append(["ByKey", {"shapes": [list(shape) for shape in layer.shapes], "encoders": encoders}])
            continue
        if type(layer) not in ARGUMENTS:
            fault = f"other programs cannot build the layer {type(layer).__name__}"
            raise UserError(fault, source, "Train with a built-in network, such as doorkey.")
        rest = {name: getattr(layer, name) for name in ARGUMENTS[type(layer)]}
        bias = {"bias": layer.bias is not None} if isinstance(layer, nn.Conv2d | nn.Linear) else {}
        rows.append([type(layer).__name__, rest | bias])
    return rows
