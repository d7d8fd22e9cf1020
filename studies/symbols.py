"""How many episodes a chooser needs: symbols, Thompson sampling over options alone, R-max, PPO, random choice.

python -m studies.symbols runs/symbols docs/results/symbols-constants.csv --constants
python -m studies.symbols runs/symbols docs/results/symbols.csv
python -m studies.symbols --tables docs/results/symbols.csv

Reported: on the ten layouts of the experiment 'choosing', where a wrong key ends the episode and so do 1.5 shortest
paths, with planned options and with practised ones; on Figure 6's ten layouts, after practice and from nothing; in
rooms. Each layout has the D-BAT ensemble of its seed. Constants, those of ``hypogoal/meta/symbols.py`` and those of
Thompson sampling, are chosen with planned options on layouts 100 to 119 and one ensemble of another seed: the pair with
the fewest episodes in the mean, where one that never arrives counts as ``LIMIT``. Then ``HALF_LIFE`` is chosen by the
same rule, with practised options on the first ten of these layouts.
"""

from __future__ import annotations

import tempfile
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass, replace
from functools import partial
from itertools import product
from pathlib import Path
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

import hypogoal
from hypogoal.core.arrays import Bools, Doubles, Ints
from hypogoal.core.artefacts import open_artefact
from hypogoal.core.processes import in_processes
from hypogoal.core.seeding import rng_for
from hypogoal.domains.base import Engine
from hypogoal.evaluation.curves import budget_of, run_numbers
from hypogoal.experiments.built_in import SOLVABLE
from hypogoal.meta import symbols
from hypogoal.options.choosers import Chooser, Outcome
from hypogoal.options.config import OptionConfig
from hypogoal.options.tables import Episodes
from studies.cells import Jobs, Row, amount, importable, parser_of, printed, read_rows, run_cells, table

TUNED = (*range(100, 114), 115, 118, 119)  # 114, 116 and 117 have a wrong key in the way
TUNING_SEED = 900
PRIORS, HOPES = (0.1, 0.3, 1.0), (0.1, 0.2, 0.5)  # the same pairs for both that draw
HALF_LIVES = (20, 50, 200, 1000)
LIMIT = 5_000  # episodes, for a run that does not arrive
CHOOSERS = {  # title, the setting, environments; 0: as many as by default
    "symbols": ("symbols", "symbols", 1),
    "symbols-16": ("symbols, 16 environments", "symbols", 0),
    "thompson": ("Thompson sampling over options, no symbols", "studies.symbols:Thompson", 1),
    "unshared": ("symbols that learn nothing from each other", "studies.symbols:Unshared", 1),
    "rmax": ("R-max over symbols", "studies.symbols:RMax", 1),
    "ppo-16": ("PPO, 16 environments", "ppo", 0),
    "ppo-1": ("PPO, 1 environment", "ppo", 1),
    "random": ("uniform random", "random", 1),
}
OF_SYMBOLS = ("symbols", "symbols-16", "unshared")  # which have that module's constants
KEYS = ("world", "chooser", "prior", "hope", "half_life", "layout", "seed")
QUANTITIES = ("solved_1_10", "solved_11_20", "solved_21_50", "solved_51_100", "episodes_to_95")
BY_STEP = ("solved_at_end", "steps_to_95_of_20", "steps_to_95", "practised")
COLUMNS = (*KEYS, "step", "episodes", *QUANTITIES, *BY_STEP)


@dataclass(frozen=True)
class World:
    """Where agents play, and what they are made of."""

    title: str
    agents: Mapping[int, int]  # each layout's seed
    choosers: tuple[str, ...]
    settings: Mapping[str, Any]  # of train-meta
    steps: int
    steps_of_ppo: int = 0  # if not as many
    domain: str = "doorkey"
    members: int = 6
    practice: Mapping[str, Any] | None = None  # settings of train-options


