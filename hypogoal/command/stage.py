"""A stage is one function, which becomes a command and a Python function of the same name. So does a tool.

``@stage(...)`` makes of ``train_meta(call, ensemble, *, options=None)`` the command ``hypogoal train-meta ENSEMBLE
--options PATH --out OUT`` and the function ``hypogoal.train_meta(ensemble, out, options=...)``, with the same
arguments, settings and checks. What takes time to import is imported when the function is called, so that ``--help`` is
quick. ``LISTED`` has every stage and tool by the name of its command.
"""

import functools
import inspect
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from importlib import import_module
from inspect import Parameter
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer
from typer import Option

from hypogoal.command.call import Call, Done, Place
from hypogoal.core import own_code
from hypogoal.core.errors import Complete, UserError
from hypogoal.core.progress import say

if TYPE_CHECKING:
    from hypogoal.look import Made

LISTED = {  # every stage and tool, after those whose outputs it reads; loaded when it is called
    "collect": "Collect labelled, unlabelled and held-out states.",
    "import": "Make a data file of your arrays, pictures or recorded episodes.",
    "train-ensemble": "Train diverse classifiers (members) for each sub-goal.",
    "train-options": "Learn an option (a policy) for every member.",
    "train-meta": "Learn from the reward which options to choose.",
    "train-baseline": "Train PPO or DQN without options, to compare.",
    "evaluate": "Compute every number of a run, such as accuracies and choices.",
    "report": "Draw the report of an evaluated run as one HTML file.",
    "compare": "Put evaluated runs side by side, and say which one wins.",
    "export": "Write an agent's episodes or an ensemble for other software.",
    "audit": "Say how often, and where, policies fool a success classifier.",
}
LOOK, OWN = "Look", "Own data and code"  # groups of commands
TOOLS = {"compare": LOOK, "import": OWN, "export": OWN, "audit": OWN}
SET = "Change a setting; 'hypogoal config STAGE' lists all. May be repeated."
Set = Annotated[list[str] | None, Option("--set", metavar="KEY=VALUE", help=SET)]


def stage(example: str, **more: Any) -> Callable[[Callable[..., Done]], Callable[..., "Made"]]:
    """Return a decorator that makes a function a stage. ``example`` and ``more`` are attributes of :class:`Stage`."""
    return lambda function: Stage(function, example, **more).python()


