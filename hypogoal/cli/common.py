"""What all commands share: the application, its options, and how outcomes are printed."""

import contextlib
import json
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path
from typing import Annotated, Any

import typer
from typer.core import TyperGroup

from hypogoal.core.files import MOST_INTEGER
from hypogoal.core.terminal import give, say


class Interrupted(Exception):
    """Ctrl-C or SIGTERM; its cause is the ``KeyboardInterrupt``, of which typer would make an exit code."""


@contextlib.contextmanager
def _interruptible() -> Iterator[None]:
    try:
        yield
    except KeyboardInterrupt as error:
        raise Interrupted from error


class _Commands(TyperGroup):
    make_context = _interruptible()(TyperGroup.make_context)
    invoke = _interruptible()(TyperGroup.invoke)


app = typer.Typer(
    cls=_Commands,
    help="Transferable sub-goals by hypothesising which features generalise.",
    no_args_is_help=True,
    pretty_exceptions_enable=False,
    context_settings={"help_option_names": ["-h", "--help"]},
)

Out = Annotated[Path, typer.Option("--out", help="What to write; it must not exist yet.")]
Preset = Annotated[str | None, typer.Option("--preset", help="demo, paper, or an own .toml file.")]
Set = Annotated[
    list[str] | None,
    typer.Option("--set", metavar="KEY=VALUE", help="Change a setting; see 'hypogoal config'."),
]
Seed = Annotated[int, typer.Option("--seed", min=0, max=MOST_INTEGER, help="Seed of everything that is random.")]
LayoutSeed = Annotated[
    int | None, typer.Option("--layout-seed", min=0, max=MOST_INTEGER, help="The layout to learn on.")
]
Force = Annotated[bool, typer.Option("--force", help="Replace what stands at --out.")]
Resume = Annotated[
    bool, typer.Option("--resume", help="Go on with what was begun; keep a complete --out as it is; else begin.")
]
Quiet = Annotated[bool, typer.Option("--quiet", "-q", help="No progress.")]
Device = Annotated[str, typer.Option("--device", help="auto (the CPU), cpu, or cuda for training.")]
AsJson = Annotated[bool, typer.Option("--json", help="Machine-readable output.")]


def values_of(assignments: Iterable[str] | None) -> list[str]:
    """What the user typed behind the ``=`` of each ``--set``: one value, or several with commas between."""
    from hypogoal.core.config import parse_assignments

    texts = parse_assignments(assignments or ()).values()
    return [value.strip() for text in texts for value in text.split(",")]


def domain_of(artefact: Path, kind: str) -> str:
    """The domain of a data file (kind ``data``) or of an artefact."""
    if kind == "data":
        from hypogoal.dataset import open_dataset

        return open_dataset(artefact).domain
    from hypogoal.core.artefacts import open_artefact

    return str(open_artefact(artefact, kind).config["domain"])


def print_counts(counts: Mapping[str, Any], quiet: bool) -> None:
    """The numbers of states of a data file."""
    if quiet:
        return
    for split in ("labelled", "heldout"):
        for sub_goal, row in counts[split].items():
            say(f"{split:9s} {sub_goal:20s} {row['states']:7d} states {row['positives']:7d} positives")
    say(f"unlabelled                     {counts['unlabelled']:7d} states")


def print_outcome(numbers: dict[str, Any], quiet: bool) -> None:
    """What training came to; what NaN says, that no episode has ended, the number of episodes says too."""
    if not quiet:
        texts = {key: f"{value:.4g}" if isinstance(value, float) else value for key, value in numbers.items()}
        say(", ".join(f"{key} {text}" for key, text in texts.items() if text != "nan"))


def echo(value: Any, as_json: bool, text: list[str]) -> None:
    if as_json:
        give(json.dumps(value, indent=1))
    else:
        for line in text:
            say(line)
