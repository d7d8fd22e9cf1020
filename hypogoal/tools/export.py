"""The command that writes an agent's episodes, or an ensemble, for other software."""

import inspect
import json
import re
import shutil
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from typer import Argument, Option

from hypogoal.command.call import NO_TRAINING, Call, Done
from hypogoal.command.stage import stage
from hypogoal.core.artefacts import Artefact, open_artefact
from hypogoal.core.errors import UserError
from hypogoal.core.progress import Progress
from hypogoal.observations import PICTURE, fields_of

NAME = re.compile(r"[A-Za-z0-9_-]+-v\d+")  # names of Minari datasets
SOURCE = (
    "An agent (meta): its episodes become a Minari dataset, which 'import' reads. Or an ensemble: a folder that torch "
    "and safetensors load without hypogoal."
)
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

Positive above the `thresholds` in the file of weights.
"""


@stage(
    "export runs/mine/ensemble --out mine",
    leaves_out=(*NO_TRAINING, "preset", "resume"),
)
def export(
    call: Call,
    source: Annotated[Path, Argument(help=SOURCE)],
    *,
    episodes: Annotated[int, Option(min=1, help="How many episodes an agent plays.")] = 20,
) -> Done:
    """Write an agent's episodes or an ensemble for other software.

    An ensemble becomes a folder that torch and safetensors load without hypogoal. A meta artefact becomes a Minari
    dataset with ``episodes`` episodes of its agent, whose choices ``seed`` seeds.
    """
    artefact = open_artefact(source, "meta", "ensemble")
    if artefact.kind == "ensemble":
        with call.draft("hub", {}, [source]) as draft:
            write_hub(artefact, draft.files)
        return Done()
    name = call.out.name
    if not NAME.fullmatch(name):
        raise UserError("a Minari dataset needs a version in its name", name, "Give --out DIR/NAME-v0.")
    with (
        call.draft("episodes", {"episodes": episodes}, [source]) as draft,
        Progress("export", total=episodes, quiet=call.quiet) as progress,
    ):
        write_episodes(artefact, draft.files / "data", name, call.seed, progress)
    return Done()


def write_hub(artefact: Artefact, folder: Path) -> None:
    """Write an ensemble's weights, the layers that the weights are of, ``load.py`` and a card.

    Raises ``UserError`` if the members have layers or a view of the user's own.
    """
    from hypogoal.hypotheses import load
    from hypogoal.hypotheses.config import FULL
    from hypogoal.hypotheses.ensemble import read_ensemble

    config = artefact.config
    if config["view"] != FULL:
        do = "Export those trained with view=full."
        raise UserError("these members have a view of your own, which only hypogoal can load", artefact.path, do)
    goals = config["sub_goals"]
    ensemble = read_ensemble(artefact.path, config, goals[0])
    observations = {}
    for key, (dtype, shape) in fields_of(ensemble.observation_shape, ensemble.view.dtype).items():
        observations[key] = str(dtype), shape
    facts = {
        "members": len(ensemble),
        "observations": observations,
        "layers": _layers(ensemble.members[0], artefact.path),
    }
    card = CARD.format(
        count=len(ensemble),
        goals=", ".join(goals),
        first=goals[0],
        observations=observations,
        diversity=config["diversity"],
        version=artefact.manifest.versions["hypogoal"],
    )
    (folder / "config.json").write_text(json.dumps(facts, indent=1) + "\n", encoding="utf-8")
    (folder / "README.md").write_text(card, encoding="utf-8")
    shutil.copy(load.__file__, folder / "load.py")
    for goal in goals:
        shutil.copy(artefact.path / f"{goal}.safetensors", folder)


def _layers(network: Any, source: Path) -> list[tuple[str, dict[str, Any]]]:
    """Return the names and arguments of a network's layers, from which ``load.py`` builds them."""
    from torch import nn

    from hypogoal.hypotheses.load import ByKey

    rows = []
    for layer in network:  # a layer that is there twice is listed twice
        kind = type(layer)
        if isinstance(layer, ByKey):
            encoders = [_layers(encoder, source) for encoder in layer.encoders]
            rows.append((kind.__name__, {"shapes": layer.shapes, "encoders": encoders}))
            continue
        if getattr(nn, kind.__name__, None) is not kind or [*layer.children()]:
            fault = f"only hypogoal can build the layer {kind.__name__}"
            raise UserError(fault, source, "Export members of a built-in network, such as doorkey.")
        parameters = inspect.signature(kind).parameters
        kept = getattr(kind, "__constants__", ())
        arguments = {name: getattr(layer, name) for name in parameters if name in kept}
        if "bias" in parameters:
            arguments["bias"] = layer.bias is not None
        rows.append((kind.__name__, arguments))
    return rows


def write_episodes(meta: Artefact, folder: Path, name: str, seed: int, progress: Progress) -> None:
    """Let the agent of a meta artefact play, and write its episodes as the Minari dataset ``name``.

    ``infos/option`` is the option that led to each state, -1 at the start.
    """
    from gymnasium import spaces
    from minari import __version__
    from minari.dataset.minari_storage import MinariStorage

    from hypogoal.core.processes import prepare
    from hypogoal.meta.episodes import agent_of, play_episodes

    prepare()
    loop = agent_of(meta, seed)
    engine = loop.engine
    low, high = (0, 255) if engine.observation_dtype == PICTURE else (-np.inf, np.inf)
    kind = engine.observation_dtype.type
    storage = MinariStorage.new(
        folder.resolve(),
        observation_space=spaces.Box(low, high, engine.observation_shape, kind),
        action_space=spaces.Discrete(engine.n_actions),
        jpeg_encoding=False,
    )
    place = meta.config["layouts"] or meta.config["layout_seed"]
    origin = f"{meta.config['domain']}, layout seed {place}, seed {seed}"
    description = {
        "dataset_id": name,
        "minari_version": __version__,
        "algorithm_name": "hypogoal",
        "description": f"Episodes of an agent that chooses among options ({origin}).",
    }
    storage.update_metadata(description)
    storage.update_episodes(_buffers(play_episodes(loop, progress.total), progress))


def _buffers(episodes: Iterable[Any], progress: Progress) -> Iterator[Any]:
    """Yield episodes as minari takes them."""
    from minari.data_collector import EpisodeBuffer

    for observations, steps in episodes:
        last = np.arange(len(steps)) == len(steps) - 1
        yield EpisodeBuffer(
            observations=observations,
            actions=steps.actions,
            rewards=steps.rewards,
            terminations=steps.terminated,
            truncations=last & ~steps.terminated,
            infos={"option": np.concatenate([[-1], steps.options])},
        )
        progress.advance()
