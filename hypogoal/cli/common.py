"""Shared by all commands: the application, its options, and how results are printed."""

import contextlib
import inspect
import json
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, fields
from importlib.metadata import entry_points
from pathlib import Path
from typing import Annotated, Any

import typer
from typer import Argument, Option
from typer.core import TyperGroup

from hypogoal.core.config import parse_assignments
from hypogoal.core.files import MOST_INTEGER
from hypogoal.core.terminal import say
from hypogoal.settings import CONFIGS, TABLES, configuration, options_of
from hypogoal.stages import make

GROUPS = MAKE, LOOK, OWN = "Make", "Look", "Own data and code"  # of commands, as they are listed

KEYWORD = inspect.Parameter.KEYWORD_ONLY


class Interrupted(Exception):
    """Ctrl-C or SIGTERM; its cause is the ``KeyboardInterrupt``, which typer would turn into an exit code."""


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
        """By group, then in order of definition."""
        groups: Any = self.commands
        return sorted(groups, key=lambda name: GROUPS.index(groups[name].rich_help_panel))

    def get_command(self, ctx: Any, name: str) -> Any:
        command = super().get_command(ctx, name)
        _short_types(command.get_params(ctx) if command else [])
        return command

    def get_params(self, ctx: Any) -> Any:
        return _short_types(super().get_params(ctx))


def _short_types(options: Any) -> Any:
    """Options with short types for ``--help``: none for a switch, ``<int>`` for a range or a list."""
    for option in options:
        if getattr(option, "is_flag", False):
            option.metavar = ""
        elif option.param_type_name == "option" and option.metavar is None:
            option.metavar = f"<{option.bare_type().lower().removeprefix('list[').rstrip(']')}>"
            option._get_number_range_help_str = lambda: ""  # ranges have up to sixteen digits
    return options


app = typer.Typer(
    cls=Commands,
    help="Transferable sub-goals by hypothesising which features generalise.\n\nStart here: "
    "[bold]hypogoal run rooms --preset demo[/bold], two minutes from nothing to a report.",
    epilog="Each command's --help ends with an example. Settings: hypogoal config.",
    no_args_is_help=True,
    pretty_exceptions_enable=False,
    context_settings={"help_option_names": ["-h", "--help"]},
)


def command(panel: str, example: str, name: str | None = None) -> Any:
    """Make a function a command of a group; its ``--help`` ends with an example."""
    return app.command(name, rich_help_panel=panel, epilog=f"Example:\n\n[bold]hypogoal {example}[/bold]")


def offer(kind: str) -> Any:
    """For shell completion: all domains, presets, experiments, stages or settings."""

    def offered(ctx: typer.Context) -> list[str]:
        if kind == "experiment":
            from hypogoal.experiments.named import NAMES

            return sorted(NAMES)
        if kind == "domain":
            from hypogoal.domains.base import BUILT_IN, ENTRY_POINTS

            return sorted({*BUILT_IN, *(entry.name for entry in entry_points(group=ENTRY_POINTS))})
        if kind == "setting":
            stage = ctx.info_name or ""
            prefixed = {"": CONFIGS[stage]} if stage in CONFIGS else {f"{name}.": CONFIGS[name] for name in CONFIGS}
            return [f"{prefix}{field.name}=" for prefix, config in prefixed.items() for field in fields(config)]
        presets = (Path(__file__).parents[1] / "presets").glob("*/*.toml")
        return [*TABLES] if kind == "stage" else sorted({path.stem for path in presets})

    return offered


