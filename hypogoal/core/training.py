"""What a training stage works with until its artefact is whole."""

import contextlib
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from hypogoal.core.artefacts import LOG, Draft, create
from hypogoal.core.checkpoints import Checkpoints
from hypogoal.core.progress import MetricsLog, Progress


@dataclass(frozen=True)
class Training:
    """An artefact in training: its draft, the folder to fill, its log, its progress bar, its checkpoints."""

    draft: Draft
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
    :func:`hypogoal.core.artefacts.create`.
    """
    with (
        create(out, resume=resume, **artefact) as draft,
        contextlib.closing(MetricsLog(draft.files / LOG, tensorboard)) as log,
        Progress(stage, steps, quiet=quiet) as progress,
    ):
        yield Training(draft, draft.files, log, progress, draft.checkpoints())
