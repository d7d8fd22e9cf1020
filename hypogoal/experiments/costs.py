"""Forecasts of what an experiment costs on this machine (Spec G4)."""

import time
from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

from hypogoal.core.config import as_dict
from hypogoal.core.errors import UserError
from hypogoal.core.preflight import human
from hypogoal.core.progress import duration
from hypogoal.domains.base import load_domain
from hypogoal.experiments.cells import SHORT, Cell, Cost
from hypogoal.learners.baselines.settings import HYPERPARAMETERS
from hypogoal.needs import BASE, LOGS, baseline_needs, ensemble_process, judging, judging_member, play_needs
from hypogoal.settings import configuration

# CPU seconds of the piece of training below on the core that costs are of, idle (2.5 GHz, torch 2.13).
REFERENCE_SECONDS = 0.1
REPEATS = 3
LONG_SECONDS = 3600.0  # above this the user is asked first
# An experiment's rates: seconds of one core of the machine of docs/performance.md or, where they depend on the network
# or the baseline, a table of them; numbers of cores; and the setting of collect that says how much is held out.
RATES = (
    "collect", "member_step", "localiser", "step", "baseline_step", "evaluated_ensemble", "evaluated_member",
    "evaluated_agent", "collect_cores", "evaluate_cores", "heldout",
)  # fmt: skip


class Estimates:
    """What commands cost, from the settings their stages will have and from an experiment's rates.

    Rates are named as in ``RATES``, else a ``UserError``; presets and defaults are those of ``domain``.
    """

    def __init__(self, rates: Mapping[str, Any], domain: str):
        for name, rate in rates.items():
            numbers = [*rate.values()] if isinstance(rate, dict) and rate else [rate]
            fits = all(type(number) in (int, float) and number >= 0 for number in numbers)
            fits = isinstance(rate, str) if name == "heldout" else fits
            if name not in RATES or not fits:
                raise UserError("no such rate in an experiment", f"{name} = {rate}", "See docs/formats.md.")
        self.rates, self.domain, self.name = rates, load_domain(domain), domain
        self._resolved = cache(self._resolve)  # thousands of cells have some tens of settings

    def priced(self, cells: Sequence[Cell]) -> list[Cell]:
        """The cells with their costs; a ``UserError`` where a stage lacks a setting."""
        settings = {(cell.stage, cell.out): self.settings(cell) for cell in cells}
        return [replace(cell, cost=self._cost(cell, settings)) for cell in cells]

    def closing(self, cells: Sequence[Cell]) -> Cost:
        """The cost of their evaluation."""
        members = [self.settings(cell).members for cell in cells if cell.stage == "train-ensemble"]
        collected = (self.domain.collected_bytes(self.settings(cell)) for cell in cells if cell.stage == "collect")
        states = judging(max(collected, default=0), self.domain.observation_shape, self.domain.observation_dtype)
        seconds = self._rate("evaluated_ensemble") * len(members) + self._rate("evaluated_member") * sum(members)
        agents = [self.settings(cell).network for cell in cells if cell.stage == "train-meta"]
        seconds += sum(self._rate("evaluated_agent", network) for network in agents)  # frozen play
        cores = min(int(self._rate("evaluate_cores")) or 1, max(1, len(members)))
        return Cost(seconds, BASE + states, 2 * LOGS, cores)

    def settings(self, cell: Cell) -> Any:
        """The configuration of its command."""
        options = ((name, " ".join(values)) for name, *values in cell.parts[1:])
        return self._resolved(cell.stage, tuple(pair for pair in options if pair[0] in (*SHORT, "--preset", "--set")))

    def _resolve(self, stage: str, pairs: tuple[tuple[str, str], ...]) -> Any:
        options = {name[2:].replace("-", "_"): value for name, value in pairs if name in SHORT}
        assignments = [value for name, value in pairs if name == "--set"]
        return configuration(stage, self.name, dict(pairs).get("--preset"), assignments, options)

    def _rate(self, name: str, kind: str = "") -> float:
        """A rate; for a kind that its table lacks, the highest of the table."""
        rate = self.rates.get(name, 0.0)
        return float(rate.get(kind, max(rate.values())) if isinstance(rate, dict) else rate)

    def _cost(self, cell: Cell, settings: Mapping[tuple[str, Path], Any]) -> Cost:
        config, domain = settings[cell.stage, cell.out], self.domain
        maker = "collect" if cell.stage == "train-ensemble" else "train-ensemble"
        source = next((settings[maker, need] for need in cell.needs if (maker, need) in settings), None)
        if cell.stage == "collect":
            states = domain.collected_bytes(config)
            cores = int(self._rate("collect_cores")) or 1
            workers = as_dict(config).get("workers") or cores
            return Cost(self._rate("collect"), BASE + 2 * states / cores, states / domain.packed, workers)
        if cell.stage == "train-ensemble":
            heldout = str(self.rates.get("heldout", ""))
            if source is not None and heldout in as_dict(source):
                source = replace(source, **{heldout: 0})
            learned = domain.collected_bytes(source) if source else 0
            goals, count = len(config.sub_goals or domain.sub_goals), config.members
            seconds = self._rate("member_step", config.network) * config.steps * count
            seconds += self._rate("localiser") * (config.view == "agent-crop" and config.localiser == "learned")
            cores = min(config.workers or goals, goals)
            needs = ensemble_process(learned, config, domain.observation_shape, domain.observation_dtype)
            return Cost(seconds, needs.memory, goals * needs.disk, cores)
        if cell.stage == "train-baseline":
            chosen = HYPERPARAMETERS[config.agent, config.setting]
            seconds = config.steps * self._rate("baseline_step", f"{config.agent}-{config.setting}")
            shape, members = domain.observation_shape, 0.0
            if source is not None:
                each = judging_member(source.network, shape, domain.observation_dtype)
                members = len(source.sub_goals or domain.sub_goals) * source.members * each
            played = domain.played_bytes(config.steps, 0)
            needs = baseline_needs(domain.observation_bytes, played, config.steps, chosen, members)
            return Cost(seconds, needs.memory, needs.disk)
        for start in config.start.split(","):
            domain.rooms_of(start)  # an unknown start is a UserError
        ensemble: dict[str, Any] = {"sub_goals": domain.sub_goals, "members": 1}
        if source is not None:
            ensemble = {"sub_goals": source.sub_goals or domain.sub_goals, "members": source.members}
            ensemble["network"] = source.network
        is_each = as_dict(config).get("steps_for") == "each" and config.termination != "oracle"
        steps = config.steps * (ensemble["members"] if is_each else 1)
        needs = play_needs(domain, ensemble, config)
        return Cost(steps * self._rate("step", config.network), needs.memory, needs.disk)


