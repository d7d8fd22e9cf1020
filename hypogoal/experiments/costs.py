"""Forecasts of what an experiment costs (Spec G4)."""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

from hypogoal.core.config import as_dict
from hypogoal.core.preflight import human
from hypogoal.core.progress import duration
from hypogoal.core.terminal import amount
from hypogoal.domains.base import load_domain
from hypogoal.experiments.cells import SHORT, Cell, Cost
from hypogoal.learners.baselines.settings import HYPERPARAMETERS
from hypogoal.needs import BASE, baseline_needs, ensemble_process, judging, play_needs
from hypogoal.settings import configuration

LONG_SECONDS = 3600.0  # above this the user is asked first
MOST_JUDGED = 6  # ensembles that an evaluation judges at once


class Estimates:
    """What commands cost, from the settings that their stages will have and an experiment's rates.

    Rates are seconds of one core of docs/performance.md's machine: ``collect``, ``localiser``, and ``member_step``,
    ``step`` and ``baseline_step`` (or a table of them by network or baseline); ``collect_cores``; and ``heldout``, the
    setting of collect that says how much is held out. Presets and defaults are those of ``domain``.
    """

    def __init__(self, rates: Mapping[str, Any], domain: str):
        self.rates, self.domain, self.name = rates, load_domain(domain), domain
        self._resolved = cache(self._resolve)  # thousands of cells have some tens of settings

    def priced(self, cells: Sequence[Cell]) -> list[Cell]:
        """The cells with their costs; a ``UserError`` where a stage lacks a setting."""
        settings = {(cell.stage, cell.out): self.settings(cell) for cell in cells}
        return [replace(cell, cost=self._cost(cell, settings)) for cell in cells]

    def closing(self, cells: Sequence[Cell]) -> Cost:
        """Memory and cores of their evaluation; its time is not known."""
        collected = (self.domain.collected_bytes(self.settings(cell)) for cell in cells if cell.stage == "collect")
        states = judging(max(collected, default=0), self.domain.observation_shape, self.domain.observation_dtype)
        ensembles = sum(cell.stage == "train-ensemble" for cell in cells)
        return Cost(0.0, BASE + states, max(1, min(MOST_JUDGED, ensembles)))

    def settings(self, cell: Cell) -> Any:
        """The configuration of its command."""
        pairs = ((name, " ".join(values)) for name, *values in cell.parts[1:])
        return self._resolved(cell.stage, tuple(pair for pair in pairs if pair[0] in (*SHORT, "--preset", "--set")))

    def _resolve(self, stage: str, pairs: tuple[tuple[str, str], ...]) -> Any:
        options = {name[2:].replace("-", "_"): value for name, value in pairs if name in SHORT}
        assignments = [value for name, value in pairs if name == "--set"]
        return configuration(stage, self.name, dict(pairs).get("--preset"), assignments, options)

    def _rate(self, name: str, kind: str = "") -> float:
        """A rate; for a kind that its table lacks, the highest of the table."""
        rate = self.rates.get(name, 0.0)
        return float(rate.get(kind, max(rate.values())) if isinstance(rate, Mapping) else rate)

    def _cost(self, cell: Cell, settings: Mapping[tuple[str, Path], Any]) -> Cost:
        config, domain = settings[cell.stage, cell.out], self.domain
        shape, dtype = domain.observation_shape, domain.observation_dtype
        maker = "collect" if cell.stage == "train-ensemble" else "train-ensemble"
        source = next((settings[maker, need] for need in cell.needs if (maker, need) in settings), None)
        if cell.stage == "collect":
            cores = int(self._rate("collect_cores")) or 1
            memory = BASE + 2 * domain.collected_bytes(config) / cores
            return Cost(self._rate("collect"), memory, as_dict(config).get("workers") or cores)
        if cell.stage == "train-ensemble":
            heldout = self.rates.get("heldout", "")
            if source and heldout in as_dict(source):
                source = replace(source, **{heldout: 0})
            learned = domain.collected_bytes(source) if source else 0
            goals = len(config.sub_goals or domain.usual_sub_goals)
            seconds = self._rate("member_step", config.network) * config.steps * config.members
            seconds += self._rate("localiser") * (config.view == "agent-crop" and config.localiser == "learned")
            memory = ensemble_process(learned, config, shape, dtype).memory
            return Cost(seconds, memory, min(config.workers or goals, goals))
        ensemble: dict[str, Any] = {
            "sub_goals": source.sub_goals or domain.usual_sub_goals if source else domain.usual_sub_goals,
            "members": source.members if source else 1,
            "network": source.network if source else "auto",
        }
        if cell.stage == "train-baseline":
            seconds = config.steps * self._rate("baseline_step", f"{config.agent}-{config.setting}")
            played, chosen = domain.played_bytes(config.steps, 0), HYPERPARAMETERS[config.agent, config.setting]
            needs = baseline_needs(domain.observation_bytes, played, config.steps, chosen)
            return Cost(seconds, needs.memory)
        for start in config.start.split(","):
            domain.rooms_of(start)  # an unknown start is a UserError
        is_each = as_dict(config).get("steps_for") == "each" and config.termination != "oracle"
        steps = config.steps * (ensemble["members"] if is_each else 1)
        kind = f"{config.network}-none" if config.recurrence == "none" else config.network
        return Cost(steps * self._rate("step", kind), play_needs(domain, ensemble, config).memory)


def wall_seconds(cells: Sequence[Cell], workers: int) -> float:
    """The least time that the cells take with so many workers; unknown costs count as 0."""
    alone = (cell.cost.seconds / min(workers, cell.cost.cores) for cell in cells)
    return max(sum(cell.cost.seconds for cell in cells) / workers, max(alone, default=0.0))


def cost_lines(cells: Sequence[Cell], workers: int) -> list[str]:
    """The cost of the cells, stage by stage and in total, on a core like that of docs/performance.md."""
    lines = []
    for stage in dict.fromkeys(cell.stage for cell in cells):
        costs = [cell.cost for cell in cells if cell.stage == stage]
        each, memory = sum(cost.seconds for cost in costs) / len(costs), max(cost.memory for cost in costs)
        parts = [duration(each) if each else "time not known", *([f"{human(memory)} of memory"] if memory else [])]
        lines.append(f"  {stage:15s} {len(costs):5d} x {', '.join(parts)}")
    seconds, wall = sum(cell.cost.seconds for cell in cells), duration(wall_seconds(cells, workers))
    total = f"about {duration(seconds)} of one core, {wall} with {workers} at once" if seconds else "time not known"
    memory = sum(sorted((cell.cost.memory for cell in cells), reverse=True)[:workers])
    return [*lines, f"{amount(len(cells), 'command')}: {total}; at once at most {human(memory)} of memory"]