CHOOSING = dict(zip(SOLVABLE, range(920, 930), strict=True))
FIGURE_6 = dict(zip(range(300, 310), range(3000, 3010), strict=True))
HARSH = {"preset": "choosing"}
PLANNED = {"network": "planned"}
ROOMS = {seed: seed for seed in range(990, 1000)}
IN_ROOMS = ("symbols", "thompson", "ppo-16", "random")
LEARNING = ("symbols-16",)  # Figure 6 has PPO's
PUBLISHED = {"epsilon_steps": 8_000, "update_interval": 16}  # Figure 6's settings
WORLDS = {
    "planned": World(
        "a wrong key ends the episode, planned options", CHOOSING, (*CHOOSERS,), HARSH | PLANNED, 8_000, 80_000
    ),
    "practised": World(
        "the same, options practised where it does not, which explore no longer",
        CHOOSING,
        ("symbols", "symbols-16", "thompson", "ppo-16"),
        HARSH,
        16_000,
        50_000,
        practice=HARSH,
    ),
    "exploring": World(
        "the same, options that go on exploring",
        CHOOSING,
        ("symbols", "symbols-16", "thompson", "ppo-16"),
        HARSH | {"epsilon_steps": 8_000, "epsilon_final": 0.05},
        16_000,
        50_000,
        practice=HARSH,
    ),
    "figure-6": World(
        "Figure 6 after 40,000 steps",
        FIGURE_6,
        LEARNING,
        PUBLISHED,
        120_000,
        members=3,
        practice=PUBLISHED | {"steps": 40_000},
    ),
    "figure-6-nothing": World("Figure 6 from nothing", FIGURE_6, LEARNING, PUBLISHED, 160_000, members=3),
    "shape": World("rooms, shape", ROOMS, IN_ROOMS, {"world": ["truth=shape"]}, 5_000, 0, "rooms", 3),
    "place": World("rooms, place", ROOMS, IN_ROOMS, {"world": ["truth=place"]}, 5_000, 0, "rooms", 3),
}
TUNING = {
    "tuning-planned": replace(
        WORLDS["planned"], agents=dict.fromkeys(TUNED, TUNING_SEED), choosers=("symbols", "thompson")
    ),
    "tuning-practised": replace(
        WORLDS["exploring"], agents=dict.fromkeys(TUNED[:10], TUNING_SEED), choosers=("symbols-16",)
    ),
}


ALL = WORLDS | TUNING


class Thompson(Chooser):
    """Thompson sampling over options alone: each has a Beta posterior of the success of episodes that it was used in.

    One draw an episode for each environment; the offered option with the highest is taken.
    """

    CHANGING = ("rng", "counts", "drawn", "used")
    PRIOR, HOPE = 1.0, 0.1  # chosen as those of symbols

    def __init__(self, environments: int, options: int, rng: np.random.Generator):
        self.rng = rng
        failed, succeeded = self.PRIOR * (1 - self.HOPE), self.PRIOR * self.HOPE
        self.counts = np.array([[failed] * options, [succeeded] * options])
        self.drawn = rng.beta(succeeded, failed, size=(environments, options))
        self.used = np.zeros((environments, options), np.bool_)

    @classmethod
    def create(cls, engine: Engine, options: int, config: OptionConfig, seed: int, device: str) -> Self:
        return cls(engine.count, options, rng_for(seed, "thompson"))

    def choose(self, environments: Ints, ids: Ints, offered: Bools) -> Ints:
        chosen: Ints = np.where(offered, self.drawn[environments], -1.0).argmax(axis=1)
        self.used[environments, chosen] = True
        return chosen

    def record(self, outcome: Outcome) -> None:
        """What an episode came to counts for every option that it used."""
        over = outcome.terminated | outcome.truncated
        for place, returned in zip(outcome.environments[over], outcome.returns[over], strict=True):
            self.counts[int(returned > 0)] += self.used[place]
            failures, successes = self.counts
            self.drawn[place] = self.rng.beta(successes, failures)
            self.used[place] = False

    def begin_anew(self) -> None:
        self.used[:] = False


