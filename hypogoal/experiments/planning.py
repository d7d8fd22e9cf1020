"""From an experiment to its cells in a folder: what each reads, costs and is called (Spec A6, G4)."""

import contextlib
import re
from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
from functools import cache
from pathlib import Path
from typing import Any

from hypogoal.core.config import DOMAIN, parse_assignments, resolve
from hypogoal.core.errors import UserError
from hypogoal.core.files import plain_name
from hypogoal.core.workers import cores
from hypogoal.domains.base import load_domain
from hypogoal.experiments.cells import COLUMNS, RESERVED, Cell, Cost, Plan, closing_cells, stage_cell
from hypogoal.experiments.costs import Estimates
from hypogoal.experiments.experiment import MEND, Command, Experiment
from hypogoal.settings import CONFIGS, STAGES, TABLES, configuration

FOLDERS = ("evaluation", "report", "logs", "slurm")  # in every run's folder
READ = re.compile(r"(--[\w-]+=)?@(.+)")


def make_plan(
    experiment: Experiment,
    out: Path,
    assignments: Iterable[str] = (),
    *,
    preset: str | None = None,
    device: str = "auto",
    short: bool = False,
) -> Plan:
    """The cells of an experiment in the folder ``out``; a ``UserError`` where they cannot be.

    ``assignments`` are ``SETTING=VALUES``, with commas between, in place of its defaults; ``workers=N``,
    ``evaluate=false``; where it has a domain also ``STAGE.KEY=VALUE``, and ``preset`` and ``device``. ``short``: leave
    layout and seed out of names if there is a single agent.
    """
    by_stage: dict[str, list[str]] = {}
    assignments = [*assignments]
    if experiment.domain is None:
        _refuse_settings_of_stages(experiment, assignments, preset, device)
    else:
        assignments, by_stage = _split(assignments)
        _check_stages(experiment, by_stage)
    config: Any = resolve(
        experiment.config_class,
        stage="run",
        preset=preset,
        assignments=assignments,
        domain=experiment.domain or DOMAIN,
        tables=TABLES,
    )
    settings = {name: getattr(config, name) for name in experiment.settings}

    @cache
    def settings_of(stage: str) -> Any:
        return configuration(stage, experiment.domain or DOMAIN, preset, by_stage.get(stage, ()))

    commands = list(experiment.commands(settings, settings_of))
    if not commands:
        raise UserError("no cells in this experiment", experiment.name, "Give its axes values.")
    _check_free(experiment, commands, by_stage)
    for stage in experiment.stages:
        settings_of(stage)  # a mistake in any of them is refused, whether a command uses it or not
    common = {stage: _common(stage, preset, by_stage.get(stage, ()), device) for stage in STAGES}
    _check_apart(commands, settings)
    planned = _cells(commands, out, common, short=short and experiment.short)
    closing = Cost()
    if experiment.rates:
        estimates = Estimates(experiment.rates, experiment.domain or DOMAIN)
        planned, closing = estimates.priced(planned), estimates.closing(planned)
    if getattr(config, "evaluate", True):
        planned += closing_cells(out, [cell.out for cell in planned], closing)
    return Plan(experiment.name, planned, config.workers or cores())


def _refuse_settings_of_stages(
    experiment: Experiment, assignments: Sequence[str], preset: str | None, device: str
) -> None:
    if preset is not None:
        raise UserError("an experiment of your own takes no preset", preset, "Write --preset into its commands.")
    if device != "auto":
        raise UserError("an experiment of your own takes no device", device, "Write --device into its commands.")
    known = [*experiment.settings, "workers", "evaluate"]
    for key, text in parse_assignments(assignments).items():
        if key not in known:
            do = f"It has {', '.join(known)}."
            raise UserError("no such axis or setting in this experiment", f"{key}={text}", do)


def _split(assignments: Iterable[str]) -> tuple[list[str], dict[str, list[str]]]:
    """The experiment's own assignments, and those of each stage without its name."""
    own: list[str] = []
    by_stage: dict[str, list[str]] = {}
    for assignment in assignments:
        (key,) = parse_assignments([assignment])
        stage, dot, rest = key.partition(".")
        if dot:
            value = assignment.partition("=")[2]
            by_stage.setdefault(stage.replace("_", "-"), []).append(f"{rest}={value}")
        else:
            own.append(assignment)
    return own, by_stage


def _check_stages(experiment: Experiment, by_stage: Mapping[str, Sequence[str]]) -> None:
    for stage in by_stage:
        if stage not in experiment.stages:
            raise UserError("no such stage in --set", stage, f"Choose one of {', '.join(experiment.stages)}.")


