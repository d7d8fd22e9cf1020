"""Other ways to members with features of their own, on WhichFeature: docs/results/which-feature-ways.md.

python -m studies.ways docs/results/which-feature-ways.csv --choose   both settings of each way on seeds 200 to 204
python -m studies.ways docs/results/which-feature-ways.csv            the chosen ones on seeds 400 to 409
python -m studies.ways docs/results/which-feature-ways.csv --tables   print the tables
"""

from __future__ import annotations

import argparse
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import replace
from itertools import combinations, product
from pathlib import Path
from typing import Any, TypeAlias
from unittest import mock

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter

from hypogoal.core.files import write_table
from hypogoal.core.progress import Progress
from hypogoal.core.seeding import rng_for, seed_for
from hypogoal.hypotheses import training
from hypogoal.hypotheses.batches import TrainingStates
from hypogoal.hypotheses.training import fit
from hypogoal.which_feature.run import (
    COLUMNS,
    Scored,
    WhichFeatureConfig,
    config_of,
    copies,
    parse_entry,
    read_cells,
    resolved,
    rows_of,
    run_cell,
    scored,
)
from hypogoal.which_feature.states import (
    FACTORS,
    SIDE,
    TILE,
    Scenes,
    crossed_states,
    labelled_states,
    unlabelled_states,
)
from hypogoal.which_feature.table import summary, with_interval
from studies.cells import table
from studies.which_feature import HIGH, LOW, TEN, covered

CHOICE_SEEDS, CHOICE_MIXES = range(200, 205), (0.5,)
TEST_SEEDS, TEST_MIXES = range(400, 410), (0.5, 1.0)
BESIDE = ("joint", "dbat:0.1", "none")  # on the same seeds, from which-feature-ten.csv

Pictures: TypeAlias = NDArray[np.uint8]  # (N, 48, 48, 3)
Invariance: TypeAlias = Callable[[Pictures, np.random.Generator], Pictures]
VERSIONS = 8  # of each picture, drawn anew: labelled ones to train on, test ones whose probabilities are averaged
PER_SIDE = SIDE // TILE


def without_hue(pictures: Pictures, rng: np.random.Generator) -> Pictures:
    """The channels of each tile in random order; in one order for all tiles the red agent would show what was red."""
    tiles = _tiles(pictures)
    order = rng.permuted(np.tile(np.arange(3), (*tiles.shape[:2], 1)), axis=2)
    return _picture(np.take_along_axis(tiles, order[:, :, None, None], axis=4))


def without_place(pictures: Pictures, rng: np.random.Generator) -> Pictures:
    """Tiles in random order."""
    tiles = _tiles(pictures)
    order = rng.permuted(np.tile(np.arange(tiles.shape[1]), (len(tiles), 1)), axis=1)
    return _picture(np.take_along_axis(tiles, order[..., None, None, None], axis=1))


def _tiles(pictures: Pictures) -> Pictures:
    """The pictures' tiles (N, 36, 8, 8, 3), row by row."""
    rows = pictures.reshape(-1, PER_SIDE, TILE, PER_SIDE, TILE, 3).swapaxes(2, 3)
    return rows.reshape(-1, PER_SIDE**2, TILE, TILE, 3)


def _picture(tiles: Pictures) -> Pictures:
    """The reverse of :func:`_tiles`."""
    return tiles.reshape(-1, PER_SIDE, PER_SIDE, TILE, TILE, 3).swapaxes(2, 3).reshape(-1, SIDE, SIDE, 3)


def without_form(pictures: Pictures, rng: np.random.Generator) -> Pictures:
    """Blurred."""
    return gaussian_filter(pictures.astype(np.float32), (0, TILE / 2, TILE / 2, 0)).astype(np.uint8)


def without_number(pictures: Pictures, rng: np.random.Generator) -> Pictures:
    """Half of the tiles black."""
    shown = rng.random((len(pictures), PER_SIDE, PER_SIDE, 1)) < 0.5
    return pictures * shown.repeat(TILE, axis=1).repeat(TILE, axis=2)


