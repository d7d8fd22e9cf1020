"""From the name of an experiment to its cells, and to their outputs (Spec A6, G4)."""

from collections.abc import Callable, Iterable, Mapping, Sequence
from functools import cache
from itertools import pairwise
from pathlib import Path
from typing import Any

from hypogoal.core.config import DOMAIN, MODELS, TABLES, Config, assigned, described, model_of, resolve
from hypogoal.core.config import preset as read_preset
from hypogoal.core.errors import UserError
from hypogoal.core.processes import check_device, cores
from hypogoal.core.terminal import amount
from hypogoal.domains.base import layers_of, load_domain, settings_of
from hypogoal.experiments import slurm
from hypogoal.experiments.experiment import Command, Experiment
from hypogoal.experiments.named import EXPERIMENTS, find_experiment
from hypogoal.experiments.results import write_results
from hypogoal.experiments.sweep import (
    PLAN,
    Cell,
    begin,
    cells_of,
    closing_cells,
    of_stage,
    read_plan,
    run_local,
)


def config_class_of(stage: str, domain: str = DOMAIN) -> type[Config]:
    """The settings of a stage, by its command's name; of ``run``, the domain's experiment's. Else a ``UserError``."""
    if stage == "collect":
        return load_domain(domain).config_class
    if stage == "run":
        for name, experiment in EXPERIMENTS.items():
            if domain == experiment.domain and name != "choosing":
                return experiment.config_class
        raise UserError("no experiment uses this domain", domain, f"Experiments: {', '.join(EXPERIMENTS)}.")
    if stage not in MODELS:
        raise UserError("no such stage", stage, f"Choose one of {', '.join(TABLES)}.")
    return model_of(stage)


def plan(
    name: str,
    *,
    preset: str | None = None,
    assignments: Iterable[str] = (),
    seeds: str | None = None,
    device: str = "auto",
) -> tuple[list[Cell], int]:
    """The cells of an experiment, and how many run at once (0: as many as can); a ``UserError`` where they cannot be.

    ``assignments`` are ``SETTING=VALUES`` of the experiment and, where it has a domain, ``STAGE.KEY=VALUE``; so have
    ``preset`` and ``device`` to have one. ``seeds`` are the run seeds, ``0-9``.
    """
    check_device(device)
    experiment, preset, fixed = find_experiment(name, preset)
    if experiment.domain is None and (preset or device != "auto"):
        problem = "an experiment of your own takes no preset and no device"
        raise UserError(problem, preset or device, "Write --preset and --device into its commands.")
    seed = "seeds" if "seeds" in experiment.settings else "seed"
    of_run, by_stage = _split(experiment, [*fixed, *([f"{seed}={seeds}"] if seeds else []), *assignments])
    domain = experiment.domain or DOMAIN
    layers = read_preset(preset, "run", domain), assigned(of_run)
    config: Any = resolve(experiment.config_class, *layers, stage="run")

    @cache
    def settings(stage: str) -> Any:
        return settings_of(stage, domain, preset, assigned(by_stage.get(stage, ())))

    commands = experiment.commands({key: getattr(config, key) for key in experiment.settings}, settings)
    _check_free(experiment, commands, by_stage)
    common: dict[str, list[str]] = {}
    for stage in experiment.stages:
        settings(stage)  # a mistake in any of them is refused, whether a command uses it or not
        common[stage] = ["--preset", preset] if preset else []
        common[stage] += [word for pair in by_stage.get(stage, ()) for word in ("--set", pair)]
        common[stage] += ["--device", device] if device != "auto" and stage in MODELS else []
    cells = cells_of(commands, common, short=experiment.domain is not None)
    check_settings(cells, domain)
    return cells + (closing_cells(cells) if config.evaluate else []), config.workers


def _split(experiment: Experiment, assignments: Iterable[str]) -> tuple[list[str], dict[str, list[str]]]:
    """The experiment's own assignments, and those of each of its stages without the stage's name."""
    of_run: list[str] = []
    by_stage: dict[str, list[str]] = {}
    for assignment in assignments:
        key, _, value = assignment.partition("=")
        stage, dot, rest = key.partition(".")
        stage = stage.strip().replace("_", "-")
        if not dot:
            of_run.append(assignment)
        elif stage in experiment.stages:
            by_stage.setdefault(stage, []).append(f"{rest}={value}")
        else:
            do = f"It may be one of: {', '.join(experiment.stages) or 'none, its commands say all'}."
            raise UserError("no such stage in --set", stage, do)
    return of_run, by_stage


