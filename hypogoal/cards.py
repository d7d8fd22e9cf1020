"""The card of an artefact, its ``README.md``: what it is, how it was made, what came out, how to load it (Spec A8).

It repeats only manifest and files, so the same seed gives the same card. Quotes, which may be a stranger's words, stand
in indented lines, where Markdown has no markup, and are made printable.
"""

import contextlib
import json
import tomllib
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from functools import partial
from importlib import resources
from pathlib import Path
from typing import Any

from hypogoal.core import artefacts
from hypogoal.core.checkpoints import Checkpoints, checkpoints_of
from hypogoal.core.config import as_dict
from hypogoal.core.manifests import LOG
from hypogoal.core.preflight import Needs, preflight
from hypogoal.core.progress import MetricsLog, Progress
from hypogoal.core.terminal import printable
from hypogoal.inspection import outcome
from hypogoal.settings import CONFIGS

LONGEST = 300  # characters of a setting


def card(manifest: Mapping[str, Any], folder: Path) -> str:
    """The text, from what will be in the ``manifest`` of the artefact in ``folder``."""
    texts = tomllib.loads((resources.files("hypogoal") / "cards.toml").read_text(encoding="utf-8"))
    kind, config = manifest["kind"], manifest["config"]
    words = {"load": "hypogoal.Made('.').metrics", **texts[kind]}
    load = words.pop("load").format(goal=repr(next(iter(config.get("sub_goals", ())), "")))
    defaults = as_dict(CONFIGS[words["stage"]]()) if words["stage"] in CONFIGS else {}
    changed = {name: value for name, value in config.items() if name != "workers" and defaults.get(name) != value}
    lines = {
        "inputs": [f"{entry['relative']} ({entry['kind']})" for entry in manifest["inputs"]],
        "settings": [f"{name} = {json.dumps(value, ensure_ascii=False)[:LONGEST]}" for name, value in changed.items()],
        "outcome": outcome(kind, folder),
        "load": ["import hypogoal", *load.splitlines()],
    }
    quoted = {name: _quoted(some or ["none"]) for name, some in lines.items()}
    return str(texts["text"].lstrip().format(kind=kind, seed=manifest["seed"], **words, **quoted))


def _quoted(lines: Iterable[str]) -> str:
    return "\n".join(f"    {printable(line)}" for line in lines)


create_artefact = partial(artefacts.create_artefact, card=card)  # what stages write


@dataclass(frozen=True)
class Training:
    """An artefact in training: the folder to fill, its log, its progress bar, its checkpoints."""

    folder: Path
    log: MetricsLog
    progress: Progress
    checkpoints: Checkpoints


@contextlib.contextmanager
def training(
    stage: str,
    out: Path,
    needs: Needs,
    *,
    steps: int,
    quiet: bool,
    resume: bool,
    tensorboard: Path | None = None,
    **artefact: Any,
) -> Iterator[Training]:
    """Refuse what does not fit on this machine, then open the artefact; train and fill it in the block.

    ``tensorboard``: see :class:`hypogoal.core.progress.MetricsLog`; ``artefact``: see
    :func:`hypogoal.core.artefacts.create_artefact`.
    """
    preflight(stage, out, needs, resume=resume, quiet=quiet)
    with (
        create_artefact(out, resume=resume, **artefact) as folder,
        contextlib.closing(MetricsLog(folder / LOG, tensorboard)) as log,
        Progress(stage, steps, quiet=quiet) as progress,
    ):
        yield Training(folder, log, progress, checkpoints_of(folder))