def machine_factor() -> float:
    """How much longer training takes on a core of this machine than on that of docs/performance.md.

    Times gradient steps of a small convolutional network (CPU time, the best of three).
    """
    import torch

    torch.set_num_threads(1)
    generator = torch.Generator().manual_seed(0)
    images = torch.rand(32, 3, 64, 64, generator=generator)
    layers = (torch.nn.Conv2d(3, 16, 3), torch.nn.ReLU(), torch.nn.Conv2d(16, 16, 3), torch.nn.Flatten())
    network = torch.nn.Sequential(*layers)

    def work() -> float:
        begun = time.process_time()
        for _ in range(2):
            network(images).square().mean().backward()
        return time.process_time() - begun

    work()  # warm up
    return min(work() for _ in range(REPEATS)) / REFERENCE_SECONDS


def wall_seconds(cells: Sequence[Cell], workers: int, factor: float) -> float:
    """The least time that the cells take with so many workers; unknown costs count as 0."""
    seconds = [factor * cell.cost.seconds for cell in cells]
    alone = [each / min(workers, cell.cost.cores) for each, cell in zip(seconds, cells, strict=True)]
    return max(sum(seconds) / workers, max(alone, default=0.0))


def cost_lines(cells: Sequence[Cell], workers: int, factor: float) -> list[str]:
    """The cost of the cells, stage by stage and in total."""
    lines = []
    for stage in dict.fromkeys(cell.stage for cell in cells):
        costs = [cell.cost for cell in cells if cell.stage == stage]
        each = factor * sum(cost.seconds for cost in costs) / len(costs)
        memory, disk = max(cost.memory for cost in costs), max(cost.disk for cost in costs)
        parts = [duration(each) if each else "", f"{human(memory)} of memory" if memory else ""]
        parts.append(f"{human(disk)} of disk" if disk else "")
        text = ", ".join(part for part in parts if part) or "not known"
        lines.append(f"  {stage:15s} {len(costs):5d} x {text}")
    seconds = factor * sum(cell.cost.seconds for cell in cells)
    unknown = sum(cell.cost.seconds == 0 and cell.stage != "report" for cell in cells)
    wall = duration(wall_seconds(cells, workers, factor))
    total = f"about {duration(seconds)} of one core, {wall} with {workers} at once" if seconds else "time not known"
    memory, disk = (
        sum(sorted((getattr(cell.cost, kind) for cell in cells), reverse=True)[:workers]) for kind in ("memory", "disk")
    )
    most = f"; at once at most {human(memory)} of memory, {human(disk)} of disk, checkpoints included" if disk else ""
    text = f"{len(cells)} commands: {total}{most}"
    text += f" ({factor:.2g} times what docs/performance.md's machine takes)" if seconds else ""
    lines.append(text + (f"; {unknown} of unknown length" if unknown and seconds else ""))
    return lines