def _check_free(experiment: Experiment, commands: Sequence[Command], by_stage: Mapping[str, Sequence[str]]) -> None:
    """Refuse settings of stages that commands give as an option: it would win over ``--set``."""
    for command in commands:
        words = command.command.split()
        for key in assigned(by_stage.get(words[0], ())) if words else ():
            if f"--{key.replace('_', '-')}" in words:
                names = [name for name in experiment.settings if name.removesuffix("s") == key] or experiment.settings
                do = f"Set {' or '.join(names)} instead."
                raise UserError("the experiment sets this for each cell", f"{words[0]}.{key}", do)


def check_settings(cells: Sequence[Cell], domain: str) -> None:
    """Refuse (``UserError``) settings that a cell's stage cannot have, before the first cell starts."""

    @cache
    def check(stage: str, preset: str | None, pairs: tuple[str, ...]) -> None:
        layers = [values for values, _ in layers_of(stage, domain, preset)]
        resolve(model_of(stage), *layers, assigned(pairs), {}, stage=stage)  # a control may lack what all are told

    for cell in cells:
        if cell.stage not in MODELS:
            continue
        known = [f"--{row['name'].replace('_', '-')}" for row in described(model_of(cell.stage))]
        pairs, preset = [], None
        for option, value in pairwise(cell.words):
            if option == "--preset":
                preset = value
            elif option == "--set":
                pairs.append(value)
            elif option in known and option != "--layout-seed":
                pairs.append(f"{option.removeprefix('--')}={value}")
        try:
            check(cell.stage, preset, tuple(pairs))
        except UserError as error:
            raise UserError(f"{cell.name}: {error.what}", error.where, error.do) from None


def run(
    cells: Sequence[Cell],
    out: Path,
    *,
    workers: int,
    sbatch: Sequence[str] | None = None,
    resume: bool = False,
    force: bool = False,
    from_: str | None = None,
    only: str | None = None,
    say: Callable[[str], None],
) -> None:
    """Run the cells that are not done, on this machine or, with options for ``sbatch``, by Slurm.

    A run that exists is a ``UserError`` unless it is to be resumed, forced (all anew), or made anew ``from_`` a stage
    or ``only`` in that stage. A cell that fails is a ``UserError`` at the end.
    """
    chosen = in_part(cells, from_, only)
    if sbatch is not None:
        slurm.check()
    if out.exists() and not out.is_dir():
        raise UserError("a run needs a folder, this is a file", out, "Choose another --out.")
    if out.exists() and not (force or resume or from_ or only):
        do = "Give --resume to finish it, --from STAGE to make a part anew, --force to make all anew."
        raise UserError("the run exists already", out, do)
    if only:
        _check_needs(chosen, cells, out)
    if alive := slurm.queued(out):
        do = f"Wait, or end them: scancel {' '.join(alive)}"
        raise UserError("this run is in Slurm's queue", out, do)
    anew = [] if resume or not (force or from_ or only) else chosen
    if force and anew and (out / PLAN).exists():
        anew = [*anew, *read_plan(out)]
    begin(cells, out, anew)
    todo = [cell for cell in (chosen if only else cells) if not cell.out(out).exists()]
    if sbatch is not None:
        slurm.submit(todo, out, workers, sbatch, say)
        return
    try:
        failed = run_local(todo, out, workers=workers or cores(), say=say)
    except KeyboardInterrupt as error:
        error.add_note("what is done is kept: give the same command with --resume to go on")
        raise
    if failed:
        name, reason = next(iter(failed.items()))
        problem = f"{len(failed)} of {amount(len(cells), 'cell')} failed, the first is {name}: {reason}"
        raise UserError(problem, None, "Mend it, then give the same command with --resume: what is done is kept.")
    write_results(cells, out)


def _check_needs(chosen: Sequence[Cell], cells: Sequence[Cell], out: Path) -> None:
    """Refuse (``UserError``) to run cells alone which read what is not there."""
    missing = {cell.name for cell in cells if not cell.out(out).exists()} - {cell.name for cell in chosen}
    for cell in chosen:
        if lacking := missing.intersection(cell.needs):
            raise UserError(f"{cell.name} needs what is not made yet", min(lacking), "Leave out --only to make it.")


def in_part(cells: Sequence[Cell], from_: str | None, only: str | None) -> list[Cell]:
    """The cells that are to be made anew: all, those of a stage, or also those after them."""
    if from_ and only:
        raise UserError("--from and --only cannot both be given", f"{from_}, {only}", "Give one of them.")
    stage = from_ or only
    return of_stage(cells, stage, and_after=bool(from_)) if stage else [*cells]
