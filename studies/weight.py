"""What ``diversity_weight=auto`` chooses in rooms, and what that is worth: the cells behind the result, and its tables.

    python -m studies.weight docs/results/weight.csv --seeds 1300-1309
    python -m studies.weight docs/results/weight.csv --tables

A cell is a method and a seed: data, an ensemble, and for each of both features an agent over planned options that is
rewarded for it (PPO, 5,000 steps), which then plays 8,000 steps. ``owned``: the best member's balanced accuracy by
that feature on 320 states in which the two cross. All but the named settings are what anybody's data get.
"""

from __future__ import annotations

from collections.abc import Iterator
from functools import partial
from itertools import product
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np

import hypogoal
from hypogoal.core.artefacts import open_artefact
from hypogoal.domains.rooms.states import crossed_states
from hypogoal.evaluation.choosing import play_agent
from hypogoal.hypotheses.scores import member_scores
from studies.cells import Jobs, Row, amount, parser_of, printed, read_rows, run_cells, share, table, won

METHODS: dict[str, dict[str, Any]] = {
    "auto": {},
    "by hand": {"diversity_weight": 0.03, "restarts": 1, "threshold": "unlabelled-split"},
    "no diversity": {"diversity": "none"},
    "one classifier": {"diversity": "none", "members": 1},
    "auto, unpaired": {"diversity": "dbat-unpaired"},
    "auto, K = 2": {"members": 2},
    "the paper's": {"diversity_weight": 1e-4, "schedule": "simultaneous", "restarts": 1},
    "auto, one start": {"restarts": 1},
}
FEATURES = ("shape", "place")
KEYS = ("method", "seed")
COLUMNS = (*KEYS, "step", "weight", *(f"{kind}_{name}" for kind in ("owned", "solved", "random") for name in FEATURES))
OWNED = 0.9
CROSSED = 80  # states of each combination of features


def run_cell(method: str, seed: int) -> list[Row]:
    """Train the ensemble and both agents, and play."""
    with TemporaryDirectory() as folder:
        run = Path(folder)
        data, ensemble = run / "data.h5", run / "ensemble"
        hypogoal.collect("rooms", data, seed=seed, quiet=True)
        hypogoal.train_ensemble(data, ensemble, seed=seed, workers=1, quiet=True, **METHODS[method])
        config = open_artefact(ensemble).config
        row: Row = {"method": method, "seed": seed, "step": 0}
        row["weight"] = config["chosen"]["right-room"]["diversity_weight"]
        states = crossed_states(CROSSED, seed, FEATURES)
        predictions = hypogoal.load_ensemble(ensemble, "right-room").predictions(states.observations)
        for feature, truth in zip(FEATURES, states.factors.T, strict=True):
            row[f"owned_{feature}"] = float(member_scores(predictions, truth)["balanced_accuracy"].max())
        for feature in FEATURES:
            agent = run / feature
            world = (f"truth={feature}",)
            hypogoal.train_meta(
                ensemble, agent, world=world, layout_seed=seed, seed=seed, steps=5_000, chooser="ppo", quiet=True
            )
            played = play_agent(open_artefact(agent))
            assert played is not None
            agents, uniform, _ = played
            row[f"solved_{feature}"], row[f"random_{feature}"] = agents["success"], uniform["success"]
    return [row]


def tables(path: Path) -> Iterator[str]:
    """What the rows say, as lines of Markdown."""
    rows = read_rows(path)
    seeds = sorted({int(row["seed"]) for row in rows})

    def values_of(method: str, column: str) -> np.ndarray:
        by_seed = {int(row["seed"]): float(row[column]) for row in rows if row["method"] == method}
        return np.array([by_seed.get(seed, np.nan) for seed in seeds])

    lines = []
    mean_of = {}
    for method in METHODS:
        if not any(row["method"] == method for row in rows):
            continue
        owned = [values_of(method, f"owned_{feature}") >= OWNED for feature in FEATURES]
        solved = [values_of(method, f"solved_{feature}") for feature in FEATURES]
        mean_of[method] = np.mean(solved, axis=0)
        weights = ", ".join(f"{weight:g}" for weight in np.unique(values_of(method, "weight")))
        both = f"{int(np.logical_and(*owned).sum())} of {len(seeds)}"
        lines.append([method, weights, both, *map(share, solved), share(mean_of[method])])
        more = mean_of["auto"] - mean_of[method]
        lines[-1] += [amount(more), won(more)] if method != "auto" else ["-", "-"]
    solved_by = [f"solved, {feature}" for feature in FEATURES]
    apart = ["auto solves more by, median", "seeds on which auto solves more"]
    names = ["members", "weights", "seeds with both features owned", *solved_by, "solved, mean of both", *apart]
    yield ""
    yield from table(names, lines)


def main() -> None:
    parser = parser_of(__doc__, "1300-1309")
    arguments = parser.parse_args()
    if printed(arguments, tables):
        return
    cells = product(METHODS, arguments.seeds)
    jobs: Jobs = {(method, str(seed)): partial(run_cell, method, seed) for method, seed in cells}
    run_cells(arguments.csv, COLUMNS, KEYS, jobs, lambda _: [0], arguments.workers)


if __name__ == "__main__":
    main()
