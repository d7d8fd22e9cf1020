"""Does a policy over options recover when options that it relies on stop working? DoorKey, planned options.

    HYPOGOAL_TRUST=studies.shock:ForgettingLearner hypogoal sweep studies.shock:shock --out runs/shock
    python -m studies.shock runs/shock docs/results/shock-doorkey.csv

From step 40,000 on, the two members of the last sub-goal, the goal, that were chosen most play an arbitrary action in
each state, for good. Its third member and all other options stay exact, so the task can still be solved. Without a run
it prints the tables of the file.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator
from itertools import product
from pathlib import Path
from typing import Annotated, ClassVar

import numpy as np

from hypogoal.core.artefacts import find_artefacts
from hypogoal.core.seeding import rng_for
from hypogoal.experiments.doorkey import RATES
from hypogoal.experiments.experiment import Command, Layouts, Names, Seeds, experiment, explained
from hypogoal.options.choosers import Ids
from hypogoal.options.config import OptionConfig
from hypogoal.options.planned import PlannedLearner
from hypogoal.options.tables import Episodes
from studies.cells import read_rows, table, write_rows

AT, STEPS, SPAN = 40_000, 80_000, 10_000  # environment steps: of the shock, of a run, of a row
MEMBERS, LOST = 3, 2
FIRST = 300  # changes are chosen on layouts before it
PAPER = (
    "environments=1 meta_network=paper meta_learning_rate=2.5e-4 head=gaussian gae_lambda=0.97 decisions=100 epochs=10"
    " meta_batch=64 advantage_floor=0"
)
METHODS = {
    "random": "chooser=random",
    "paper": PAPER,
    "paper-categorical": f"{PAPER} head=categorical",
    "paper-512": f"{PAPER} decisions=512",
    "defaults": "",
}
# Changes to our defaults, tried on layouts of their own.
CHANGES = {
    "decisions-256": "decisions=256",
    "decisions-128": "decisions=128",
    "entropy-03": "entropy=0.03",
    "floor-03": "advantage_floor=0.03",
    "rate-1e-3": "meta_learning_rate=1e-3",
    "rate-25e-5": "meta_learning_rate=2.5e-4",
    "decisions-128-entropy-03": "decisions=128 entropy=0.03",
}
COLUMNS = ("method", "layout", "seed", "step", "quantity", "value")


class ForgettingLearner(PlannedLearner):
    """Planned options, some of which are lost at step ``AT``."""

    CHANGING: ClassVar[tuple[str, ...]] = (*PlannedLearner.CHANGING, "played", "chosen", "lost")

    def build(self, config: OptionConfig, seed: int) -> None:
        super().build(config, seed)
        self.wrong = rng_for(seed, "shock").integers(0, len(self.actions), self.steps.shape)
        self.played, self.chosen = 0, np.zeros(self.options, dtype=np.int64)
        self.lost = np.zeros(self.options, dtype=np.bool_)

    def act(self, ids: Ids, options: Ids, age: Ids, *, explore: bool = True) -> Ids:
        """The planned actions, arbitrary ones of options that are lost; one step in a hundred is uniform-random."""
        self.played += len(ids)
        if AT // 2 < self.played < AT:
            np.add.at(self.chosen, options, 1)
        elif self.played >= AT and not self.lost.any():
            of_goal = np.arange(self.options - MEMBERS, self.options)
            self.lost[of_goal[np.argsort(-self.chosen[of_goal], kind="stable")[:LOST]]] = True
        actions = np.where(self.lost[options], self.wrong[self._place[ids], options], self.greedy(ids, options, age))
        uniform = self.rng.integers(0, len(self.actions), len(ids))
        return self.actions[np.where(self.rng.random(len(ids)) < 0.01, uniform, actions)]


@experiment("doorkey", stages=("collect", "train-ensemble", "train-meta"), rates=RATES)
def shock(
    *,
    layouts: Layouts = tuple(range(300, 305)),
    seeds: Seeds = (3000, 3001),
    methods: Annotated[Names, explained("settings of train-meta", choices=METHODS | CHANGES)] = tuple(METHODS),
) -> Iterator[Command]:
    """One ensemble a seed, then an agent for each method and layout."""
    yield Command("data", "collect doorkey --set heldout_layouts=1")
    for seed in seeds:
        command = f"train-ensemble @data --diversity dbat --members {MEMBERS} --seed {seed}"
        yield Command(f"ensemble/seed-{seed}", command, {"seed": seed})
    for layout, seed, method in product(layouts, seeds, methods):
        sets = " ".join(f"--set {setting}" for setting in (METHODS | CHANGES)[method].split())
        yield Command(
            f"agent/{method}/layout-{layout}-seed-{seed}",
            f"train-meta @ensemble/seed-{seed} --seed {seed} --layout-seed {layout} --set steps={STEPS}"
            f" --set network=studies.shock:ForgettingLearner {sets}",
            {"method": method, "layout_seed": layout, "seed": seed},
        )


def gather(run: Path) -> Iterator[dict[str, str | int | float]]:
    """The rows of a run's agents: solved and mean length of the episodes that ended in each span of steps."""
    for artefact in find_artefacts(run, "meta"):
        episodes = Episodes.read(artefact.path / Episodes.FILE)
        layout, seed = artefact.config["layout_seed"], artefact.seed
        place = {"method": artefact.path.parent.name, "layout": layout, "seed": seed}
        for step in range(AT, STEPS + 1, SPAN):
            ended = (episodes.step > step - SPAN) & (episodes.step <= step)
            for quantity, values in (("success", episodes.succeeded), ("length", episodes.length)):
                value = float(values[ended].mean()) if ended.any() else 0.0
                yield {**place, "step": step, "quantity": quantity, "value": round(value, 4)}


def tables(path: Path) -> Iterator[str]:
    """Solved in each span of steps, mean over agents, and how many agents recover; layouts from 300 on come first."""
    rows = [row for row in read_rows(path) if row["quantity"] == "success"]
    solved: dict[tuple[bool, str], dict[int, list[float]]] = {}
    for row in rows:
        chosen_on = int(row["layout"]) < FIRST
        solved.setdefault((chosen_on, row["method"]), {}).setdefault(int(row["step"]), []).append(float(row["value"]))
    spans = range(AT, STEPS + 1, SPAN)
    titles = [f"{(step - SPAN) // 1000}-{step // 1000}k" for step in spans]
    order = [*METHODS, *CHANGES, *dict.fromkeys(method for _, method in solved if method not in METHODS | CHANGES)]
    yield from table(
        ["layouts", "", *titles, "recover"],
        (
            [
                "210 to 213" if chosen_on else "300 to 304",
                method,
                *(f"{np.mean(of_method[step]):.2f}" for step in spans),
                f"{sum(value >= 0.95 for value in of_method[STEPS])} of {len(of_method[STEPS])}",
            ]
            for (chosen_on, method), of_method in sorted(
                solved.items(), key=lambda item: (item[0][0], order.index(item[0][1]))
            )
        ),
    )


def main() -> None:
    """Gather a run's rows, or print the tables."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("paths", type=Path, nargs="+", help="a run and the CSV to write; or the CSV alone")
    *runs, path = parser.parse_args().paths
    if not runs:
        print("\n".join(tables(path)))
        return
    write_rows(path, COLUMNS, (row for run in runs for row in gather(run)))


if __name__ == "__main__":
    main()
