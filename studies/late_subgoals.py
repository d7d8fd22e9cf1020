"""Late sub-goals: steps and CPU seconds to 95 % on DoorKey, with practice where options got, and with 64 environments.

    hypogoal collect doorkey --out runs/late/data.h5
    hypogoal train-ensemble runs/late/data.h5 --seed 1 --out runs/late/ensemble-1
    python -m studies.late_subgoals docs/results/late-subgoals.csv --runs runs/late --settings today epsilon --seeds 1

trains where a cell is missing; without ``--runs`` it prints the tables of the file. An agent trains as in Figure 6,
40,000 steps of ``train-options`` and then ``train-meta``, until it is at 95 % or at 150,000 steps.
"""

from __future__ import annotations

import argparse
import csv
import time
from collections.abc import Iterator, Mapping
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from hypogoal.core.artefacts import open_artefact
from hypogoal.core.compute import prepare
from hypogoal.core.config import from_values, parse_integers
from hypogoal.domains.base import load_domain
from hypogoal.evaluation.curves import SOLVED
from hypogoal.evaluation.numbers import student_interval
from hypogoal.learners.episodes import LAST
from hypogoal.meta.config import TrainMetaConfig, TrainOptionsConfig
from hypogoal.meta.training import assemble
from hypogoal.options.loop import OptionLoop
from studies.cells import table

PRACTICE, STEPS, LOOK = 40_000, 150_000, 1_000  # environment steps: of train-options; in all; between two looks
CHOOSING = tuple(range(210, 214))  # layouts on which settings were chosen
SETTINGS: Mapping[str, tuple[str, Mapping[str, Any]]] = {  # by name: the control beside it, and what it changes
    "today": ("", {}),
    "practice": ("today", {"practice": 0.25, "practice_turn": 20, "practice_rare": 0.5, "practice_begin": 0.5}),
    "epsilon": ("today", {"epsilon_steps": 2_000}),
    "epsilon, replay kept": ("today", {"epsilon_steps": 2_000}),
    "epsilon, target": ("today", {"epsilon_steps": 2_000, "target_tau": 0.05}),
    "target": ("today", {"target_tau": 0.05}),
    "updates": ("today", {"update_interval": 8}),
    "epsilon, updates": ("today", {"epsilon_steps": 2_000, "update_interval": 8}),
    "64 environments": ("today", {"environments": 64}),
    "true": ("", {"termination": "oracle"}),
    "true, 64 environments": ("true", {"termination": "oracle", "environments": 64}),
}
GONE = ("practice", "epsilon, replay kept")  # of pilots: the code is in commit 6ba270c, or nowhere
OF_MEMBERS = ("layout", "seed", "sub_goal", "member", "true_positives", "false_positives")
COLUMNS = ("setting", "layout", "seed", "steps_to_95", "usual_steps_to_95", "first_success", "seconds")


def settled(loop: OptionLoop) -> bool:
    """Whether 95 of 100 episodes begun one after the other have succeeded, of all that were begun so far.

    Other than the last 100 that ended it does not count successes first (docs/results/finished-episodes.md), however
    many environments there are.
    """
    episodes, count = loop.recorder.episodes, loop.engine.count
    rows = [(step - length * count, succeeded) for step, length, _, _, succeeded in episodes]
    rows += [(episodes.steps - elapsed * count, 0) for elapsed in loop.engine.elapsed.tolist()]
    sums = np.concatenate([[0], np.cumsum([succeeded for _, succeeded in sorted(rows)])])
    return bool((sums[LAST:] - sums[:-LAST] >= SOLVED * LAST).any())


def agent(runs: Path, setting: str, layout: int, seed: int) -> dict[str, Any]:
    """Train one agent; its row. Steps are empty where it did not get there."""
    began = time.process_time()
    ensemble, domain = open_artefact(runs / f"ensemble-{seed}", "ensemble").whole(), load_domain("doorkey")
    changes = {**SETTINGS[setting][1], "layout_seed": layout}
    oracle = changes.get("termination") == "oracle"
    row: dict[str, Any] = {"setting": setting, "layout": layout, "seed": seed}
    before: OptionLoop | None = None
    for kind, end in ((TrainOptionsConfig, PRACTICE), (TrainMetaConfig, STEPS)):
        if (oracle and kind is TrainOptionsConfig) or "steps_to_95" in row:
            continue  # true sub-goals are not practised, as in Figure 6
        config = from_values(kind, changes, "train-meta")
        loop = assemble(domain, ensemble.path, ensemble.config, config, seed)
        episodes = loop.recorder.episodes
        if before:  # as continue_with
            loop.learner.load(before.learner.state())
            loop.recorder.start_at(before.recorder.steps)
            episodes.extend(before.recorder.episodes)
        look = episodes.steps + LOOK
        while episodes.steps < end and "steps_to_95" not in row:
            loop.step()
            if "usual_steps_to_95" not in row and episodes.solved(SOLVED):
                row["usual_steps_to_95"] = episodes.steps
            if episodes.steps >= look:
                look += LOOK
                if settled(loop):
                    row["steps_to_95"] = episodes.steps
        before = loop
    row["first_success"] = next((step for step, *_, succeeded in episodes if succeeded), "")
    return row | {"seconds": round(time.process_time() - began, 1)}


