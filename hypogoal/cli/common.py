"""What all commands share: the application, its options, and how outcomes are printed."""

import contextlib
import inspect
import json
import shlex
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import typer
from typer.core import TyperGroup

from hypogoal.core.config import parse_assignments
from hypogoal.core.files import MOST_INTEGER
from hypogoal.core.terminal import give, say
from hypogoal.settings import configuration, options_of

GROUPS = MAKE, LOOK, OWN, MANY = "Make", "Look", "Own data and code", "Run many"  # of commands, as they are listed


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

    def list_commands(self, ctx: Any) -> list[str]:
        """By their groups, within one as they were made."""
        return sorted(super().list_commands(ctx), key=lambda name: GROUPS.index(self.commands[name].rich_help_panel))

    def get_command(self, ctx: Any, name: str) -> Any:
        command = super().get_command(ctx, name)
        _short_types(command.get_params(ctx) if command else [])
        return command

    def get_params(self, ctx: Any) -> Any:
        return _short_types(super().get_params(ctx))


def _short_types(options: Any) -> Any:
    """Options with short types for ``--help``: none for a switch, ``<int>`` where there is a range."""
    for option in options:
        if getattr(option, "is_flag", False):
            option.metavar = ""
        elif getattr(option, "min", None) is not None:
            option.metavar = f"<{option.bare_type()}>"
    return options


app = typer.Typer(
    cls=_Commands,
    help="Transferable sub-goals by hypothesising which features generalise.\n\nStart here: "
    "[bold]hypogoal run which-feature --preset demo[/bold], minutes from nothing to a report.",
    epilog="Each command's --help ends with an example. Settings: hypogoal config.",
    no_args_is_help=True,
    pretty_exceptions_enable=False,
    context_settings={"help_option_names": ["-h", "--help"]},
)


def command(panel: str, example: str, name: str | None = None) -> Any:
    """Makes a function a command of a group, whose ``--help`` ends with an example."""
    return app.command(name, rich_help_panel=panel, epilog=f"Example: [bold]hypogoal {example}[/bold]")


def _whole(text: object) -> int:
    if not str(text).isdecimal() or int(str(text)) > MOST_INTEGER:
        raise typer.BadParameter(f"{text!r} is no integer from 0 to {MOST_INTEGER}.")
    return int(str(text))


def seed_option(meaning: str, *names: str) -> Any:
    """An option for an integer that any file can hold; its type is told in one word."""
    return typer.Option(*names, parser=_whole, metavar="<int>", help=meaning)


Out = Annotated[Path, typer.Option("--out", help="What to write; it must not exist yet.")]
Preset = Annotated[str | None, typer.Option("--preset", help="demo, paper, or an own .toml file.")]
Set = Annotated[
    list[str] | None,
    typer.Option("--set", metavar="KEY=VALUE", help="Change a setting; see 'hypogoal config'. Repeatable."),
]
Seed = Annotated[int, seed_option("Seed of everything that is random.", "--seed")]
Force = Annotated[bool, typer.Option("--force", help="Replace what stands at --out.")]
Resume = Annotated[
    bool, typer.Option("--resume", help="Go on with what was begun; keep a complete --out as it is; else begin.")
]
Quiet = Annotated[bool, typer.Option("--quiet", "-q", help="No progress.")]
Device = Annotated[str, typer.Option("--device", help="auto (the CPU), cpu, or cuda for training.")]
AsJson = Annotated[bool, typer.Option("--json", help="Machine-readable output.")]


def _shared(
    out: Out,
    preset: Preset = None,
    set_: Set = None,
    seed: Seed = 0,
    device: Device = "auto",
    force: Force = False,
    resume: Resume = False,
    quiet: Quiet = False,
) -> None:
    """The options of every command that trains or collects."""


def _shorthands(stage: str) -> Iterator[inspect.Parameter]:
    """The settings of a stage that people change most, as options; what ``--set`` would be told is their value."""
    panel = f"Settings, with doorkey's defaults (all: hypogoal config {stage})"
    for flag, row in options_of(stage).items():
        choices = f" ({row['allowed']})" if "|" in row["allowed"] else ""
        told = f"{row['meaning'][0].upper()}{row['meaning'][1:]}{choices}. [dim]\\[default: {row['default']}][/dim]"
        option = typer.Option(flag, metavar=f"<{row['type']}>", help=told, rich_help_panel=panel)
        kind: Any = Annotated[str | None, option]
        yield inspect.Parameter(row["name"], inspect.Parameter.KEYWORD_ONLY, default=None, annotation=kind)


@dataclass(frozen=True)
class Given:
    """What a command that trains or collects was told besides its own."""

    stage: str
    out: Path
    preset: str | None
    assignments: list[str]  # of --set
    settings: Mapping[str, str | None]  # of the options that are settings
    how: Mapping[str, Any]  # of every stage: seed, device, force, resume, quiet

    @property
    def values(self) -> list[str]:
        """What the user typed as the value of a setting."""
        return [*filter(None, self.settings.values()), *values_of(self.assignments)]

    def config(self, domain: str, *, given: bool = False) -> Any:
        """The stage's settings, see :func:`hypogoal.settings.configuration`."""
        return configuration(self.stage, domain, self.preset, self.assignments, self.settings, given=given)

    def end(self, numbers: Mapping[str, Any], *then: object) -> None:
        """Say what it came to and which command follows, and print where it is."""
        print_outcome(numbers, self.how["quiet"])
        print_next(self.how["quiet"], *then)
        give(self.out)


def stage(panel: str, name: str, example: str) -> Callable[[Callable[..., None]], None]:
    """Makes a function a command that trains or collects: it gets a :class:`Given` of what all have, then its own."""
    signature = inspect.signature(_shared)
    shared = [one for one in signature.parameters.values() if name != "collect" or one.name != "device"]
    settings = [*_shorthands(name)]

    def made(function: Callable[..., None]) -> None:
        def called(**values: Any) -> None:
            chosen = {of.name: values.pop(of.name) for of in settings}
            told = {of.name: values.pop(of.name) for of in shared}
            out, preset, assignments = (told.pop(key) for key in ("out", "preset", "set_"))
            function(Given(name, out, preset, assignments or [], chosen, told), **values)

        _, *own = inspect.signature(function).parameters.values()
        every = [one.replace(kind=one.KEYWORD_ONLY) for one in (*own, *shared, *settings)]
        called.__signature__ = signature.replace(parameters=every)  # type: ignore[attr-defined]
        called.__doc__ = function.__doc__
        command(panel, example, name)(called)

    return made


def values_of(assignments: Iterable[str] | None) -> list[str]:
    """What the user typed behind the ``=`` of each ``--set``: one value, or several with commas between."""
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


def print_outcome(numbers: Mapping[str, Any], quiet: bool) -> None:
    """What training came to; what NaN says, that no episode has ended, the number of episodes says too."""
    if numbers and not quiet:
        texts = {key: f"{value:.4g}" if isinstance(value, float) else value for key, value in numbers.items()}
        say(", ".join(f"{key} {text}" for key, text in texts.items() if text != "nan"))


def after_data(data: Path) -> tuple[object, ...]:
    """The command for a data file."""
    return "train-ensemble", data, "--out", Path("runs", data.stem, "ensemble")


def print_next(quiet: bool, *words: object) -> None:
    """The command that follows, as one would type it; nothing where none does."""
    if words and not quiet:
        say(f"next: {shlex.join(['hypogoal', *map(str, words)])}")


def echo(value: Any, as_json: bool, text: list[str]) -> None:
    if as_json:
        give(json.dumps(value, indent=1))
    else:
        for line in text:
            say(line)
