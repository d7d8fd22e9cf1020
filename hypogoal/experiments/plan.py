"""How the name of an experiment becomes its cells."""

import re
import shlex
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any

from hypogoal.cells import HERE, Cell
from hypogoal.command.stage import load_stage
from hypogoal.core.config import DOMAIN, STAGES, Config, assigned, resolve
from hypogoal.core.errors import UserError, reason
from hypogoal.core.own_code import allow
from hypogoal.core.presets import preset as read_preset
from hypogoal.domains.find import settings_of
from hypogoal.experiments.experiment import STAGE, Command, find_experiment
from hypogoal.hypotheses.config import TrainEnsembleConfig

OUTPUT = re.compile("(|.*=)@(.+)")  # a word with an output: @data, --data=@data
MEND = "An experiment yields (name, command) or (name, command, columns), see docs/formats.md."

NAMES = ("diversity", "network", "teacher", "threshold", "view")  # settings that name code
NEEDED = ("seeds", "layout_seeds", "layouts", "truths")  # settings without whose values there would be no agent


def plan(
    name: str,
    run: Path,
    *,
    preset: str | None = None,
    assignments: Iterable[str] = (),
    seeds: str | None = None,
    device: str = "auto",
) -> tuple[list[Cell], int]:
    """Return the cells of an experiment, and how many run at once (0: as many as can).

    ``assignments`` are ``SETTING=VALUES`` of the experiment and ``STAGE.KEY=VALUE``. ``seeds`` are the run seeds, such
    as ``0-9``. Raises ``UserError`` if the experiment cannot be planned.
    """
    experiment = find_experiment(name)
    preset = preset or experiment.preset
    of_run = {"seeds" if "seeds" in experiment.arguments else "seed": seeds}
    of_stage: dict[str, dict[str, str]] = {}
    for key, value in assigned(assignments).items():
        stage, dot, setting = key.partition(".")
        if dot:
            of_stage.setdefault(stage.replace("_", "-"), {})[setting] = value
        else:
            of_run[key] = value
    domain = experiment.domain
    of_preset = read_preset(preset, "run", domain) if domain else {}
    config = resolve(experiment.model, of_preset, experiment.given, of_run, stage="run")

    def settings(stage: str) -> Config:
        return settings_of(Config, stage, domain or DOMAIN, preset, of_stage.get(stage, {}))

    values = {**config.model_dump(), STAGE: settings}
    for name in NEEDED:
        if values.get(name) == ():
            raise UserError("a run needs at least one", name, f"Leave {name} out for the experiment's own.")
    commands = experiment.function(**{argument: values[argument] for argument in experiment.arguments})
    cells = [*_cells_of(commands, run, partial(_with_shared, preset, device, of_stage))]
    stages = dict.fromkeys(cell.stage for cell in cells)
    for stage in of_stage.keys() - stages:
        raise UserError("no such stage in --set", stage, f"This run has {', '.join(stages)}.")
    if STAGE not in experiment.arguments:
        _refuse_ignored(cells, of_stage)
    if config.evaluate:
        everything = [cell.place for cell in cells]
        evaluation = Cell(name="evaluation", words=["evaluate", HERE], needs=everything, run=run)
        report = Cell(name="report", words=["report", HERE], needs=[evaluation.place], run=run)
        cells += [evaluation, report]
    return cells, config.workers


def _refuse_ignored(cells: Iterable[Cell], settings: Mapping[str, Mapping[str, str]]) -> None:
    """Raise ``UserError`` if no command has a setting, by stage, that the user gave for all commands of its stage."""
    for stage, shared in settings.items():
        of_stage = [cell.words for cell in cells if cell.stage == stage]
        for name, value in shared.items():
            if not any(f"{name}={value}" in words for words in of_stage):
                fault = f"each {stage} of this experiment has a value of its own, or another choice"
                raise UserError(fault, f"{stage}.{name}", f"Leave it out, or give the command {stage} yourself.")


def _check_names(config: Config, usual: Config) -> None:
    """Load what settings of ``train-ensemble`` name, so that a wrong name is told before the first cell is made.

    Names in the domain's ``usual`` settings are not loaded, because loading them takes PyTorch.
    """
    if not isinstance(config, TrainEnsembleConfig):
        return
    if any(getattr(config, name) != getattr(usual, name) for name in NAMES):
        from hypogoal.hypotheses.sub_goals import check_names

        check_names(config)


def _cells_of(commands: Iterable[Any], run: Path, completed: Callable[..., Any]) -> Iterator[Cell]:
    """Yield a cell for each command. In a command, ``@NAME`` is the output of an earlier cell of that name.

    ``completed`` returns a command's words with the run's shared words, and the domain that the command plays.
    """
    cells: dict[str, Cell] = {}
    domains: dict[str, str] = {}  # domains by a cell's place
    for command in commands:
        try:
            name, text, columns, after = Command(*command)
            words = []
            needs = []
            for word in shlex.split(text):
                if output := OUTPUT.match(word):
                    option, other = output.groups()
                    place = cells[other].place
                    needs.append(place)
                    word = f"{option}{HERE}/{place}"
                words.append(word)
            domain = domains[needs[0]] if needs else DOMAIN
            words, domain = completed(words, domain)
            cell = Cell(
                name=name,
                words=words,
                needs=needs,
                after=[cells[other].place for other in after],
                columns=dict(columns),
                run=run,
            )
        except UserError as error:
            error.add_note(f"in the command {command[0]}")
            raise
        except (ValueError, TypeError, AttributeError, KeyError) as error:
            problem = f"this is no command, or reads what no cell before it makes ({reason(error)})"
            raise UserError(problem, command, MEND) from None
        if name in cells:
            raise UserError("a cell needs a name of its own", name, "Give each value once.")
        cells[name] = cell
        domains[cell.place] = domain
        yield cell


def _with_shared(
    preset: str | None,
    device: str,
    settings: Mapping[str, Mapping[str, str]],
    words: Sequence[str],
    domain: str,
) -> tuple[list[str], str]:
    """Return a command's words with the run's preset, device and settings (by stage), and the domain played.

    What the command says itself is left as it is. ``domain`` is the domain of the states that are read. Raises
    ``UserError`` if the stage does not take a setting.
    """
    stage, *rest = words
    loaded = load_stage(stage)
    if "resume" in loaded.leaves_out:
        raise UserError("a cell must be able to go on after a break, which this command is not", stage, MEND)
    values, typed = loaded.parsed([*rest, "--out", stage])
    domain = values.get("domain") or domain
    more = []
    if stage in STAGES:
        allow(words)  # a TOML file's names were allowed before; other names are in code that the user gave
        if preset and not values["preset"]:
            more += ["--preset", preset]
        if device != "auto" and values.get("device") == "auto":
            more += ["--device", device]
        shared = settings.get(stage, {})
        config = settings_of(Config, stage, domain, values["preset"] or preset, typed, inherited=shared)
        _check_names(config, settings_of(Config, stage, domain))
        for name, value in shared.items():
            if name in config.flat() and name not in typed:
                more += ["--set", f"{name}={value}"]
    return [*words, *more], domain
