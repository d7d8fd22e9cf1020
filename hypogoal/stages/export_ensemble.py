"""An ensemble as a folder for a model hub, which torch and safetensors load without hypogoal (Spec I6)."""

import inspect
import json
from collections.abc import Iterable
from pathlib import Path
from typing import Any

from torch import nn

from hypogoal.core.artefacts import claim, open_artefact
from hypogoal.core.drafts import draft, put_in_place
from hypogoal.core.errors import UserError
from hypogoal.core.tensors import save_tensors
from hypogoal.hypotheses import load
from hypogoal.hypotheses.ensemble import read_ensemble
from hypogoal.hypotheses.views import FullView
from hypogoal.observations import fields_of

CARD = """---
library_name: hypogoal
---

# {count} hypotheses of {goals}

Each member of this ensemble (hypogoal {version}, diversity {diversity}) is a hypothesis, from labels of one context,
about what makes the sub-goal. They agree on those labels, not elsewhere; a policy that optimises one finds its errors.

Observations (N, ...): {observations}

```python
from load import load  # needs torch and safetensors

probabilities = load({first!r})(observations)  # (N, {count})
```

Positive above the thresholds in `config.json`.
"""


def export_ensemble(source: Path, out: Path, *, force: bool = False) -> None:
    """Write the members of an ensemble artefact, ``load.py`` and a card into the folder ``out``.

    Members with layers or a view of the user's own are a ``UserError``.
    """
    artefact = open_artefact(source, "ensemble").whole()
    out = claim(out, kind="hub", inputs=[source], force=force)
    config, thresholds = artefact.config, {}
    with draft(out, {"kind": "hub"}, force=force) as work:
        for goal in config["sub_goals"]:
            ensemble = read_ensemble(artefact.path, config, goal)
            if not isinstance(ensemble.view, FullView):
                do = "Export those trained with view=full."
                raise UserError("these members have a view of your own, which only hypogoal can load", source, do)
            members = nn.ModuleList(ensemble.members)
            state = {**members.state_dict(), **dict(ensemble.view.named_buffers())}
            save_tensors(work.files / f"{goal}.safetensors", {name: part.clone() for name, part in state.items()})
            thresholds[goal] = [round(float(threshold), 6) for threshold in ensemble.thresholds]
        layers = _described(members[0].children(), source)
        fields = fields_of(ensemble.observation_shape, ensemble.view.dtype)
        observations = {key: [str(kind), list(shape)] for key, (kind, shape) in fields.items()}
        facts = {"members": len(members), "thresholds": thresholds, "observations": observations, "layers": layers}
        card = CARD.format(
            count=len(members), goals=", ".join(thresholds), first=next(iter(thresholds)), observations=observations,
            diversity=config["diversity"], version=artefact.manifest["versions"]["hypogoal"],
        )  # fmt: skip
        texts = {"config.json": json.dumps(facts, indent=1) + "\n", "README.md": card}
        for name, text in (texts | {"load.py": Path(load.__file__).read_text(encoding="utf-8")}).items():
            (work.files / name).write_text(text, encoding="utf-8")
        put_in_place(work.files, out)


def _described(layers: Iterable[nn.Module], source: Path) -> list[Any]:
    """The names and arguments of layers, from which ``load.py`` builds them."""
    rows: list[Any] = []
    for layer in layers:
        kind = type(layer)
        rest: dict[str, Any] = {}
        if isinstance(layer, load.ByKey):
            encoders = [_described(encoder.children(), source) for encoder in layer.encoders]
            rest = {"shapes": [list(shape) for shape in layer.shapes], "encoders": encoders}
        elif getattr(nn, kind.__name__, None) is not kind or [*layer.children()]:
            fault = f"only hypogoal can build the layer {kind.__name__}"
            raise UserError(fault, source, "Export members of a built-in network, such as doorkey.")
        else:
            arguments = {*inspect.signature(kind).parameters} & {*getattr(kind, "__constants__", ())}
            rest = {name: getattr(layer, name) for name in sorted(arguments)}
            rest |= {"bias": layer.bias is not None} if isinstance(layer, nn.Conv2d) else {}
        rows.append([kind.__name__, rest])
    return rows
