"""From the name of an experiment to its cells (Spec A6, G4)."""

import shlex
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from pydantic import ValidationError

from hypogoal.cells import OUTPUT, Cell, reason
from hypogoal.core.config import DOMAIN, STAGES, assigned, resolve
from hypogoal.core.config import preset as read_preset
from hypogoal.core.errors import UserError
from hypogoal.core.own_code import allow
from hypogoal.domains.base import settings_of
from hypogoal.experiments.experiment import MEND, Command
from hypogoal.experiments.named import find_experiment
from hypogoal.stages import load_stage

TAKEN = ("evaluation", "report", "logs", "slurm")  # folders of every run


@dataclass(frozen=True)
class _Shared:
    """What all commands of a run are given, except where their own words say otherwise."""

    preset: str | None
    device: str
    settings: Mapping[str, Mapping[str, str]]  # by stage

    def added_to(self, words: Sequence[str], domain: str) -> tuple[list[str], str]:
        """The words with those shared, and the domain played, if it is not the one of the states that are read.

        What the stage does not take is a ``UserError``.
        """
        stage, *rest = words
        values, typed = load_stage(stage).parsed([*rest, "--out", stage])
        domain = values.get("domain") or domain
        more: list[str] = []
        if self.preset and "preset" in values and not values["preset"]:
            more += ["--preset", self.preset]
        if values.get("device") == "auto" != self.device:
            more += ["--device", self.device]
        if stage in STAGES:
            allow(words)  # a TOML file's names are allowed already, others are those of code that the user gave
            shared = self.settings.get(stage, {})
            config = settings_of(stage, domain, values["preset"] or self.preset, typed, inherited=shared)
            for name, value in shared.items():
                if name in type(config).model_fields and name not in typed:
                    more += ["--set", f"{name}={value}"]
        return [*words, *more], domain


def plan(
    name: str,
    *,
    preset: str | None = None,
    assignments: Iterable[str] = (),
    seeds: str | None = None,
    device: str = "auto",
) -> tuple[list[Cell], int]:
    """The cells of an experiment, and how many run at once (0: as many as can); a ``UserError`` where they cannot be.

    ``assignments`` are ``SETTING=VALUES`` of the experiment and ``STAGE.KEY=VALUE``; ``seeds`` the run seeds, ``0-9``.
    """
    experiment = find_experiment(name, preset)
    preset = preset or experiment.preset
    of_run = {"seeds" if "seeds" in experiment.model.model_fields else "seed": seeds}
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

    def settings(stage: str) -> Any:
        return settings_of(stage, domain or DOMAIN, preset, of_stage.get(stage, {}))

    commands = experiment.commands(config, settings)
    folders = {command.name.partition("/")[0] for command in commands}
    is_short = domain is not None and len(folders) == len(commands)
    cells = _cells_of(commands, _Shared(preset, device, of_stage), is_short=is_short)
    stages = dict.fromkeys(cell.stage for cell in cells)
    for stage in of_stage:
        if stage not in stages:
            raise UserError(
                "no such stage in --set",
                stage,
                f"This run has {', '.join(stages)}.",
            )
    if config.evaluate:
        everything = [cell.name for cell in cells]
        cells.append(Cell(name="evaluation", words=["evaluate", "@."], needs=everything))
        cells.append(Cell(name="report", words=["report", "@."], needs=["evaluation"]))
    return cells, config.workers


def _cells_of(commands: Sequence[Command], shared: _Shared, *, is_short: bool) -> list[Cell]:
    """A cell for each command, in which ``@NAME`` is the output of the command of that name before it.

    ``is_short``: names without what tells the cells of a folder apart.
    """
    cells: dict[str, Cell] = {}  # by the names that the commands give
    domains: dict[str, str] = {}  # by the names of the cells
    for name, command, columns in commands:
        folder = name.partition("/")[0]
        if name in cells or folder in TAKEN:
            raise UserError(
                "a cell needs a name of its own",
                name,
                f"Give each value once. {MEND}",
            )
        try:
            words = shlex.split(command)
            outputs = filter(None, map(OUTPUT.search, words))
            sources = [cells[output[2]] for output in outputs]
            words = [OUTPUT.sub(lambda match: f"{match[1]}@{cells[match[2]].place}", word) for word in words]
            domain = domains[sources[0].name] if sources else DOMAIN
            words, domain = shared.added_to(words, domain)
            cell = Cell(
                name=folder if is_short else name,
                words=words,
                needs=[source.name for source in sources],
                columns=dict(columns),
            )
        except UserError as error:
            raise UserError(
                f"{name}: {error.what}",
                error.where,
                error.do,
            ) from None
        except ValidationError as error:
            raise UserError(
                f"the cell's name becomes a file's ({reason(error)})",
                name,
                MEND,
            ) from None
        except (ValueError, KeyError) as error:
            problem = f"the command cannot be read, or reads what no cell before it makes ({error})"
            raise UserError(
                problem,
                name,
                MEND,
            ) from None
        cells[name] = cell
        domains[cell.name] = domain
    return [*cells.values()]
