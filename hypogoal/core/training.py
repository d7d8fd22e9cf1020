"""What a training stage works with until its artefact is whole."""

import contextlib
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from hypogoal.core.artefacts import create_artefact
from hypogoal.core.checkpoints import Checkpoints, checkpoints_of
from hypogoal.core.manifests import LOG
from hypogoal.core.progress import MetricsLog, Progress


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
    *,
    steps: int,
    quiet: bool,
    resume: bool,
    tensorboard: Path | None = None,
    **artefact: Any,
) -> Iterator[Training]:
    """Open the artefact; train and fill it in the block.

    ``tensorboard``: see :class:`hypogoal.core.progress.MetricsLog`; ``artefact``: see
    :func:`hypogoal.core.artefacts.create_artefact`.
    """
    with (
        create_artefact(out, resume=resume, **artefact) as folder,
        contextlib.closing(MetricsLog(folder / LOG, tensorboard)) as log,
        Progress(stage, steps, quiet=quiet) as progress,
    ):
        yield Training(folder, log, progress, checkpoints_of(folder))
