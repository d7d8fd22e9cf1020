"""How many episodes a chooser needs where a wrong key ends the episode: symbols, PPO, Thompson sampling, random.

python -m studies.symbols runs/symbols runs/symbols.csv
python -m studies.symbols runs/symbols runs/symbols-constants.csv --constants
python -m studies.symbols --tables runs/symbols.csv

Options are planned, the world is that of ``--preset choosing``. Reported: the ten layouts of the experiment 'choosing',
each with the D-BAT ensemble (K = 6) of its seed. Constants, those of ``hypogoal/meta/symbols.py`` and those of Thompson
sampling, are chosen on layouts 100 to 119, with one ensemble of another seed: the pair with the fewest episodes in the
mean, where an agent that never arrives counts as ``LIMIT``.
"""

from __future__ import annotations

import tempfile
from collections.abc import Callable, Iterable, Iterator
from functools import partial
from itertools import product
from pathlib import Path
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

import hypogoal
from hypogoal.core.arrays import Bools, Doubles, Ints
from hypogoal.core.seeding import rng_for
from hypogoal.domains.base import Engine
from hypogoal.evaluation.curves import episode_numbers
from hypogoal.experiments.built_in import SOLVABLE
from hypogoal.meta import symbols
from hypogoal.options.choosers import Chooser, Outcome
from hypogoal.options.tables import Episodes
from studies.cells import Cell, Jobs, Row, parser_of, printed, read_rows, run_cells, table

PAIRS = dict(zip(SOLVABLE, range(920, 930), strict=True))  # seed of each layout, as in 'choosing'
TUNED, TUNING_SEED = range(100, 120), 900
PRIORS, HOPES = (0.1, 0.3, 1.0), (0.1, 0.2, 0.5)  # the same pairs for both that draw
JEFFREYS = 1.0, 0.5  # Thompson sampling's, where nothing is chosen
LIMIT = 5_000  # episodes, for a run that does not arrive
STEPS, STEPS_OF_PPO = 8_000, 80_000
CHOOSERS = {  # title, the setting, environments
    "symbols": ("symbols", "symbols", 1),
    "thompson": ("Thompson sampling over options, no symbols", "studies.symbols:Thompson", 1),
    "rmax": ("R-max over symbols", "studies.symbols:RMax", 1),
    "ppo-16": ("PPO, 16 environments", "ppo", 16),
    "ppo-1": ("PPO, 1 environment", "ppo", 1),
    "random": ("uniform random", "random", 1),
}
KEYS = ("chooser", "prior", "hope", "layout", "seed")
QUANTITIES = ("solved_1_10", "solved_11_20", "solved_21_50", "solved_51_100", "episodes_to_95")
COLUMNS = (*KEYS, "step", "episodes", *QUANTITIES, "steps_to_95_of_20")


class Thompson(Chooser):
    """Thompson sampling over options alone: each has a Beta posterior of the success of episodes that it was used in.

    One draw an episode for each environment; the offered option with the highest is taken.
    """

    CHANGING = ("rng", "counts", "drawn", "used")
    PRIOR, HOPE = JEFFREYS

    def __init__(self, environments: int, options: int, rng: np.random.Generator):
        self.rng = rng
        failed, succeeded = self.PRIOR * (1 - self.HOPE), self.PRIOR * self.HOPE
        self.counts = np.array([[failed] * options, [succeeded] * options])
        self.drawn = rng.beta(succeeded, failed, size=(environments, options))
        self.used = np.zeros((environments, options), np.bool_)

    @classmethod
    def create(cls, engine: Engine, options: int, config: Any, seed: int, device: str) -> Self:
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


def ensemble_at(folder: Path, seed: int) -> Path:
    """The D-BAT ensemble of a seed; trained where it is not there yet."""
    data, ensemble = folder / "data.h5", folder / f"ensemble/seed-{seed}"
    if not data.exists():
        hypogoal.collect("doorkey", data, quiet=True, resume=True)
    if not ensemble.exists():
        hypogoal.train_ensemble(data, ensemble, diversity="dbat", members=6, seed=seed, quiet=True, resume=True)
    return ensemble


