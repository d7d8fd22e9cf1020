"""Do members look at different parts of a state? Figure 2's question, in numbers.

    python -m studies.attention docs/results/figure2-ladders.csv --seeds 0-4

A cell is a method and a seed: one training with the labels of one ladder group, six members as in the paper, looked
at after each of ``LOOKS`` steps. Attributions are DeepLift's on true bases in rooms that no training set has. Kept and
gone on with as in ``studies.hypotheses``; ``--tables`` draws the cells.

Rule: 'members look at different parts' if D-BAT's have less in common, or lower cosines, than hardly trained ones (2
steps), by Student's 95 % interval over five seeds; 'diversity does it' if less than without diversity and than the
control, likewise, after 300 steps. Commit 74138bb5.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from examples.one_room import observed_pixel
from hypogoal.core.processes import prepare
from hypogoal.core.seeding import seed_for
from hypogoal.domains.montezuma.domain import SEEN_NOWHERE, TABLE_1
from hypogoal.domains.montezuma.sub_goals import CLIMB_DOWN
from hypogoal.hypotheses.config import EnsembleConfig
from hypogoal.hypotheses.deep_lift import attributed, mean_state
from hypogoal.hypotheses.ensemble import Ensemble
from hypogoal.hypotheses.scores import ranking
from hypogoal.hypotheses.training import EnsembleTraining
from hypogoal.observations import spread_rows
from studies.cells import TITLES, Jobs, Row, interval, parser_of, printed, read_rows, run_cells, table
from studies.ladders import METHODS as OF_LADDERS
from studies.ladders import states_of

METHODS = ("dbat", "none", "dbat-unpaired")
MEMBERS = 6
LOOKS = (2, 25, 100, 300)  # the first: what hardly trained members share
STATES = 60  # true bases in unseen rooms, spread over them
SQUARE = 7  # pixels: attributions are compared in squares, so that two edges of one thing are one part
REACH = 12  # pixels: the surroundings of the agent are 25 x 25
KEYS = ("method", "seed", "step", "member")
COLUMNS = (*KEYS, "common", "signed", "near_agent", "ranking_unseen")


def in_squares(values: NDArray[np.floating]) -> NDArray[np.float64]:
    """Attributions (n, K, H, W, C) added up in squares of ``SQUARE`` pixels, and over channels: float64 (n, K, S).

    Sides are multiples of ``SQUARE``.
    """
    states, members, height, width = values.shape[:4]
    squares = values.reshape(states, members, height // SQUARE, SQUARE, width // SQUARE, SQUARE, -1).sum((3, 5, 6))
    flat: NDArray[np.float64] = squares.reshape(states, members, -1)
    return flat


def in_common(values: NDArray[np.floating]) -> NDArray[np.float64]:
    """How much of their attention members share: attributions (n, K, H, W, C) -> float64 (K,), in 0 to 1.

    A member's attention in a state are its squares' shares of all absolute attribution. Two members have the smaller of
    two shares in common, summed over squares: 1 if both are the same, 0 if no square has attributions of both. Means
    over the other members and the states.
    """
    squares = in_squares(np.abs(values))
    shares = squares / squares.sum(-1, keepdims=True)
    return _with_others(np.minimum(shares[:, :, None], shares[:, None]).sum(-1))


def alike(values: NDArray[np.floating]) -> NDArray[np.float64]:
    """How alike members' signed attributions are: (n, K, H, W, C) -> float64 (K,), in -1 to 1.

    The cosine between two members' attributions by square: 1 if the same squares speak for and against, -1 if what
    speaks for one speaks against the other. Means as of :func:`in_common`.
    """
    squares = in_squares(values)
    directions = squares / np.linalg.norm(squares, axis=-1, keepdims=True)
    return _with_others(directions @ directions.swapaxes(1, 2))


def _with_others(pairs: NDArray[np.float64]) -> NDArray[np.float64]:
    """The mean of each member with the others, over states: (n, K, K) -> (K,)."""
    of_pairs = pairs.mean(0)
    means: NDArray[np.float64] = (of_pairs.sum(1) - np.diag(of_pairs)) / (len(of_pairs) - 1)
    return means


def near(values: NDArray[np.floating], places: NDArray[np.float64]) -> NDArray[np.float64]:
    """The share of members' absolute attribution within ``REACH`` pixels of places, (n, 2) -> float64 (K,)."""
    pixels = np.abs(values).sum(-1)
    rows, columns = (np.abs(np.arange(side) - places[:, [axis]]) <= REACH for axis, side in enumerate(pixels.shape[2:]))
    inside = (rows[:, :, None] & columns[:, None])[:, None]
    shares: NDArray[np.float64] = ((pixels * inside).sum((2, 3)) / pixels.sum((2, 3))).mean(0)
    return shares


