"""What all commands share: the application, its options, and how outcomes are printed."""

import contextlib
import inspect
import json
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass, fields
from importlib.metadata import entry_points
from pathlib import Path
from typing import Annotated, Any

import typer
from typer import Argument, Option
from typer.core import TyperGroup

from hypogoal.core.config import parse_assignments
from hypogoal.core.files import MOST_INTEGER
from hypogoal.core.terminal import give, say
from hypogoal.settings import CONFIGS, TABLES, configuration, options_of
from hypogoal.stages import make

GROUPS = MAKE, LOOK, OWN, MANY = "Make", "Look", "Own data and code", "Run many"  # of commands, as they are listed

KEYWORD = inspect.Parameter.KEYWORD_ONLY


class Interrupted(Exception):
    """Ctrl-C or SIGTERM; its cause is the ``KeyboardInterrupt``, of which typer would make an exit code."""


@contextlib.contextmanager
def _interruptible() -> Iterator[None]:
    try:
        yield
    except KeyboardInterrupt as error:
        raise Interrupted from error


class Commands(TyperGroup):
    make_context = _interruptible()(TyperGroup.make_context)
    invoke = _interruptible()(TyperGroup.invoke)

    def list_commands(self, ctx: Any) -> list[str]:
        """By their groups, within one as they were made."""
        groups: Any = self.commands
        return sorted(groups, key=lambda name: GROUPS.index(groups[name].rich_help_panel))

    def get_command(self, ctx: Any, name: str) -> Any:
        command = super().get_command(ctx, name)
        _short_types(command.get_params(ctx) if command else [])
        return command

    def get_params(self, ctx: Any) -> Any:
        return _short_types(super().get_params(ctx))


def _short_types(options: Any) -> Any:
    """Options with short types for ``--help``: none of a switch, ``<int>`` of a range or a list."""
    for option in options:
        if getattr(option, "is_flag", False):
            option.metavar = ""
        elif option.param_type_name == "option" and option.metavar is None:
            option.metavar = f"<{option.bare_type().lower().removeprefix('list[').rstrip(']')}>"
            option._get_number_range_help_str = lambda: ""  # of up to sixteen digits
    return options


app = typer.Typer(
    cls=Commands,
    help="Transferable sub-goals by hypothesising which features generalise.\n\nStart here: "
    "[bold]hypogoal run which-feature --preset demo[/bold], minutes from nothing to a report.",
    epilog="Each command's --help ends with an example. Settings: hypogoal config.",
    no_args_is_help=True,
    pretty_exceptions_enable=False,
    context_settings={"help_option_names": ["-h", "--help"]},
)


def command(panel: str, example: str, name: str | None = None, of: typer.Typer = app) -> Any:
    """Makes a function a command of a group, whose ``--help`` ends with an example."""
    return of.command(name, rich_help_panel=panel, epilog=f"Example: [bold]hypogoal {example}[/bold]")


def offer(kind: str) -> Any:
    """For a shell's completion: the domains, presets, experiments or settings that begin like the word so far."""

    def offered(ctx: typer.Context, incomplete: str) -> list[str]:
        presets, stage = Path(__file__).parents[1] / "presets", ctx.info_name or ""
        named = {path.stem for path in presets.glob("*/*.toml")}
        if kind == "experiment":
            from hypogoal.experiments.named import NAMES

            named = {*NAMES}
        elif kind == "setting":
            own = {"": CONFIGS[stage]} if stage in CONFIGS else {f"{name}.": of for name, of in CONFIGS.items()}
            named = {f"{prefix}{field.name}=" for prefix, of in own.items() for field in fields(of)}
        elif kind == "stage":
            named = {*TABLES}
        elif kind == "domain":
            from hypogoal.domains.base import BUILT_IN, ENTRY_POINTS

            named = {*BUILT_IN, *(found.name for found in entry_points(group=ENTRY_POINTS))}
        return sorted(name for name in named if name.startswith(incomplete))

    return offered


Out = Annotated[Path, Option("--out", help="What to write; it must not exist yet.")]
OWN_PRESET = "demo, paper, or a .toml file of your own."
Preset = Annotated[str | None, Option("--preset", help=OWN_PRESET, autocompletion=offer("preset"))]
DOMAINS = "doorkey, montezuma, which-feature, or module:object."
DomainName = Annotated[str, Argument(help=DOMAINS, autocompletion=offer("domain"))]
SET = "Change a setting; see 'hypogoal config'. Repeatable."
Set = Annotated[list[str] | None, Option("--set", metavar="KEY=VALUE", help=SET, autocompletion=offer("setting"))]
PLAYED = "Also take states from this recorded play, a JSON file or a Minari dataset; own domains. Repeatable."
Play = Annotated[list[str] | None, Option("--play", metavar="FILE", help=PLAYED)]
Seed = Annotated[int, Option("--seed", min=0, max=MOST_INTEGER, help="Seed of everything that is random.")]
Force = Annotated[bool, Option("--force", help="Replace what is at --out.")]
Resume = Annotated[bool, Option("--resume", help="Continue what was begun; keep what is complete.")]
Quiet = Annotated[bool, Option("--quiet", "-q", help="Show no progress.")]
Device = Annotated[str, Option("--device", help="Where to train: auto (the CPU), cpu or cuda.")]
AsJson = Annotated[bool, Option("--json", help="Machine-readable output.")]


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