Out = Annotated[Path, Option("--out", help="What to write; it must not exist yet.")]
PRESET = "demo, paper, or your .toml file."
Preset = Annotated[str | None, Option("--preset", help=PRESET, autocompletion=offer("preset"))]
DOMAINS = "doorkey, montezuma, rooms, or module:object."
DomainName = Annotated[str, Argument(help=DOMAINS, autocompletion=offer("domain"))]
SET = "Change a setting; see 'hypogoal config'. Repeatable."
Set = Annotated[list[str] | None, Option("--set", metavar="KEY=VALUE", help=SET, autocompletion=offer("setting"))]
Seed = Annotated[int, Option("--seed", min=0, max=MOST_INTEGER, help="Seed of all randomness.")]
Force = Annotated[bool, Option("--force", help="Replace what is at --out.")]
Resume = Annotated[bool, Option("--resume", help="Continue an unfinished output; keep a complete one.")]
Quiet = Annotated[bool, Option("--quiet", "-q", help="Show no progress.")]
Device = Annotated[str, Option("--device", help="Where to train: auto (the CPU), cpu or cuda.")]
BOARD = "Also write the log for TensorBoard into this folder (pip install 'hypogoal[tensorboard]')."
Tensorboard = Annotated[Path | None, Option("--tensorboard", metavar="DIR", help=BOARD)]
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
class StageCall:
    """The options that all commands that train or collect share, with their values."""

    stage: str
    out: Path
    preset: str | None
    settings: Mapping[str, Any]  # from options and --set; --set wins
    how: Mapping[str, Any]  # seed, device, force, resume, quiet

    def make(self, source: str | Path, **inputs: Any) -> Any:
        """Run the stage, see :func:`hypogoal.stages.make`."""
        return make(self.stage, source, self.out, self.settings, self.preset, **inputs, **self.how)

    def config(self, domain: str) -> Any:
        """The stage's settings, see :func:`hypogoal.settings.configuration`."""
        return configuration(self.stage, domain, self.preset, (), self.settings)

    def end(self, numbers: Mapping[str, Any], *then: object) -> None:
        """Print the result, the next command and the output's path."""
        print_outcome(numbers, self.how["quiet"])
        print_next(self.how["quiet"], *then)
        say(self.out)


def stage(panel: str, name: str, example: str) -> Callable[[Callable[..., None]], None]:
    """Make a function a command that trains or collects: it gets a :class:`StageCall`, then its own arguments."""
    signature = inspect.signature(_shared)
    shared = [each for each in signature.parameters.values() if name != "collect" or each.name != "device"]
    panel_of_settings = f"Settings, with doorkey's defaults (all: hypogoal config {name})"
    settings = []
    for flag, row in options_of(name).items():  # values stay text, parsed as --set parses them
        choices = f" ({row['allowed']})" if "|" in row["allowed"] else ""
        text = f"{row['meaning'][0].upper()}{row['meaning'][1:]}{choices}. [dim]\\[default: {row['default']}][/dim]"
        option: Any = Option(flag, metavar=f"<{row['type']}>", help=text, rich_help_panel=panel_of_settings)
        settings.append(inspect.Parameter(row["name"], KEYWORD, default=None, annotation=Annotated[str | None, option]))

    def register(function: Callable[..., None]) -> None:
        def called(**values: Any) -> None:
            chosen = {each.name: value for each in settings if (value := values.pop(each.name)) is not None}
            how = {each.name: values.pop(each.name) for each in shared}
            out, preset, assignments = (how.pop(key) for key in ("out", "preset", "set_"))
            function(StageCall(name, out, preset, chosen | parse_assignments(assignments or ()), how), **values)

        _, *particular = inspect.signature(function).parameters.values()
        parameters = [each.replace(kind=KEYWORD) for each in (*particular, *shared, *settings)]
        called.__signature__ = signature.replace(parameters=parameters)  # type: ignore[attr-defined]
        called.__doc__ = function.__doc__
        command(panel, example, name)(called)

    return register


def run_of(data: Path) -> Path:
    """The run of a data file: the folder of a ``data.h5``, else a new folder named after the file."""
    return data.parent if data.name == "data.h5" else Path("runs", data.stem)


def print_counts(counts: Mapping[str, Any], quiet: bool) -> None:
    """Print the numbers of states of a data file; nothing if there are none."""
    from hypogoal.look import count_lines

    for line in [] if quiet or not counts else count_lines(counts):
        say(line)


def print_outcome(numbers: Mapping[str, Any], quiet: bool) -> None:
    """Print the results of training. NaN (no episode has ended) is left out: the number of episodes says it too."""
    if numbers and not quiet:
        texts = {key: f"{value:.4g}" if isinstance(value, float) else value for key, value in numbers.items()}
        say(", ".join(f"{key} {text}" for key, text in texts.items() if text != "nan"))


def print_next(quiet: bool, *words: object) -> None:
    """Print the next command as one would type it; nothing if there is none."""
    if words and not quiet:
        from hypogoal.core import own_code

        say(f"next: {own_code.command(*words)}")


def echo(value: Any, as_json: bool, text: list[str]) -> None:
    if as_json:
        say(json.dumps(value, indent=1))
    else:
        for line in text:
            say(line)