INVARIANCES: tuple[Invariance, ...] = (without_hue, without_place, without_form, without_number)


def invariant(
    groups: Sequence[Sequence[Invariance]], labelled: Scenes, test: Scenes, config: WhichFeatureConfig, seed: int
) -> NDArray[np.float32]:
    """Probabilities (N, K) of members that each see pictures only under invariances of their own."""
    every = []
    for member, group in enumerate(groups):
        rng = rng_for(seed, "ways", member)

        def versions(
            pictures: Pictures, group: Sequence[Invariance] = group, rng: np.random.Generator = rng
        ) -> Pictures:
            several = np.tile(pictures, (VERSIONS, 1, 1, 1))
            for change in group:
                several = change(several, rng)
            return several

        labels = np.tile(labelled.factors[:, 0], VERSIONS)
        alone = replace(config, members=1, diversity="none")
        network = fit(
            versions(labelled.observations), labels, test.observations[:0], alone, seed_for(seed, "ways", member)
        )
        every.append(network.predict(versions(test.observations)).reshape(VERSIONS, -1).mean(0))
    return np.stack(every, axis=1)


class WithUnlabelledGradients(TrainingStates):
    """Gradients are those at unlabelled states (the first of them, as many as there are labelled ones)."""

    def __init__(
        self, observations: Pictures, labels: NDArray[np.bool_], unlabelled: Pictures, *rest: Any, **more: Any
    ):
        super().__init__(observations, labels, unlabelled, *rest, **more)
        self._labelled = unlabelled


def least_alike(
    on_labelled: NDArray[np.bool_], labels: NDArray[np.bool_], on_unlabelled: NDArray[np.bool_], count: int
) -> list[int]:
    """The ``count`` members that agree least, in the mean of pairs, by predictions (N, K), (M, K).

    Of those right on 95 % of the labelled states, or of the ``count`` that are right most often where these are fewer.
    """
    right = (on_labelled == labels[:, None]).mean(0)
    fit_enough = [*np.flatnonzero(right >= min(0.95, np.sort(right)[-count]))]
    alike = (on_unlabelled[:, :, None] == on_unlabelled[:, None]).mean(0)
    return [*min(combinations(fit_enough, count), key=lambda group: alike[np.ix_(group, group)].sum())]


def one_each(mix: float, seed: int, config: WhichFeatureConfig) -> NDArray[np.float32]:
    """Each member under one invariance."""
    groups = [[change] for change in INVARIANCES]
    return invariant(groups, *_labelled_and_test(seed, config), config, seed)


def all_but_one(mix: float, seed: int, config: WhichFeatureConfig) -> NDArray[np.float32]:
    """Each member under all invariances but one."""
    groups = [[change for change in INVARIANCES if change is not left] for left in INVARIANCES]
    return invariant(groups, *_labelled_and_test(seed, config), config, seed)


def of_eight(objective: str) -> Callable[[float, int, WhichFeatureConfig], NDArray[np.float32]]:
    """Eight members, of which the four that agree least are kept."""

    def probabilities(mix: float, seed: int, config: WhichFeatureConfig) -> NDArray[np.float32]:
        labelled, test = _labelled_and_test(seed, config)
        unlabelled = unlabelled_states(config.unlabelled, mix, seed).observations
        settings = replace(config_of(parse_entry(objective), config), members=2 * config.members)
        labels = labelled.factors[:, 0]
        ensemble = fit(labelled.observations, labels, unlabelled, settings, seed_for(seed, "ensemble"))
        on_labelled, on_unlabelled = (ensemble.predict(states) > 0.5 for states in (labelled.observations, unlabelled))
        return ensemble.predict(test.observations)[:, least_alike(on_labelled, labels, on_unlabelled, config.members)]

    return probabilities


def _labelled_and_test(seed: int, config: WhichFeatureConfig) -> tuple[Scenes, Scenes]:
    return labelled_states(config.labelled, seed), crossed_states(copies(FACTORS), seed)