@dataclass(frozen=True)
class Given:
    """What a command that trains or collects was told besides its own."""

    stage: str
    out: Path
    preset: str | None
    settings: Mapping[str, Any]  # of options, and of --set, which counts more
    how: Mapping[str, Any]  # of every stage: seed, device, force, resume, quiet

    def make(self, source: str | Path, **own: Any) -> Any:
        """Run the stage, see :func:`hypogoal.stages.make`."""
        return make(self.stage, source, self.out, self.settings, self.preset, **own, **self.how)

    def config(self, domain: str, *, given: bool = False) -> Any:
        """The stage's settings, see :func:`hypogoal.settings.configuration`."""
        return configuration(self.stage, domain, self.preset, (), self.settings, given=given)

    def end(self, numbers: Mapping[str, Any], *then: object) -> None:
        """Say what it came to and which command follows, and print where it is."""
        print_outcome(numbers, self.how["quiet"])
        print_next(self.how["quiet"], *then)
        give(self.out)


def stage(panel: str, name: str, example: str) -> Callable[[Callable[..., None]], None]:
    """Makes a function a command that trains or collects: it gets a :class:`Given` of what all have, then its own."""
    signature = inspect.signature(_shared)
    shared = [one for one in signature.parameters.values() if name != "collect" or one.name != "device"]
    panel_of_settings = f"Settings, with doorkey's defaults (all: hypogoal config {name})"
    settings = []
    for flag, row in options_of(name).items():  # what is typed is what --set would be told
        choices = f" ({row['allowed']})" if "|" in row["allowed"] else ""
        told = f"{row['meaning'][0].upper()}{row['meaning'][1:]}{choices}. [dim]\\[default: {row['default']}][/dim]"
        option: Any = Option(flag, metavar=f"<{row['type']}>", help=told, rich_help_panel=panel_of_settings)
        settings.append(inspect.Parameter(row["name"], KEYWORD, default=None, annotation=Annotated[str | None, option]))

    def made(function: Callable[..., None]) -> None:
        def called(**values: Any) -> None:
            chosen = {of.name: value for of in settings if (value := values.pop(of.name)) is not None}
            told = {of.name: values.pop(of.name) for of in shared}
            out, preset, assignments = (told.pop(key) for key in ("out", "preset", "set_"))
            function(Given(name, out, preset, chosen | parse_assignments(assignments or ()), told), **values)

        _, *own = inspect.signature(function).parameters.values()
        every = [one.replace(kind=KEYWORD) for one in (*own, *shared, *settings)]
        called.__signature__ = signature.replace(parameters=every)  # type: ignore[attr-defined]
        called.__doc__ = function.__doc__
        command(panel, example, name)(called)

    return made


def values_of(assignments: Iterable[str] | None) -> list[str]:
    """What the user typed behind the ``=`` of each ``--set``: one value, or several with commas between."""
    texts = parse_assignments(assignments or ()).values()
    return [value.strip() for text in texts for value in text.split(",")]


def run_of(data: Path) -> Path:
    """The run that a data file is of: the folder of a ``data.h5``, else a new one that is called as the file is."""
    return data.parent if data.name == "data.h5" else Path("runs", data.stem)


def print_counts(counts: Mapping[str, Any], quiet: bool) -> None:
    """The numbers of states of a data file; nothing where there are none."""
    from hypogoal.inspection import count_lines

    for line in [] if quiet or not counts else count_lines(counts):
        say(line)


def print_outcome(numbers: Mapping[str, Any], quiet: bool) -> None:
    """What training came to; what NaN says, that no episode has ended, the number of episodes says too."""
    if numbers and not quiet:
        texts = {key: f"{value:.4g}" if isinstance(value, float) else value for key, value in numbers.items()}
        say(", ".join(f"{key} {text}" for key, text in texts.items() if text != "nan"))


def print_next(quiet: bool, *words: object) -> None:
    """The command that follows, as one would type it; nothing where none does."""
    if words and not quiet:
        from hypogoal.core.commands import command as typed

        say(f"next: {typed(*words)}")


def command_again(context: typer.Context, **changes: object) -> str:
    """The command that runs, as one would type it, with other values of some options."""
    from hypogoal.core.commands import command as typed

    words: list[object] = [context.info_name]
    for option in context.command.params:
        value = changes.get(str(option.name), context.params.get(str(option.name)))
        if option.param_type_name == "argument":
            words.append(value)
        elif value and value != option.default:
            switch = option.opts[0]
            values = value if isinstance(value, list) else [value]
            words += [switch] if value is True else [word for each in values for word in (switch, each)]
    return typed(*words)


def echo(value: Any, as_json: bool, text: list[str]) -> None:
    if as_json:
        give(json.dumps(value, indent=1))
    else:
        for line in text:
            say(line)