def played(ensemble: Path, chooser: str, prior: str, hope: str, layout: int, seed: int) -> list[Row]:
    """One agent: its row, with how soon it succeeds. ``prior`` and ``hope``: constants of a chooser that has them."""
    _, setting, environments = CHOOSERS[chooser]
    [steps] = steps_of((chooser,))
    world = {"network": "planned", "layout_seed": layout, "steps": steps, "environments": environments}
    if chooser in HAVE_CONSTANTS:
        holder = HAVE_CONSTANTS[chooser]
        holder.PRIOR, holder.HOPE = float(prior), float(hope)
    with tempfile.TemporaryDirectory() as folder:
        out = Path(folder) / "agent"
        hypogoal.train_meta(ensemble, out, preset="choosing", chooser=setting, seed=seed, quiet=True, **world)
        episodes = Episodes.read(out / Episodes.FILE)
    numbers = episode_numbers(episodes.succeeded)
    row: Row = dict(zip(KEYS, (chooser, prior, hope, layout, seed), strict=True))
    row |= {"step": steps, "episodes": len(episodes)} | {name: numbers[name] for name in QUANTITIES}
    arrived = numbers["episodes_to_95"]
    row["steps_to_95_of_20"] = "" if np.isnan(arrived) else int(episodes.step[int(arrived) - 1])
    return [row]


def jobs_of(folder: Path, layouts: Iterable[int], *, constants: bool) -> Jobs:
    """A cell an agent: every chooser on the reported layouts, or those with constants, with every pair of them."""
    kinds: list[tuple[str, str, str]] = []
    for chooser in CHOOSERS:
        holder = HAVE_CONSTANTS.get(chooser)
        if constants and holder:
            kinds += [(chooser, str(prior), str(hope)) for prior, hope in product(PRIORS, HOPES)]
        elif not constants:
            kinds.append((chooser, str(holder.PRIOR), str(holder.HOPE)) if holder else (chooser, "", ""))
    jobs: Jobs = {}
    for layout, (chooser, prior, hope) in product(layouts, kinds):
        seed = TUNING_SEED if constants else PAIRS[layout]
        cell = (chooser, prior, hope, str(layout), str(seed))
        jobs[cell] = partial(played, ensemble_at(folder, seed), chooser, prior, hope, layout, seed)
    return jobs


def steps_of(cell: Cell) -> list[int]:
    """The steps that a cell is wanted at."""
    return [STEPS_OF_PPO if cell[0].startswith("ppo") else STEPS]


def episodes_of(rows: Iterable[dict[str, str]]) -> dict[str, float]:
    """By layout the episodes to 95 % of 20; ``LIMIT`` where it was not reached."""
    arrived = {}
    for row in rows:
        value = float(row["episodes_to_95"] or "nan")
        arrived[row["layout"]] = LIMIT if np.isnan(value) else value
    return arrived


def tables(path: Path) -> Iterator[str]:
    """Each chooser's episodes, layout by layout, and their paired ratios to those of symbols; or each constant's."""
    rows = read_rows(path)
    layouts = sorted({row["layout"] for row in rows}, key=int)
    by_kind: dict[tuple[str, ...], list[dict[str, str]]] = {}
    for row in rows:
        by_kind.setdefault((row["chooser"], row["prior"], row["hope"]), []).append(row)
    several = len({kind[1:] for kind in by_kind}) > 1
    first = episodes_of(next(iter(by_kind.values())))
    yield f"Episodes until 95 % of 20 are solved; {LIMIT} where that was never.\n"
    shown = []
    for (chooser, prior, hope), own in by_kind.items():
        numbers = episodes_of(own)
        values = np.array([*numbers.values()])
        title, *_ = CHOOSERS[chooser]
        title = f"{title}, PRIOR {prior}, HOPE {hope}" if several and prior else title
        ratios = np.array([numbers[layout] / first[layout] for layout in numbers if layout in first])
        each = [f"{numbers[layout]:.0f}" if layout in numbers else "-" for layout in layouts]
        shown.append([title, *_summary(values), f"{np.median(ratios):.1f}", *each])
    yield from table(["", "arrived", "median", "mean", "most", "ratio, median", *layouts], shown)


def _summary(values: NDArray[np.float64]) -> list[str]:
    arrived = f"{(values < LIMIT).sum()} of {len(values)}"
    return [arrived, *(f"{value:.0f}" for value in (np.median(values), values.mean(), values.max()))]


def main() -> None:
    """Play what is missing, then print the tables."""
    parser = parser_of(__doc__, run="the folder of data and ensembles; made where there is none")
    parser.add_argument("--workers", type=int, default=1, help="processes")
    parser.add_argument("--constants", action="store_true", help="symbols alone, with pairs of constants")
    parser.add_argument("--layouts", help="some of the layouts alone, 70100,70101")
    arguments = parser.parse_args()
    if printed(arguments, tables):
        return
    layouts = [*(TUNED if arguments.constants else PAIRS)]
    if arguments.layouts:
        layouts = [int(layout) for layout in arguments.layouts.split(",")]
    jobs = jobs_of(arguments.run, layouts, constants=arguments.constants)
    run_cells(arguments.csv, COLUMNS, KEYS, jobs, steps_of, arguments.workers)
    print("\n".join(tables(arguments.csv)))


if __name__ == "__main__":
    main()