class Alone(symbols.Model):
    """What is unknown in some symbols is worth the same whatever its option did in others."""

    def _from_others(self, weights: Doubles) -> Doubles:
        return np.zeros((len(self.symbols), self.options))


class Unshared(symbols.SymbolsChooser):
    """Symbols that learn nothing from each other: the control of what that is worth."""

    def __init__(self, environments: int, options: int, *arguments: Any):
        super().__init__(environments, options, *arguments)
        self.model = Alone(options, self.past.shape[1], self.model.keep)


class Optimistic(symbols.Model):
    """What was never tried in some symbols is worth ``best``; what was tried is what it was so far. Ties at random."""

    def qualities(self, draw: Callable[[Doubles], Doubles]) -> Doubles:
        known = super().qualities(lambda counts: np.where(counts == symbols.PRIOR, 1e-9, counts))
        return known + 1e-6 * draw(np.ones(known.shape))

    def elsewhere(self, weights: Doubles, draw: Callable[[Doubles], Doubles]) -> tuple[Doubles, Doubles]:
        size = len(self.symbols) * self.options
        return np.ones(size), np.zeros(size)


class RMax(symbols.SymbolsChooser):
    """R-max (Brafman and Tennenholtz 2002) over symbols, where one execution is enough to know an outcome."""

    def __init__(self, environments: int, options: int, *arguments: Any):
        super().__init__(environments, options, *arguments)
        self.model = Optimistic(options, self.past.shape[1], self.model.keep)


HAVE_CONSTANTS: dict[str, Any] = {"symbols": symbols, "thompson": Thompson}


def data_at(folder: Path, world: World, seed: int) -> Path:
    """The data of a seed, in rooms, or of all seeds."""
    return folder / (f"rooms-{seed}.h5" if world.domain == "rooms" else f"{world.domain}.h5")


def ensemble_at(folder: Path, world: World, seed: int) -> Path:
    """The D-BAT ensemble of a seed."""
    return folder / f"{world.domain}-members-{world.members}/seed-{seed}"


def options_at(folder: Path, name: str, layout: int) -> Path:
    """The options that practised on a layout."""
    name = "practised" if name == "exploring" else name
    return folder / f"options-{name}/layout-{layout}"


def train_ensemble(folder: Path, name: str, seed: int) -> None:
    """Train the ensemble of a world's seed."""
    world = ALL[name]
    place = ensemble_at(folder, world, seed)
    data = data_at(folder, world, seed)
    hypogoal.train_ensemble(data, place, diversity="dbat", members=world.members, seed=seed, quiet=True, resume=True)


def practise(folder: Path, name: str, layout: int, seed: int) -> None:
    """Have the options of an agent practise."""
    world = ALL[name]
    of_agent: dict[str, Any] = {"layout_seed": layout, "seed": seed, "quiet": True, "resume": True}
    source = ensemble_at(folder, world, seed)
    hypogoal.train_options(source, options_at(folder, name, layout), **of_agent, **(world.practice or {}))


def prepare(folder: Path, worlds: Iterable[str], workers: int) -> None:
    """Make the data, ensembles and practised options that are not there yet, each once, for all their agents."""
    ensembles: dict[Path, Callable[[], None]] = {}
    options: dict[Path, Callable[[], None]] = {}
    for name in worlds:
        world = ALL[name]
        for layout, seed in world.agents.items():
            data = data_at(folder, world, seed)
            if not data.exists():
                hypogoal.collect(world.domain, data, seed=seed if world.domain == "rooms" else 0, quiet=True)
            ensembles[ensemble_at(folder, world, seed)] = partial(train_ensemble, folder, name, seed)
            if world.practice is not None:
                options[options_at(folder, name, layout)] = partial(practise, folder, name, layout, seed)
    for made in (ensembles, options):
        missing = [importable(job) for place, job in made.items() if not place.exists()]
        in_processes(missing, workers, lambda number, _: None)


