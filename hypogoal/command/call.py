"""One call of a stage: what it was asked for, the output that it fills, and what it says at its end."""

import contextlib
import os
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from typer import Option

from hypogoal.core.progress import MetricsLog, Progress

if TYPE_CHECKING:
    from hypogoal.core.config import C
    from hypogoal.core.drafts import Draft

Place = str | os.PathLike[str]
DOMAINS = "doorkey, montezuma, rooms, or your own as module:object."
# Options that stages leave out if they do not train, or have no settings.
NO_TRAINING = ("device", "tensorboard")
NO_SETTINGS = ("preset", "seed", *NO_TRAINING)

Out = Annotated[Path, Option("--out", help="The file or folder to write, which must not exist yet.")]
Preset = Annotated[
    str | None, Option("--preset", help="A set of settings: demo (quick), paper (the paper's), or your .toml file.")
]
Seed = Annotated[int, Option("--seed", min=0, help="The number from which all random numbers are drawn.")]
Device = Annotated[str, Option("--device", help="Where to train: cpu, cuda, or auto, which means the CPU.")]
Force = Annotated[bool, Option("--force", metavar="", help="Replace what is at --out.")]
RESUME = "Continue an unfinished output, and keep a complete one."
Resume = Annotated[bool, Option("--resume", metavar="", help=RESUME)]
Quiet = Annotated[bool, Option("--quiet", "-q", metavar="", help="Show no progress.")]
BOARD = "Also write the log for TensorBoard into this folder; this needs pip install 'hypogoal\\[tensorboard]'."
Tensorboard = Annotated[Path | None, Option("--tensorboard", metavar="DIR", help=BOARD)]


@dataclass(frozen=True, kw_only=True)
class Call:
    """One call of a stage: where it writes, and how it was asked for. The fields after ``typed`` are options."""

    stage: str
    out: Out
    typed: Mapping[str, Any]  # settings: options and --set, or arguments in Python
    preset: Preset = None
    seed: Seed = 0
    device: Device = "auto"
    tensorboard: Tensorboard = None
    force: Force = False
    resume: Resume = False
    quiet: Quiet = False

    def settings(self, kind: type["C"], domain: str, inherited: Mapping[str, Any] | None = None) -> "C":
        """Return the stage's settings: defaults, the domain's, the preset's, those of continued options, typed ones."""
        from hypogoal.domains.find import settings_of

        return settings_of(kind, self.stage, domain, self.preset, self.typed, inherited=inherited)

    def draft(
        self,
        kind: str,
        config: Mapping[str, Any],
        inputs: Sequence[Path] = (),
    ) -> contextlib.AbstractContextManager["Draft"]:
        """Return the output to fill, see :func:`hypogoal.core.drafts.create`."""
        from hypogoal.core.drafts import create

        return create(
            self.out,
            kind=kind,
            config=config,
            seed=self.seed,
            inputs=inputs,
            force=self.force,
            resume=self.resume,
        )

    @contextlib.contextmanager
    def training(
        self,
        kind: str,
        config: Mapping[str, Any],
        inputs: Sequence[Path],
        steps: int,
    ) -> Iterator["Training"]:
        """Give the output to fill, with a log and a progress bar, for a training of ``steps`` steps."""
        from hypogoal.core.artefacts import LOG

        with (
            self.draft(kind, config, inputs) as draft,
            contextlib.closing(MetricsLog(draft.files / LOG, self.tensorboard)) as log,
            Progress(self.stage, steps, quiet=self.quiet) as progress,
        ):
            yield Training(draft, log, progress)


@dataclass(frozen=True)
class Training:
    """An artefact in training: its draft, its log, and its progress bar."""

    draft: "Draft"
    log: MetricsLog
    progress: Progress


@dataclass(frozen=True)
class Done:
    """What a stage says at its end."""

    lines: Sequence[str] = ()
    path: Path | None = None  # where to look, if not at the output or its page
    then: str = ""  # the next command, if not the stage's
    told: str = ""  # a line for programs, printed in place of lines, path and then
    code: int = 0  # the command's exit code


def outcome_of(numbers: Mapping[str, Any]) -> list[str]:
    """Return the results of training as a line.

    NaN, which means that no episode has ended, is left out, because the number of episodes says it, too.
    """
    texts = []
    for name, value in numbers.items():
        text = f"{value:.4g}" if isinstance(value, float) else str(value)
        if text != "nan":
            texts.append(f"{name} {text}")
    return [", ".join(texts)] if texts else []