def members(runs: Path, layout: int, seed: int) -> Iterator[dict[str, Any]]:
    """How often each member is positive where its sub-goal holds and where not, of a layout's reachable states."""
    ensemble, domain = open_artefact(runs / f"ensemble-{seed}", "ensemble").whole(), load_domain("doorkey")
    loop = assemble(domain, ensemble.path, ensemble.config, TrainMetaConfig(layout_seed=layout), seed)
    states = loop.engine.reachable()
    assert states is not None
    positive, true = loop.terminations.of(states), loop.engine.labels(states)
    for option, (goal, member) in enumerate(product(range(len(domain.sub_goals)), range(ensemble.config["members"]))):
        shares = [positive[true[:, goal] == holds, option].mean() for holds in (True, False)]
        row = {"layout": layout, "seed": seed, "sub_goal": domain.sub_goals[goal], "member": member}
        yield row | {"true_positives": f"{shares[0]:.3f}", "false_positives": f"{shares[1]:.3f}"}


def tables(path: Path) -> Iterator[str]:
    """Each setting beside today's, over layouts; then layout by layout."""
    with path.open(encoding="utf-8", newline="") as file:
        rows = list(csv.DictReader(file))
    for chosen, title in ((True, "Choosing: layouts 210 to 213."), (False, "Judging: layouts 200 to 209.")):
        part = [row for row in rows if (int(row["layout"]) in CHOOSING) == chosen]
        if part:
            yield title
            yield ""
            yield from _tables(part)


def _tables(rows: list[dict[str, str]]) -> Iterator[str]:
    settings = [name for name in SETTINGS if any(row["setting"] == name for row in rows)]
    agents = sorted({(int(row["layout"]), int(row["seed"])) for row in rows})

    def values(setting: str, quantity: str, *, capped: bool = False) -> NDArray[np.float64]:
        """By agent; inf where it never got there, NaN where it was not run."""
        never = STEPS if capped else np.inf
        seen = {
            (int(row["layout"]), int(row["seed"])): float(row[quantity] or never)
            for row in rows
            if row["setting"] == setting
        }
        return np.array([seen.get(agent, np.nan) for agent in agents])

    def against(setting: str, quantity: str) -> str:
        """The ratio to its control, geometric mean over layouts with Student's interval."""
        if not (control := SETTINGS[setting][0]):
            return "-"
        pair = np.log(values(setting, quantity, capped=True) / values(control, quantity, capped=True))
        layouts = np.array([layout for layout, _ in agents])
        of_layout = [pair[(layouts == layout) & np.isfinite(pair)] for layout in sorted(set(layouts.tolist()))]
        return _ratio(np.array([part.mean() for part in of_layout if len(part)]))

    yield from table(
        ["", "reached 95 %", "steps, median", "ratio", "CPU seconds, median", "ratio", "first success, median"],
        (
            [
                name,
                f"{np.isfinite(steps).sum()} of {(~np.isnan(steps)).sum()}",
                _thousands(_median(steps)),
                against(name, "steps_to_95"),
                f"{_median(values(name, 'seconds')):.0f}",
                against(name, "seconds"),
                _thousands(_median(values(name, "first_success"))),
            ]
            for name in settings
            for steps in [values(name, "steps_to_95")]
        ),
    )
    yield "Thousands of steps to 95 %, layout and seed."
    yield ""
    titles = ["", *(f"{layout}, {seed}" for layout, seed in agents)]
    yield from table(titles, ([name, *map(_thousands, values(name, "steps_to_95").tolist())] for name in settings))


def _ratio(logs: NDArray[np.float64]) -> str:
    if len(logs) < 2:
        return f"{np.exp(logs.mean()):.2f}" if len(logs) else "-"
    low, high = student_interval(logs)
    return f"{np.exp(logs.mean()):.2f} [{np.exp(low):.2f}, {np.exp(high):.2f}]"


def _median(values: NDArray[np.float64]) -> float:
    """The upper one of two, so that it is never between a number and never."""
    ran = np.sort(values[~np.isnan(values)])
    return float(ran[len(ran) // 2])


def _thousands(steps: float) -> str:
    return "-" if np.isnan(steps) else "never" if np.isinf(steps) else f"{steps / 1000:.0f}"


def main() -> None:
    """Train the agents that are missing, or print."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("csv", type=Path, help="the file of all agents; made where there is none")
    parser.add_argument("--runs", type=Path, help="the folder with the ensembles")
    parser.add_argument(
        "--settings", nargs="+", default=["today"], choices=[name for name in SETTINGS if name not in GONE]
    )
    parser.add_argument("--layouts", type=parse_integers, default=parse_integers("200-209"))
    parser.add_argument("--seeds", type=parse_integers, default=parse_integers("1-2"))
    parser.add_argument("--members", action="store_true", help="judge members instead, into a file of their own")
    arguments = parser.parse_args()
    if arguments.runs and arguments.members:
        prepare("cpu")
        with arguments.csv.open("w", encoding="utf-8", newline="") as file:
            writer = csv.DictWriter(file, OF_MEMBERS, lineterminator="\n")
            writer.writeheader()
            for seed, layout in product(arguments.seeds, arguments.layouts):
                writer.writerows(members(arguments.runs, layout, seed))
        return
    if arguments.runs:
        prepare("cpu")
        if not arguments.csv.exists():
            arguments.csv.write_text(",".join(COLUMNS) + "\n", encoding="utf-8")
        for seed, layout, setting in product(arguments.seeds, arguments.layouts, arguments.settings):
            with arguments.csv.open("r+", encoding="utf-8", newline="") as file:
                done = {(row["setting"], row["layout"], row["seed"]) for row in csv.DictReader(file)}
                if (setting, str(layout), str(seed)) not in done:
                    row = agent(arguments.runs, setting, layout, seed)
                    file.seek(0, 2)
                    csv.DictWriter(file, COLUMNS, lineterminator="\n").writerow(row)
    print("\n".join(tables(arguments.csv)))


if __name__ == "__main__":
    main()