def played(
    folder: Path, name: str, chooser: str, prior: str, hope: str, half_life: str, layout: int, seed: int
) -> list[Row]:
    """One agent: its row, with how soon it succeeds. The three constants are empty if the chooser has none."""
    world = ALL[name]
    _, setting, environments = CHOOSERS[chooser]
    steps = steps_of(name, chooser)
    holder = holder_of(chooser)
    if holder is not None:
        holder.PRIOR, holder.HOPE = float(prior), float(hope)
    if half_life:
        symbols.HALF_LIFE = float(half_life)  # type: ignore[assignment]  # a power's divisor
    of_agent = {"layout_seed": layout, "seed": seed, "quiet": True}
    settings = {**world.settings, **of_agent, "chooser": setting, "steps": steps}
    if environments:
        settings["environments"] = environments
    practised = 0
    if world.practice is not None:
        settings["options"] = options_at(folder, name, layout)
        practised = budget_of(open_artefact(settings["options"]).config)
    with tempfile.TemporaryDirectory() as out:
        hypogoal.train_meta(ensemble_at(folder, world, seed), Path(out) / "agent", **settings)
        episodes = Episodes.read(Path(out) / "agent" / Episodes.FILE)
    numbers = run_numbers(episodes, None)
    row: Row = dict(zip(KEYS, (name, chooser, prior, hope, half_life, layout, seed), strict=True))
    row |= {"step": steps, "episodes": len(episodes)} | {quantity: numbers[quantity] for quantity in QUANTITIES}
    arrived = numbers["episodes_to_95"]
    row["steps_to_95_of_20"] = "" if np.isnan(arrived) else int(episodes.step[int(arrived) - 1])
    row["steps_to_95"] = "" if np.isnan(numbers["steps_to_95"]) else int(numbers["steps_to_95"])
    row |= {"solved_at_end": numbers["success"], "practised": practised}
    return [row]


def holder_of(chooser: str) -> Any:
    """Where a chooser's constants ``PRIOR`` and ``HOPE`` are; None if it has none."""
    return {"thompson": Thompson}.get(chooser, symbols if chooser in OF_SYMBOLS else None)


def steps_of(name: str, chooser: str) -> int:
    """The steps that a chooser plays in a world."""
    world = ALL[name]
    return world.steps_of_ppo or world.steps if chooser.startswith("ppo") else world.steps


def constants_of(chooser: str, name: str) -> list[tuple[str, str, str]]:
    """The constants that a chooser is played with: its own, or all that are tried."""
    holder = holder_of(chooser)
    if holder is None:
        return [("", "", "")]
    learned = ALL[name].settings.get("network") != "planned" and ALL[name].domain != "rooms"
    half_life = str(symbols.HALF_LIFE) if holder is symbols and learned else ""  # plans do not change
    if name == "tuning-planned":
        return [(str(prior), str(hope), half_life) for prior, hope in product(PRIORS, HOPES)]
    own = str(holder.PRIOR), str(holder.HOPE)
    if name == "tuning-practised":
        return [(*own, str(tried)) for tried in HALF_LIVES]
    return [(*own, half_life)]


def jobs_of(folder: Path, worlds: Iterable[str]) -> Jobs:
    """A cell an agent, of every chooser, world and layout."""
    jobs: Jobs = {}
    for name in worlds:
        for (layout, seed), chooser in product(ALL[name].agents.items(), ALL[name].choosers):
            for constants in constants_of(chooser, name):
                cell = (name, chooser, *constants, str(layout), str(seed))
                jobs[cell] = partial(played, folder, name, chooser, *constants, layout, seed)
    return jobs


def episodes_of(rows: Iterable[dict[str, str]]) -> dict[str, float]:
    """By layout the episodes to 95 % of 20; ``LIMIT`` where it was not reached."""
    arrived = {}
    for row in rows:
        value = float(row["episodes_to_95"] or "nan")
        arrived[row["layout"]] = LIMIT if np.isnan(value) else value
    return arrived