def _check_free(experiment: Experiment, commands: Sequence[Command], by_stage: Mapping[str, Sequence[str]]) -> None:
    """Refuse settings of stages that the experiment's commands give as options, which ``--set`` would go before."""
    for stage, pairs in by_stage.items():
        words = {word.split("=")[0] for command in commands if command.words[:1] == [stage] for word in command.words}
        for key in parse_assignments(pairs):
            if f"--{key.replace('_', '-')}" in words:
                known = [name for name in experiment.settings if name.removesuffix("s") == key] or experiment.settings
                do = f"Set {' or '.join(known)} instead."
                raise UserError("the experiment sets this for each cell", f"{stage}.{key}", do)


def _common(stage: str, preset: str | None, pairs: Sequence[str], device: str) -> list[str]:
    """The options that all commands of a stage are given."""
    words = ["--preset", preset] if preset else []
    words += [word for pair in pairs for word in ("--set", pair)]
    return words + (["--device", device] if device != "auto" and stage in CONFIGS else [])


def _check_apart(commands: Sequence[Command], settings: Mapping[str, Any]) -> None:
    """Refuse two commands of one name, as those of a seed that is given twice have."""
    count = Counter(command.name for command in commands)
    if names := [name for name in count if count[name] > 1]:
        lists = {name: values for name, values in settings.items() if isinstance(values, tuple)}
        twice = [f"{name}={value}" for name, values in lists.items() for value in values if values.count(value) > 1]
        where = ", ".join(dict.fromkeys(twice)) or names[0]
        raise UserError("two cells would be the same", where, "Give each value once.")
    count = Counter([*(command.name.replace("/", "-") for command in commands), "evaluate", "report"])
    name, most = count.most_common(1)[0]
    if most > 1:
        raise UserError("two cells would have the same name", name, MEND)


def _cells(commands: Sequence[Command], out: Path, common: Mapping[str, Sequence[str]], *, short: bool) -> list[Cell]:
    """The cell of each command, which reads outputs of those before it."""
    folders = [command.name.partition("/")[0] for command in commands]
    short = short and len({*folders}) == len(folders)
    cells: dict[str, Cell] = {}  # by the names that the commands give
    sub_goals = cache(_sub_goals)
    for command, folder in zip(commands, folders, strict=True):
        where = f"cell {command.name!r}"
        if not plain_name(folder) or not re.fullmatch(r"[\w-]+", folder) or folder in FOLDERS:
            raise UserError("cells need a name of their own, of letters, digits, - and _", where, MEND)
        words = command.words
        if not words or words[0] not in STAGES:
            raise UserError("the command must be a stage", where, f"Choose one of {', '.join(STAGES)}.")
        sources = []
        for number, word in enumerate(words):
            if match := READ.fullmatch(word):
                if match[2] not in cells:
                    raise UserError(f"{command.name} would read what no cell before it makes", match[2], MEND)
                sources.append(cells[match[2]])
                words[number] = f"{match[1] or ''}{sources[-1].out}"
        if any(word.split("=")[0] in RESERVED for word in words):  # even by a setting's value
            raise UserError(f"{', '.join(RESERVED)} are given by the sweep", where, MEND)
        _check_columns(command)
        # What is common to a stage comes behind stage and input, so that the cell's own come last: of settings the last
        # one counts, and a method or a control is what it is called, whatever all cells were given.
        words[2:2] = common[words[0]]
        cost = command.cost._replace(cores=_cores(words, sources, sub_goals))
        place = out / ((folder if short else command.name) + (".h5" if words[0] == "collect" else ""))
        needs = [source.out for source in sources]
        cells[command.name] = stage_cell(place, out, words, needs, cost, command.columns)
    return [*cells.values()]


def _check_columns(command: Command) -> None:
    columns = command.columns
    fits = isinstance(columns, Mapping) and all(isinstance(value, str | int | float) for value in columns.values())
    if not fits or not all(str(name).isidentifier() and name not in ("cell", "stage", *COLUMNS) for name in columns):
        raise UserError("columns must be names with texts or numbers", f"cell {command.name!r}", MEND)


def _cores(words: Sequence[str], sources: Sequence[Cell], sub_goals: Callable[[str], int]) -> int:
    """Processes that a command can use: training ensembles one for each sub-goal, as far as those are simply seen."""
    if words[0] != "train-ensemble":
        return 1
    settings = dict(re.findall(r"--set[ =](\w+)=(\S+)", " ".join(words)))
    collected = next((cell.arguments[1] for cell in sources if cell.stage == "collect" and cell.arguments[1:]), "")
    count = len(settings["sub_goals"].split(",")) if "sub_goals" in settings else sub_goals(collected)
    limit = settings.get("workers", "")
    return max(1, min(count, int(limit) if limit.isdigit() and int(limit) else count))


def _sub_goals(domain: str) -> int:
    """How many a domain has; 1 where it may not be loaded: whether it may run is for its cell to say."""
    with contextlib.suppress(UserError):
        return len(load_domain(domain).sub_goals)
    return 1
