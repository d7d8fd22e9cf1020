"""From an experiment to its cells in a folder: what each reads and is called (Spec A6, G4)."""

import re
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from functools import cache
from pathlib import Path
from typing import Any

from hypogoal.core.config import DOMAIN, parse_assignments, resolve
from hypogoal.core.errors import UserError
from hypogoal.core.files import path_part, plain_name
from hypogoal.core.workers import cores
from hypogoal.domains.base import load_domain
from hypogoal.experiments.cells import COLUMNS, RESERVED, Cell, Plan, closing_cells
from hypogoal.experiments.experiment import MEND, Command, Experiment
from hypogoal.settings import CONFIGS, STAGES, TABLES, configuration

MOST_JUDGED = 6  # ensembles that an evaluation judges at once
ROOMS_AT_ONCE = 6  # that a collection of Montezuma plays in, each in a process
FOLDERS = ("evaluation", "report", "logs", "slurm")  # in every run's folder
READ = re.compile(r"--[\w-]+=@.+")


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

    ``assignments`` are ``SETTING=VALUES``, with commas between, in place of its defaults; where it has a domain also
    ``STAGE.KEY=VALUE``, and ``preset`` and ``device``. ``short``: leave layout and seed out of names if there is a
    single agent of an experiment on a domain.
    """
    domain = experiment.domain or DOMAIN
    if experiment.domain is None and (preset or device != "auto"):
        problem = "an experiment of your own takes no preset and no device"
        raise UserError(problem, preset or device, "Write --preset and --device into its commands.")
    of_run, by_stage = _split(experiment, assignments)
    config: Any = resolve(
        experiment.config_class, stage="run", preset=preset, assignments=of_run, domain=domain, tables=TABLES
    )

    @cache
    def settings_of(stage: str) -> Any:
        return configuration(stage, domain, preset, by_stage.get(stage, ()))

    settings = {name: getattr(config, name) for name in experiment.settings}
    commands = list(experiment.commands(settings, settings_of))
    if not commands:
        raise UserError("no cells in this experiment", experiment.name, "Give its axes values.")
    _check_free(experiment, commands, by_stage)
    common = {stage: ["--preset", preset] if preset else [] for stage in STAGES}
    for stage in experiment.stages:
        settings_of(stage)  # a mistake in any of them is refused, whether a command uses it or not
        common[stage] += [word for pair in by_stage.get(stage, ()) for word in ("--set", pair)]
        common[stage] += ["--device", device] if device != "auto" and stage in CONFIGS else []
    planned = _cells(commands, out, common, short=short and experiment.domain is not None)
    if config.evaluate:
        ensembles = sum(cell.stage == "train-ensemble" for cell in planned)
        planned += closing_cells(out, [cell.out for cell in planned], max(1, min(MOST_JUDGED, ensembles)))
    return Plan(experiment.name, planned, config.workers or cores())


def _split(experiment: Experiment, assignments: Iterable[str]) -> tuple[list[str], dict[str, list[str]]]:
    """The experiment's own assignments, and those of each of its stages without the stage's name."""
    of_run: list[str] = []
    by_stage: dict[str, list[str]] = {}
    for assignment in assignments:
        (key,) = parse_assignments([assignment])
        stage, dot, rest = key.partition(".")
        stage = stage.replace("_", "-")
        if not dot:
            of_run.append(assignment)
        elif stage in experiment.stages:
            by_stage.setdefault(stage, []).append(f"{rest}={assignment.partition('=')[2]}")
        else:
            do = f"It may be one of: {', '.join(experiment.stages) or 'none, its commands say all'}."
            raise UserError("no such stage in --set", stage, do)
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


def _cells(commands: Sequence[Command], out: Path, common: Mapping[str, Sequence[str]], *, short: bool) -> list[Cell]:
    """The cell of each command, which reads outputs of those before it."""
    folders = [command.name.partition("/")[0] for command in commands]
    short = short and len({*folders}) == len(folders)
    cells: dict[str, Cell] = {}  # by the names that the commands give
    for command, folder in zip(commands, folders, strict=True):
        place = folder if short else command.name
        where = f"cell {command.name!r}"
        words = [part for word in command.words for part in (word.split("=", 1) if READ.fullmatch(word) else [word])]
        if not plain_name(folder) or not re.fullmatch(r"[\w-]+", folder) or folder in FOLDERS:
            raise UserError("cells need a name of their own, of letters, digits, - and _", where, MEND)
        if not all(map(path_part, place.split("/"))) or not path_part(f"{place.replace('/', '-')}.json"):
            raise UserError("this would be written outside the run, or the name is too long for a file", where, MEND)
        if not words or words[0] not in STAGES:
            raise UserError("the command must be a stage", where, f"Choose one of {', '.join(STAGES)}.")
        if any(word.split("=")[0] in RESERVED for word in words):  # even by a setting's value
            raise UserError(f"{', '.join(RESERVED)} are given by the sweep", where, MEND)
        sources = []
        for number, word in enumerate(words):
            if word.startswith("@"):
                if word[1:] not in cells:
                    raise UserError(f"{command.name} would read what no cell before it makes", word[1:], MEND)
                sources.append(cells[word[1:]])
                words[number] = str(sources[-1].out)
        processes = _cores(words, sources)
        # Options of all cells of a stage stand before the cell's own: the last setting of a name counts, so --set
        # cannot turn a method or a control into another.
        words[2:2] = common[words[0]]
        target = out / (place + (".h5" if words[0] == "collect" else ""))
        arguments, needs = (*words, "--out", str(target)), tuple(source.out for source in sources)
        cells[command.name] = Cell(place.replace("/", "-"), arguments, target, needs, processes, _axes(command))
    names = Counter([*(command.name.replace("/", "-") for command in commands), "evaluate", "report"])
    if len(names) < len(commands) + 2:
        raise UserError("two cells would be the same", names.most_common(1)[0][0], f"Give each value once. {MEND}")
    return [*cells.values()]


def _axes(command: Command) -> tuple[tuple[str, str | int | float], ...]:
    columns = command.columns
    fits = isinstance(columns, Mapping) and all(isinstance(value, str | int | float) for value in columns.values())
    if not fits or not all(str(name).isidentifier() and name not in ("cell", "stage", *COLUMNS) for name in columns):
        raise UserError("columns must be names with texts or numbers", f"cell {command.name!r}", MEND)
    return tuple(columns.items())


def _cores(words: Sequence[str], sources: Sequence[Cell]) -> int:
    """The processes that a command can use: one for each sub-goal or room, as far as those are known here."""
    settings = dict(re.findall(r"--set[ =](\w+)=(\S+)", " ".join(words)))
    if words[0] == "train-ensemble":
        most = _sub_goals(settings, sources)
    elif words[:2] == ["collect", "montezuma"]:
        most = ROOMS_AT_ONCE
    else:
        return 1
    workers = settings.get("workers", "")
    return min(most, int(workers)) if workers.isdigit() and int(workers) else most


def _sub_goals(settings: Mapping[str, str], sources: Sequence[Cell]) -> int:
    """How many sub-goals an ensemble is trained for; 1 where that is not known."""
    if "sub_goals" in settings:
        return len(settings["sub_goals"].split(","))
    domain = next((cell.arguments[1] for cell in sources if cell.stage == "collect"), "")
    try:
        return max(1, len(load_domain(domain).usual_sub_goals))
    except UserError:  # its cell refuses a domain that may not be loaded
        return 1
