"""From the name of an experiment to its cells, and to their outputs (Spec A6, G4)."""

from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from functools import cache
from itertools import pairwise
from pathlib import Path
from typing import Any

from hypogoal.core.config import DOMAIN, MODELS, STAGES, assigned, described, model_of, resolve
from hypogoal.core.config import preset as read_preset
from hypogoal.core.errors import UserError
from hypogoal.core.own_code import allow
from hypogoal.domains.base import layers_of, settings_of
from hypogoal.experiments import slurm
from hypogoal.experiments.named import find_experiment
from hypogoal.experiments.results import write_results
from hypogoal.experiments.sweep import Cell, begin, cells_of, read_plan, run_local


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
    experiment, preset, fixed = find_experiment(name, preset)
    if experiment.domain is None and (preset or device != "auto"):
        problem = "an experiment of your own takes no preset and no device"
        raise UserError(problem, preset or device, "Write --preset and --device into its commands.")
    domain = experiment.domain or DOMAIN
    of_run = {"seeds" if "seeds" in experiment.model.model_fields else "seed": seeds, **fixed}
    of_stage: dict[str, dict[str, str]] = {stage: {} for stage in experiment.stages}
    for key, value in assigned(assignments).items():
        stage, dot, rest = key.partition(".")
        stage = stage.replace("_", "-")
        if not dot:
            of_run[key] = value
        elif stage in of_stage:
            of_stage[stage][rest] = value
        else:
            do = f"It may be one of: {', '.join(of_stage) or 'none, its commands say all'}."
            raise UserError("no such stage in --set", stage, do)
    config = resolve(experiment.model, read_preset(preset, "run", domain), of_run, stage="run")

    @cache
    def settings(stage: str) -> Any:
        return settings_of(stage, domain, preset, of_stage.get(stage, {}))

    def shared(words: Sequence[str]) -> list[str]:
        """What all commands of a stage are given, but where a command's own option says otherwise."""
        if words[0] not in experiment.stages:
            return []
        more = ["--preset", preset] if preset else []
        if device != "auto" and words[0] in MODELS:
            more += ["--device", device]
        names = _known(words, domain, preset, of_stage[words[0]])
        for key, value in of_stage[words[0]].items():
            if key in names and f"--{key.replace('_', '-')}" not in words:
                more += ["--set", f"{key}={value}"]
        return more

    commands = experiment.commands(config, settings)
    cells = cells_of(commands, shared, short=experiment.domain is not None, evaluate=config.evaluate)
    _check_settings(cells)
    return cells, config.workers


def _known(words: Sequence[str], domain: str, preset: str | None, shared: Mapping[str, str]) -> Collection[str]:
    """The settings that a command's stage has where those ``shared`` by all and the command's own hold."""
    stage = words[0]
    if stage not in MODELS:
        return shared
    layers = [values for values, _ in layers_of(stage, domain, preset)]
    _, typed = _given(words)
    return type(resolve(model_of(stage), *layers, shared, typed, {}, stage=stage)).model_fields


@cache
def _names_of(stage: str) -> frozenset[str]:
    """Every setting that a stage can have."""
    return frozenset(row["name"] for row in described(model_of(stage)))


def _given(words: Sequence[str]) -> tuple[str | None, dict[str, str]]:
    """The preset and the settings in the words of a command; ``--set`` wins over options."""
    names = _names_of(words[0])
    preset, options, assignments = None, {}, []
    for option, value in pairwise(words):
        name = option.removeprefix("--").replace("-", "_")
        if option == "--set":
            assignments.append(value)
        elif option == "--preset":
            preset = value
        elif option.startswith("--") and name in names:
            options[name] = value
    return preset, options | assigned(assignments)


def _check_settings(cells: Sequence[Cell]) -> None:
    """Refuse (``UserError``) settings that the stages of cells cannot have, before the first cell starts."""
    domains: dict[str, str] = {}  # of cells
    for cell in cells:
        domain = next((domains[need] for need in cell.needs), DOMAIN)
        source = "".join(cell.words[1:2])
        if cell.stage in ("collect", "train-baseline") and source[:1] not in ("", "-"):
            domain = source
        domains[cell.name] = domain
        try:
            if cell.stage in MODELS:
                allow(cell.words)  # a TOML file's are allowed already, the others are of code that the user gave
                preset, typed = _given(cell.words)
                settings_of(cell.stage, domain, preset, typed)
            elif cell.stage not in (*STAGES, "evaluate", "report"):
                raise UserError("this is no stage", cell.stage, f"Choose one of {', '.join(STAGES)}.")
        except UserError as error:
            raise UserError(f"{cell.name}: {error.what}", error.where, error.do) from None


def run(
    cells: Sequence[Cell],
    out: Path,
    *,
    workers: int,
    say: Callable[[str], None],
    sbatch: Sequence[str] | None = None,
    resume: bool = False,
    force: bool = False,
    from_: str | None = None,
    only: str | None = None,
) -> None:
    """Run the cells that are not done, on this machine or, with options for ``sbatch``, by Slurm.

    A run that exists is a ``UserError`` unless it is to be resumed, forced (all anew), or made anew ``from_`` a stage
    or ``only`` in that stage. A cell that is not made is a ``UserError`` at the end.
    """
    chosen = in_part(cells, from_, only)
    if out.exists() and not out.is_dir():
        raise UserError("a run needs a folder, this is a file", out, "Choose another --out.")
    if out.exists() and not (force or resume or from_ or only):
        do = "Give --resume to finish it, --from STAGE to make a part anew, --force to make all anew."
        raise UserError("the run exists already", out, do)
    slurm.check_free(out, is_wanted=sbatch is not None)
    anew = [] if resume else [*chosen, *read_plan(out)] if force else chosen
    begin(cells, out, anew)
    todo = [cell for cell in (chosen if only else cells) if not cell.is_done(out)]
    if sbatch is not None:
        slurm.submit(todo, out, workers, sbatch, say)
        return
    try:
        failed = run_local(todo, out, workers=workers, say=say)
    except KeyboardInterrupt as error:
        error.add_note("what is done is kept: give the same command with --resume to go on")
        raise
    left = [cell.name for cell in todo if not cell.is_done(out)]
    if left:
        first = next((cell.name for cell in todo if cell.name in failed), left[0])
        problem = f"{len(failed)} of {len(cells)} cells failed, {len(left)} are not made"
        do = "Mend it, then give the same command with --resume: what is done is kept."
        raise UserError(f"{problem}; {first}", failed.get(first, "it needs what is not made"), do)
    write_results(cells, out)


def in_part(cells: Sequence[Cell], from_: str | None, only: str | None) -> list[Cell]:
    """The cells of the stage ``only`` or, with all that read them, of the stage ``from_``; without one all."""
    if not (from_ or only):
        return [*cells]
    names = {cell.name for cell in cells if cell.stage == (from_ or only)}
    if not names or (from_ and only):
        stages = ", ".join(dict.fromkeys(cell.stage for cell in cells))
        raise UserError("--from or --only needs one stage of the run", f"{from_ or only}", f"Choose one of {stages}.")
    for cell in cells:  # those that a cell needs are before it
        if from_ and not names.isdisjoint(cell.needs):
            names.add(cell.name)
    return [cell for cell in cells if cell.name in names]