WAYS: Mapping[str, Mapping[str, Callable[[float, int, WhichFeatureConfig], NDArray[np.float32]] | str]] = {
    "invariances": {"one for each member": one_each, "all but one for each member": all_but_one},
    "four of eight": {"four of eight, none": of_eight("none"), "four of eight, hsic:0.01": of_eight("hsic:0.01")},
    "gradients": {f"unlabelled gradients, {weight:g}": f"input-gradients:{weight:g}" for weight in (0.01, 0.1)},
}


def run(path: Path, wanted: Iterable[tuple[str, float, int]]) -> None:
    """Run the cells (setting, mix, seed) that the file lacks."""
    cells = read_cells(path) if path.exists() else []
    complete = {(cell.entry, cell.mix, cell.seed) for cell in cells}
    missing = [cell for cell in wanted if cell not in complete]
    config, settings = resolved({}), {name: made for ways in WAYS.values() for name, made in ways.items()}
    with Progress(path.stem, len(missing)) as progress:
        for name, mix, seed in missing:
            made = settings[name]
            if isinstance(made, str):
                with mock.patch.object(training, "TrainingStates", WithUnlabelledGradients):
                    cells.append(replace(run_cell(parse_entry(made), mix, seed, config), entry=name))
            else:
                cells.append(scored(name, mix, seed, made(mix, seed, config), crossed_states(copies(FACTORS), seed)))
            write_table(path, COLUMNS, rows_of(cells, FACTORS))
            progress.advance()


def chosen(cells: Iterable[Scored]) -> list[str]:
    """The rule: of each way's settings the one with the highest coverage on the choosing seeds, ties by best."""
    lines = {line.entry: line for line in summary([c for c in cells if c.seed in CHOICE_SEEDS], HIGH, LOW)}
    return [
        max(ways, key=lambda name: (lines[name].coverage.mean(), lines[name].best.mean()))
        for ways in WAYS.values()
        if all(name in lines for name in ways)
    ]


def tables(path: Path) -> Iterator[str]:
    """The test beside joint, D-BAT and no diversity, then the choice."""
    cells = read_cells(path)
    test = [c for c in (*cells, *read_cells(TEN)) if c.seed in TEST_SEEDS]
    lines = {(line.entry, line.mix): line for line in summary(test, HIGH, LOW)}
    names = [name for name in (*chosen(cells), *BESIDE) if all((name, mix) in lines for mix in TEST_MIXES)]
    yield "Test: coverage (best), that minus joint's and none's seed by seed, and same; Student's 95 % intervals."
    yield ""
    heads = [f"{head}, mix {mix:g}" for mix in TEST_MIXES for head in ("coverage", "minus joint", "minus none", "same")]
    yield from table(["", *heads], ([name, *_compared(name, lines)] for name in names))
    choice = [c for c in cells if c.seed in CHOICE_SEEDS]
    yield "Choice, mix 0.5: coverage (best)."
    yield ""
    yield from table(["", "coverage"], ([line.entry, covered(line)] for line in summary(choice, HIGH, LOW)))


def _compared(name: str, lines: Mapping[tuple[str, float], Any]) -> Iterator[str]:
    for mix in TEST_MIXES:
        line = lines[name, mix]
        yield covered(line)
        for other in ("joint", "none"):
            yield "-" if name == other else with_interval(line.coverage - lines[other, mix].coverage)
        yield f"{np.nanmean(line.same):.2f}"


def main() -> None:
    """Choose, test, or print."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("csv", type=Path, help="the file of all cells; made where there is none")
    parser.add_argument("--choose", action="store_true", help="run the settings that the rule chooses from")
    parser.add_argument("--tables", action="store_true", help="print the tables and run nothing")
    arguments = parser.parse_args()
    if arguments.tables:
        print("\n".join(tables(arguments.csv)))
        return
    torch.set_num_threads(1)
    if arguments.choose:
        settings = (name for ways in WAYS.values() for name in ways)
        run(arguments.csv, product(settings, CHOICE_MIXES, CHOICE_SEEDS))
    else:
        run(arguments.csv, product(chosen(read_cells(arguments.csv)), TEST_MIXES, TEST_SEEDS))


if __name__ == "__main__":
    main()
