"""Spec B6, I6: states, an agent's episodes or an ensemble, written for other software."""

import inspect
import json
import os
import re
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
from gymnasium import spaces
from numpy.typing import DTypeLike

from hypogoal.core.artefacts import ARRAYS, create, open_artefact
from hypogoal.core.errors import UserError
from hypogoal.core.progress import Progress
from hypogoal.core.terminal import amount
from hypogoal.data import open_dataset
from hypogoal.domains.base import Engine
from hypogoal.importing.arrays import write_arrays
from hypogoal.observations import PICTURE, fields_of

NAME = re.compile(r"[A-Za-z0-9_-]+-v\d+")  # of a Minari dataset
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


def export(source: Path, out: Path, *, episodes: int, seed: int, force: bool, quiet: bool) -> str:
    """Write ``source`` for other software; returns a line that says how much, empty where there is nothing to say.

    A data file becomes arrays, a meta artefact so many ``episodes`` of its agent, an ensemble artefact a folder.
    """
    if not source.is_dir():
        export_arrays(source, out, force=force)
        return ""
    if open_artefact(source, "meta", "ensemble").kind == "ensemble":
        export_ensemble(source, out, force=force)
        return ""
    steps = export_episodes(source, out, episodes=episodes, seed=seed, force=force, quiet=quiet)
    return f"{amount(episodes, 'episode')}, {amount(steps, 'step')}"


def export_arrays(data: Path, out: Path, *, force: bool = False) -> None:
    """Write the states of a data file as ``.npz``, which ``import`` reads."""
    if out.suffix != ".npz":
        raise UserError("states are exported as .npz", out, "Give --out NAME.npz.")
    with create(out, kind=ARRAYS, config={}, seed=0, inputs=[data], force=force) as draft:
        write_arrays(draft.files / out.name, open_dataset(data))


def export_ensemble(source: Path, out: Path, *, force: bool = False) -> None:
    """Write the members of an ensemble artefact, ``load.py`` and a card into the folder ``out``.

    torch and safetensors load it without hypogoal. Members with layers or a view of the user's own are a ``UserError``.
    """
    from torch import nn

    from hypogoal.core.tensors import save_tensors
    from hypogoal.hypotheses import load
    from hypogoal.hypotheses.ensemble import read_ensemble
    from hypogoal.hypotheses.views import FullView

    artefact = open_artefact(source, "ensemble")
    config = artefact.config
    thresholds: dict[str, list[float]] = {}
    with create(out, kind="hub", config={}, seed=artefact.seed, inputs=[source], force=force) as draft:
        for goal in config["sub_goals"]:
            ensemble = read_ensemble(artefact.path, config, goal)
            if not isinstance(ensemble.view, FullView):
                do = "Export those trained with view=full."
                raise UserError("these members have a view of your own, which only hypogoal can load", source, do)
            members = nn.ModuleList(ensemble.members)
            state = {**members.state_dict(), **dict(ensemble.view.named_buffers())}
            save_tensors(draft.files / f"{goal}.safetensors", {name: part.clone() for name, part in state.items()})
            thresholds[goal] = [round(float(threshold), 6) for threshold in ensemble.thresholds]
        fields = fields_of(ensemble.observation_shape, ensemble.view.dtype)
        observations = {key: [str(kind), list(shape)] for key, (kind, shape) in fields.items()}
        facts = {
            "members": len(members),
            "thresholds": thresholds,
            "observations": observations,
            "layers": _layers(members[0].children(), source),
        }
        card = CARD.format(
            count=len(members),
            goals=", ".join(thresholds),
            first=next(iter(thresholds)),
            observations=observations,
            diversity=config["diversity"],
            version=artefact.manifest.versions["hypogoal"],
        )
        loader = Path(load.__file__).read_text(encoding="utf-8")
        (draft.files / "config.json").write_text(json.dumps(facts, indent=1) + "\n", encoding="utf-8")
        (draft.files / "README.md").write_text(card, encoding="utf-8")
        (draft.files / "load.py").write_text(loader, encoding="utf-8")


