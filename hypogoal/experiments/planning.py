"""From an experiment to its cells in a folder: what each reads, costs and is called (Spec A6, G4)."""

import contextlib
import re
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import fields
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
    domain = experiment.domain or DOMAIN
    by_stage: dict[str, list[str]] = {}
    if experiment.domain is None:
        assignments = _check_own(experiment, [*assignments], preset, device)
    else:
        assignments, by_stage = _split(experiment, assignments)
    config: Any = resolve(
        experiment.config_class, stage="run", preset=preset, assignments=assignments, domain=domain, tables=TABLES
    )

    @cache
    def settings_of(stage: str) -> Any:
        return configuration(stage, domain, preset, by_stage.get(stage, ()))

    settings = {name: getattr(config, name) for name in experiment.settings}
    commands = list(experiment.commands(settings, settings_of))
    if not commands:
        raise UserError("no cells in this experiment", experiment.name, "Give its axes values.")
    _check_apart(commands, settings)
    _check_free(experiment, commands, by_stage)
    common = {stage: ["--preset", preset] if preset else [] for stage in STAGES}
    for stage in experiment.stages:
        settings_of(stage)  # a mistake in any of them is refused, whether a command uses it or not
        common[stage] += [word for pair in by_stage.get(stage, ()) for word in ("--set", pair)]
        common[stage] += ["--device", device] if device != "auto" and stage in CONFIGS else []
    planned = _cells(commands, out, common, short=short and experiment.short)
    closing = Cost()
    if experiment.rates:
        estimates = Estimates(experiment.rates, domain)
        planned, closing = estimates.priced(planned), estimates.closing(planned)
    if getattr(config, "evaluate", True):
        planned += closing_cells(out, [cell.out for cell in planned], closing)
    return Plan(experiment.name, planned, config.workers or cores())


def _check_own(experiment: Experiment, assignments: list[str], preset: str | None, device: str) -> list[str]:
    """The assignments of an experiment without a domain; a ``UserError`` where it has not such settings."""
    for option, value in (("preset", preset or ""), ("device", "" if device == "auto" else device)):
        if value:
            do = f"Write --{option} into its commands."
            raise UserError(f"an experiment of your own takes no {option}", value, do)
    names = [field.name for field in fields(experiment.config_class)]
    for key, text in parse_assignments(assignments).items():
        if key not in names:
            do = f"It has {', '.join(names)}."
            raise UserError("no such axis or setting in this experiment", f"{key}={text}", do)
    return assignments


def _split(experiment: Experiment, assignments: Iterable[str]) -> tuple[list[str], dict[str, list[str]]]:
    """The experiment's own assignments, and those of each of its stages without the stage's name."""
    of_run: list[str] = []
    by_stage: dict[str, list[str]] = {}
    for assignment in assignments:
        (key,) = parse_assignments([assignment])
        stage, dot, rest = key.partition(".")
        stage = stage.replace("_", "-") if dot else stage
        if not dot:
            of_run.append(assignment)
        elif stage in experiment.stages:
            by_stage.setdefault(stage, []).append(f"{rest}={assignment.partition('=')[2]}")
        else:
            raise UserError("no such stage in --set", stage, f"Choose one of {', '.join(experiment.stages)}.")
    return of_run, by_stage


def _check_free(experiment: Experiment, commands: Sequence[Command], by_stage: Mapping[str, Sequence[str]]) -> None:
    """Refuse settings of stages that commands give as an option: it would win over ``--set``."""
    for stage, pairs in by_stage.items():
        words = {word.split("=")[0] for command in commands if command.words[:1] == [stage] for word in command.words}
        for key in parse_assignments(pairs):
            if f"--{key.replace('_', '-')}" in words:
                names = [name for name in experiment.settings if name.removesuffix("s") == key] or experiment.settings
                do = f"Set {' or '.join(names)} instead."
                raise UserError("the experiment sets this for each cell", f"{stage}.{key}", do)


def _check_apart(commands: Sequence[Command], settings: Mapping[str, Any]) -> None:
    """Refuse commands of the same name, as two of a seed that is given twice are."""
    names = [command.name for command in commands]
    if len({*names}) < len(names):
        lists = {name: values for name, values in settings.items() if isinstance(values, tuple)}
        twice = [f"{name}={value}" for name, values in lists.items() for value in values if values.count(value) > 1]
        where = ", ".join(dict.fromkeys(twice)) or Counter(names).most_common(1)[0][0]
        raise UserError("two cells would be the same", where, "Give each value once.")
    flat = Counter([*(name.replace("/", "-") for name in names), "evaluate", "report"])
    if len(flat) < len(names) + 2:
        raise UserError("two cells would have the same name", flat.most_common(1)[0][0], MEND)


def _cells(commands: Sequence[Command], out: Path, common: Mapping[str, Sequence[str]], *, short: bool) -> list[Cell]:
    """The cell of each command, which reads outputs of those before it."""
    folders = [command.name.partition("/")[0] for command in commands]
    short = short and len({*folders}) == len(folders)
    cells: dict[str, Cell] = {}  # by the names that the commands give
    for command, folder in zip(commands, folders, strict=True):
        words, where = command.words, f"cell {command.name!r}"
        if not plain_name(folder) or not re.fullmatch(r"[\w-]+", folder) or folder in FOLDERS:
            raise UserError("cells need a name of their own, of letters, digits, - and _", where, MEND)
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
        cost = command.cost._replace(cores=_cores(words, sources))
        # Options of all cells of a stage stand before the cell's own: the last setting of a name counts, so --set
        # cannot turn a method or a control into another.
        words[2:2] = common[words[0]]
        place = out / ((folder if short else command.name) + (".h5" if words[0] == "collect" else ""))
        needs = [source.out for source in sources]
        cells[command.name] = stage_cell(place, out, words, needs, cost, _columns(command))
    return [*cells.values()]


def _columns(command: Command) -> Mapping[str, str | int | float]:
    columns = command.columns
    fits = isinstance(columns, Mapping) and all(isinstance(value, str | int | float) for value in columns.values())
    if not fits or not all(str(name).isidentifier() and name not in ("cell", "stage", *COLUMNS) for name in columns):
        raise UserError("columns must be names with texts or numbers", f"cell {command.name!r}", MEND)
    return columns


def _cores(words: Sequence[str], sources: Sequence[Cell]) -> int:
    """The processes that a command can use: train-ensemble one for each sub-goal, if those are known here."""
    if words[0] != "train-ensemble":
        return 1
    settings = dict(re.findall(r"--set[ =](\w+)=(\S+)", " ".join(words)))
    domain = next((cell.arguments[1] for cell in sources if cell.stage == "collect"), "")
    count = len(settings["sub_goals"].split(",")) if "sub_goals" in settings else 1
    if "sub_goals" not in settings:
        with contextlib.suppress(UserError):  # its cell refuses a domain that may not be loaded
            count = len(load_domain(domain).sub_goals)
    limit = settings.get("workers", "")
    return max(1, min(count, int(limit) if limit.isdigit() and int(limit) else count))