@dataclass
class Stage:
    """A function as a stage. It gets a :class:`Call`, then what it works on, then its own inputs by name.

    Attributes:
        function: the function.
        example: a command, with which ``--help`` ends.
        often: the settings that are changed most, which are options of the command.
        leaves_out: options of all stages that this stage does not have.
        then: the next command. ``{source}`` is what the stage worked on, ``{out}`` the output, ``{run}`` the output's
            folder.
        into: the default output, a name within what the stage works on.
    """

    function: Callable[..., Done]
    example: str
    often: Sequence[str] = ()
    leaves_out: Sequence[str] = ()
    then: str = ""
    into: str = ""

    def __post_init__(self) -> None:
        self.name, *_ = self.example.split()
        _, self.source, *self.inputs = inspect.signature(self.function).parameters.values()
        _, self.out, _, *shared = inspect.signature(Call).parameters.values()
        options = [option for option in shared if option.name not in self.leaves_out]
        self.options = [*self.inputs, *options]
        if self.into:
            by_default = Option("--out", help=f"The folder to write. Default: {self.source.name.upper()}/{self.into}.")
            self.out = self.out.replace(default=None, annotation=Annotated[Path | None, by_default])

    def python(self) -> Callable[..., "Made"]:
        """Return the Python function. Its arguments that are neither inputs nor options are settings."""

        @functools.wraps(self.function)
        def called(source: Any, out: Place | None = None, **arguments: Any) -> "Made":
            from hypogoal.core.processes import own_settings
            from hypogoal.look import Made

            own_code.allow([source, *arguments.values()])
            values = {}
            for each in self.options:
                values[each.name] = _as_path(each, arguments.pop(each.name, each.default))
            with own_settings():
                call, _ = self.run(_as_path(self.source, source), out, values, arguments)
            return Made(call.out)

        out = self.out.replace(kind=Parameter.POSITIONAL_OR_KEYWORD, default=None)
        settings = Parameter("settings", Parameter.VAR_KEYWORD)
        called.__signature__ = inspect.Signature([self.source, out, *self.options, settings])  # type: ignore[attr-defined]
        called.stage = self  # type: ignore[attr-defined]
        return called

    @functools.cached_property
    def command(self) -> Any:
        """The command of the command line."""

        def called(**values: Any) -> None:
            typed = self._take_settings(values)
            source = values.pop(self.source.name)
            call, done = self.run(source, values.pop("out"), values, typed)
            if not (call.quiet or done.told):
                say(*done.lines)
                if then := done.then or self.then:
                    places = {"source": source, "out": call.out, "run": call.out.parent}
                    words = [word.format(**places) for word in then.split()]
                    say(f"next: {own_code.command(*words, *_kept(call, words[0]))}")
            page = call.out / "index.html"
            say(done.told or done.path or (page if page.is_file() else call.out))
            raise typer.Exit(done.code)

        source = self.source.replace(kind=Parameter.KEYWORD_ONLY)
        parameters = [source, self.out, *self.options, *self._settings()]
        called.__signature__ = inspect.Signature(parameters)  # type: ignore[attr-defined]
        example = f"Example:\n\n[bold]hypogoal {self.example}[/bold]"
        alone = typer.Typer(add_completion=False)
        alone.command(self.name, help=LISTED[self.name], epilog=example)(called)
        return typer.main.get_command(alone)

    def parsed(self, words: Sequence[str]) -> tuple[dict[str, Any], dict[str, Any]]:
        """Return the arguments and options in a command's words, and the settings that they give. Nothing is run."""
        with self.command.make_context(self.name, [*words]) as context:
            values = dict(context.params)
        return values, self._take_settings(values)

    def _take_settings(self, values: dict[str, Any]) -> dict[str, Any]:
        """Remove the settings from the ``values`` of options, and return them. ``--set`` wins."""
        from hypogoal.core.config import assigned

        chosen = {name: values.pop(name) for name in self.often}
        typed = {name: value for name, value in chosen.items() if value is not None}
        return typed | assigned(values.pop("set_", None) or ())

    def _settings(self) -> Iterator[Parameter]:
        """Yield ``--set``, and the options that are short for it. Their values stay text, which is read later."""
        from hypogoal.core.config import model_of
        from hypogoal.core.presets import described

        if "preset" in self.leaves_out:
            return
        yield Parameter("set_", Parameter.KEYWORD_ONLY, default=None, annotation=Set)
        rows = {row["name"]: row for row in described(model_of(self.name))} if self.often else {}
        panel = f"Settings and usual defaults (your domain's: hypogoal config {self.name})"
        for name in self.often:
            row = rows[name]
            meaning = row["meaning"][0].upper() + row["meaning"][1:]
            choices = f" ({row['allowed']})" if "|" in row["allowed"] else ""
            text = f"{meaning}{choices}. [dim]\\[default: {row['default']}][/dim]"
            option = Option(metavar=f"<{row['type']}>", help=text, rich_help_panel=panel)
            annotation = Annotated[str | None, option]
            yield Parameter(name, Parameter.KEYWORD_ONLY, default=None, annotation=annotation)

    def run(
        self,
        source: Any,
        out: Place | None,
        values: dict[str, Any],
        typed: Mapping[str, Any],
    ) -> tuple[Call, Done]:
        """Call the function with the ``values`` of inputs and options. Return the call, and what the function returned.

        With ``resume``, a complete output is kept.
        """
        if typed and "preset" in self.leaves_out:
            raise UserError(f"{self.name} has no settings", ", ".join(typed), "Leave them out.")
        inputs = {each.name: values.pop(each.name) for each in self.inputs}
        if "device" in values:
            from hypogoal.core.processes import prepare

            values["device"] = prepare(values["device"])
        place = Path(out) if out else Path(source, self.into)
        call = Call(stage=self.name, out=place, typed=typed, **values)
        try:
            return call, self.function(call, source, **inputs)
        except Complete as complete:
            say(complete, err=True)
            return call, Done()


def load_stage(name: str) -> Stage:
    """Return the stage of a command. Raises ``UserError`` if there is no such stage."""
    if name not in LISTED:
        raise UserError("this is no stage", name, f"Choose one of {', '.join(LISTED)}.")
    folder = "tools" if name in TOOLS else "stages"
    word = "import_data" if name == "import" else name.replace("-", "_")
    function = getattr(import_module(f"hypogoal.{folder}.{word}"), word)
    return function.stage


def _kept(call: Call, then: str) -> Iterator[str]:
    """Yield the preset and the typed settings of the world, which hold for the next stage as well."""
    from hypogoal.core.config import STAGES, model_of
    from hypogoal.domains.world import WorldConfig

    if then not in STAGES:
        return
    if call.preset:
        yield from ("--preset", call.preset)
    shared = model_of(then).model_fields.keys() & {*WorldConfig.model_fields, "layouts"}
    for name, value in call.typed.items():
        if name in shared:
            yield from ("--set", f"{name}={value}")


def _as_path(parameter: Parameter, value: Any) -> Any:
    """Return what Python gave for a path (a text, a path or what a stage made, or several of these) as paths.

    Where several may be given, one alone becomes a list.
    """
    annotation = str(parameter.annotation)
    if value is None or "Path" not in annotation:
        return value
    if isinstance(value, Iterable) and not isinstance(value, str):
        return [*map(Path, value)]
    path = Path(value)
    return [path] if "list[" in annotation else path