def _layers(layers: Iterable[Any], source: Path) -> list[Any]:
    """The names and arguments of layers, from which ``load.py`` builds them."""
    from torch import nn

    from hypogoal.hypotheses.load import ByKey

    rows: list[Any] = []
    for layer in layers:
        kind = type(layer)
        if isinstance(layer, ByKey):
            shapes = [list(shape) for shape in layer.shapes]
            encoders = [_layers(encoder.children(), source) for encoder in layer.encoders]
            rows.append([kind.__name__, {"shapes": shapes, "encoders": encoders}])
            continue
        if getattr(nn, kind.__name__, None) is not kind or [*layer.children()]:
            fault = f"only hypogoal can build the layer {kind.__name__}"
            raise UserError(fault, source, "Export members of a built-in network, such as doorkey.")
        names = {*inspect.signature(kind).parameters} & {*getattr(kind, "__constants__", ())}
        arguments = {name: getattr(layer, name) for name in sorted(names)}
        if isinstance(layer, nn.Conv2d):
            arguments["bias"] = layer.bias is not None
        rows.append([kind.__name__, arguments])
    return rows


def export_episodes(
    meta: Path, out: Path, *, episodes: int = 20, seed: int = 0, force: bool = False, quiet: bool = False
) -> int:
    """Let the agent of a meta artefact play and write its episodes as a Minari dataset; returns the number of steps.

    ``out`` is the dataset's folder; its name, such as ``solved-v0``, ends the dataset's id, see :func:`dataset_id`.
    ``seed`` determines the draws of options; ``infos/option`` is the option that led to each state, -1 at the start.
    A missing agent, another name, or an existing ``out`` is a ``UserError``.
    """
    from hypogoal.core.processes import prepare
    from hypogoal.meta.episodes import agent_of, play_episodes

    try:
        from minari import __version__
        from minari.dataset.minari_storage import MinariStorage
    except ImportError:
        raise UserError("episodes are written by minari", out, "Install it: pip install 'hypogoal[minari]'.") from None

    if not NAME.fullmatch(out.name):
        raise UserError("a Minari dataset needs a version in its name", out.name, "Give --out DIR/NAME-v0.")
    prepare()
    source = open_artefact(meta, "meta")
    where = source.config["layouts"] or source.config["layout_seed"]
    options = len(source.config["sub_goals"]) * source.config["members"]
    description = {
        "dataset_id": dataset_id(out),
        "minari_version": __version__,
        "algorithm_name": "hypogoal",
        "description": f"Episodes of an agent that chooses among {options} options "
        f"({source.config['domain']}, layout seed {where}, seed {seed}).",
    }
    config = {"episodes": episodes}
    with create(out, kind="episodes", config=config, seed=seed, inputs=[meta], force=force) as draft:
        loop = agent_of(source, seed)
        storage = MinariStorage.new(
            (draft.files / "data").resolve(),
            observation_space=_observation_space(loop.engine),
            action_space=spaces.Discrete(loop.engine.n_actions),
            jpeg_encoding=False,
        )
        storage.update_metadata(description)
        with Progress("export", total=episodes, quiet=quiet) as progress:
            storage.update_episodes(_buffers(play_episodes(loop, episodes), progress))
        return int(storage.total_steps)


def _observation_space(engine: Engine) -> spaces.Space[Any]:
    """The space of an engine's observations, a ``Dict`` of those with keys."""
    fields = fields_of(engine.observation_shape, engine.observation_dtype)
    boxes: dict[str, spaces.Space[Any]] = {key: _box(shape, dtype) for key, (dtype, shape) in fields.items()}
    return boxes[""] if "" in boxes else spaces.Dict(boxes)


def _box(shape: tuple[int, ...], dtype: DTypeLike) -> spaces.Box:
    if dtype == PICTURE:
        return spaces.Box(0, 255, shape, np.uint8)
    return spaces.Box(-np.inf, np.inf, shape, np.float32)


def _buffers(episodes: Iterable[Any], progress: Progress) -> Iterator[Any]:
    """Episodes as minari takes them."""
    from minari.data_collector import EpisodeBuffer

    for number, episode in enumerate(episodes, 1):
        last = np.arange(len(episode.actions)) == len(episode.actions) - 1
        seen = episode.observations
        yield EpisodeBuffer(
            observations={key: seen[key] for key in seen.dtype.names} if seen.dtype.names else seen,
            actions=episode.actions,
            rewards=episode.rewards,
            terminations=last & episode.terminated,
            truncations=last & (not episode.terminated),
            infos={"option": np.concatenate([[-1], episode.options])},
        )
        progress.update(number)


def dataset_id(out: Path) -> str:
    """The id by which minari finds a dataset's folder: its path below minari's root folder, else its name."""
    configured = os.environ.get("MINARI_DATASETS_PATH")
    root = Path(os.path.expanduser("~"), ".minari", "datasets") if configured is None else Path(configured)
    place, root = out.resolve(), root.resolve()
    return place.relative_to(root).as_posix() if place.is_relative_to(root) else out.name