def run_cell(method: str, seed: int) -> list[Row]:
    """Train one ensemble as ``hypogoal train-ensemble --seed`` would, and look where its members look."""
    prepare()
    data = states_of(1)
    unseen = np.flatnonzero(data.heldout.origins["seen"] == SEEN_NOWHERE)
    labels = data.heldout.labels[unseen, 0]
    bases = unseen[labels]
    bases = bases[spread_rows(len(bases), STATES)]
    positions = np.stack([data.heldout.origins[name][bases] for name in ("room", "x", "y")], axis=1)
    places = observed_pixel(positions)
    rows: list[Row] = []

    def look(step: int, ensemble: Ensemble) -> None:
        baseline = mean_state(ensemble.see(data.unlabelled.observations))
        values = attributed(ensemble, ensemble.see(data.heldout.observations[bases]), baseline).values
        columns = {
            "common": in_common(values),
            "signed": alike(values),
            "near_agent": near(values, places),
            "ranking_unseen": ranking(ensemble.predict(data.heldout.observations[unseen]), labels),
        }
        for member in range(len(ensemble)):
            place = {"method": method, "seed": seed, "step": step, "member": member}
            rows.append(place | {name: float(numbers[member]) for name, numbers in columns.items()})

    config = EnsembleConfig.of(**{**TABLE_1, "members": MEMBERS, "steps": LOOKS[-1]})
    training = EnsembleTraining(
        data.labelled.observations,
        data.labelled.labels[:, 0],
        data.unlabelled.observations,
        config.model_copy(update=OF_LADDERS[method]),
        seed_for(seed, "ensemble", CLIMB_DOWN.name),
    )
    for step, _ in training.steps():
        if step in LOOKS:
            look(step, training.ensemble)
    return rows


Columns = dict[str, NDArray[np.float64]]  # of the K members
Cells = dict[tuple[str, int], dict[int, Columns]]  # by method and step, by seed


def read(path: Path) -> Cells:
    """The cells of the file."""
    cells: Cells = {}
    for row in read_rows(path):
        columns = cells.setdefault((row["method"], int(row["step"])), {}).setdefault(int(row["seed"]), {})
        for name in COLUMNS[len(KEYS) :]:
            columns[name] = np.append(columns.get(name, np.empty(0)), float(row[name]))
    return cells


def tables(path: Path) -> Iterator[str]:
    """What the cells say, as lines of Markdown."""
    cells, rows = read(path), []
    for (method, step), seeds in sorted(cells.items(), key=lambda cell: (METHODS.index(cell[0][0]), cell[0][1])):
        of_dbat = cells["dbat", step]
        shared = [seed for seed in seeds if seed in of_dbat]

        numbers = [TITLES[method], str(step)]
        for name in ("common", "signed"):
            own, dbats = (_over(cell, shared, partial(_mean, name=name)) for cell in (seeds, of_dbat))
            numbers += [interval(own), "-" if method == "dbat" else interval(dbats - own)]
        for of_members in (_least_near, _most_near, _ranking_of_nearest, partial(_mean, name="ranking_unseen")):
            numbers.append(interval(_over(seeds, shared, of_members)))
        rows.append(numbers)
    titles = [
        "members",
        "training steps",
        "attention in common",
        "D-BAT has more in common by",
        "cosine of signed attributions",
        "D-BAT's cosine is higher by",
    ]
    early_and_late = [numbers[: len(titles)] for numbers in rows if numbers[1] in ("25", "300")]
    yield from table(titles, early_and_late)
    yield from table([*titles, "near the agent, least member", "most", "ranking of that member", "mean ranking"], rows)


def _over(cell: dict[int, Columns], seeds: list[int], of_members: Callable[[Columns], float]) -> NDArray[np.float64]:
    return np.array([of_members(cell[seed]) for seed in seeds])


def _mean(columns: Columns, name: str) -> float:
    return float(columns[name].mean())


def _least_near(columns: Columns) -> float:
    return float(columns["near_agent"].min())


def _most_near(columns: Columns) -> float:
    return float(columns["near_agent"].max())


def _ranking_of_nearest(columns: Columns) -> float:
    return float(columns["ranking_unseen"][columns["near_agent"].argmax()])


def main() -> None:
    """Run the cells that are not in the file yet."""
    parser = parser_of(__doc__, "0-4")
    arguments = parser.parse_args()
    if printed(arguments, tables):
        return
    jobs: Jobs = {
        (method, str(seed)): partial(run_cell, method, seed) for seed in arguments.seeds for method in METHODS
    }
    run_cells(arguments.csv, COLUMNS, KEYS[:2], jobs, lambda _: LOOKS, arguments.workers)


if __name__ == "__main__":
    main()