def tables(path: Path) -> Iterator[str]:
    """Of each world how many episodes and steps each chooser needs."""
    by_world: dict[str, list[dict[str, str]]] = {}
    for row in read_rows(path):
        by_world.setdefault(row["world"], []).append(row)
    for name in filter(by_world.get, ALL):
        rows = by_world[name]
        yield f"{ALL[name].title}: episodes until 95 % of 20 are solved ({LIMIT}: never); shares solved; steps.\n"
        yield from _table(rows)


def _table(rows: list[dict[str, str]]) -> Iterator[str]:
    order = [*CHOOSERS]
    by_kind: dict[tuple[str, ...], list[dict[str, str]]] = {}
    for row in sorted(rows, key=lambda row: order.index(row["chooser"])):
        kind = tuple(row[key] for key in KEYS[1:5])
        by_kind.setdefault(kind, []).append(row)
    several = len(by_kind) > len({kind[0] for kind in by_kind})
    first = episodes_of(next(iter(by_kind.values())))
    shown = []
    for (chooser, *constants), own in by_kind.items():
        numbers = episodes_of(own)
        values = np.array([*numbers.values()])
        title, *_ = CHOOSERS[chooser]
        if several:
            title = f"{title}: {', '.join(filter(None, constants))}"
        ratios = np.array([numbers[layout] / first[layout] for layout in numbers])
        shares = [_mean(own, quantity) for quantity in QUANTITIES[:-1]]
        shown.append([title, *_summary(values), amount(ratios, 1), *shares, _steps(own)])
    of_episodes = [f"share solved of episodes {part}" for part in ("1-10", "11-20", "21-50", "51-100")]
    episodes = ["episodes until then, median", "episodes, mean", "episodes, most"]
    until = [*episodes, "times the first row's episodes, median"]
    yield from table(["chooser", "agents that arrived", *until, *of_episodes, "steps to 95 of 100, median"], shown)


def _mean(rows: list[dict[str, str]], quantity: str) -> str:
    values = np.array([float(row[quantity] or "nan") for row in rows])
    return "-" if np.isnan(values).all() else f"{np.nanmean(values):.2f}"


def _steps(rows: list[dict[str, str]]) -> str:
    """The median steps to 95 of 100 episodes, those of practice among them; never if most do not arrive."""
    values = [float(row["steps_to_95"] or "inf") for row in rows]
    median = np.median(values)
    return "never" if np.isinf(median) else f"{median:,.0f}"


def _summary(values: NDArray[np.float64]) -> list[str]:
    """How many arrived; the median with its interval, the mean and the most, ``LIMIT`` where they never do."""
    arrived = f"{(values < LIMIT).sum()} of {len(values)}"
    or_never = np.where(values < LIMIT, values, np.inf)
    return [arrived, amount(or_never, 0), f"{values.mean():.0f}", f"{values.max():.0f}"]


def main() -> None:
    """Play what is missing, then print the tables."""
    parser = parser_of(__doc__, run="the folder of data, ensembles and options; made where there is none")
    parser.add_argument("--workers", type=int, default=1, help="processes")
    parser.add_argument("--constants", action="store_true", help="those that are tried, on the layouts for that")
    parser.add_argument("--worlds", help=f"some alone: {','.join(ALL)}")
    arguments = parser.parse_args()
    if printed(arguments, tables):
        return
    worlds = [*(TUNING if arguments.constants else WORLDS)]
    if arguments.worlds:
        worlds = arguments.worlds.split(",")
    prepare(arguments.run, worlds, arguments.workers)
    jobs = jobs_of(arguments.run, worlds)
    run_cells(arguments.csv, COLUMNS, KEYS, jobs, lambda cell: [steps_of(*cell[:2])], arguments.workers)
    print("\n".join(tables(arguments.csv)))


if __name__ == "__main__":
    main()
