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
from collections import defaultdict
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
from hypogoal.learners.episodes import LAST, EpisodeRecorder
from hypogoal.meta.config import TrainMetaConfig, TrainOptionsConfig
from hypogoal.meta.training import assemble
from hypogoal.options.loop import OptionLoop
from studies.cells import read_rows, table, write_rows

PRACTICE, STEPS, LOOK = 40_000, 150_000, 1_000  # environment steps: of train-options; in all; between two looks
CHOOSING = tuple(range(210, 214))  # layouts on which settings were chosen
SETTINGS: Mapping[str, tuple[str, Mapping[str, Any]]] = {  # by name: the control beside it, and what it changes
    "today": ("", {}),
    "practice": ("today", {"practice": 0.25, "practice_turn": 20, "practice_rare": 0.5, "practice_begin": 0.5}),
    "practice, near": ("today", {"practice": 0.25, "practice_turn": 20, "practice_near": 0.5}),
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
GONE = ("practice", "practice, near", "epsilon, replay kept")  # of pilots: the code is in commit 6ba270c, or nowhere
OF_MEMBERS = ("layout", "seed", "sub_goal", "member", "true_positives", "false_positives")
COLUMNS = ("setting", "layout", "seed", "steps_to_95", "usual_steps_to_95", "first_success", "seconds")


def settled(episodes: EpisodeRecorder, elapsed: NDArray[np.int64]) -> bool:
    """Whether 95 of 100 episodes begun one after the other have succeeded, of all that were begun so far.

    Unlike the last 100 that ended it does not count successes first (docs/results/finished-episodes.md), however many
    environments there are. ``elapsed`` int64 (E,) are the steps of the episodes that go on.
    """
    rows = [(step - length * len(elapsed), succeeded) for step, length, _, _, succeeded in episodes]
    rows += [(episodes.steps - steps * len(elapsed), 0) for steps in elapsed.tolist()]
    sums = np.concatenate([[0], np.cumsum([succeeded for _, succeeded in sorted(rows)])])
    return bool((sums[LAST:] - sums[:-LAST] >= SOLVED * LAST).any())


def agent(runs: Path, setting: str, layout: int, seed: int) -> dict[str, Any]:
    """Train one agent; its row. Steps are empty where it did not get there."""
    began = time.process_time()
    ensemble, domain = open_artefact(runs / f"ensemble-{seed}", "ensemble").whole(), load_domain("doorkey")
    changes = {**SETTINGS[setting][1], "layout_seed": layout}
    row: dict[str, Any] = {"setting": setting, "layout": layout, "seed": seed}
    configs: list[TrainOptionsConfig | TrainMetaConfig] = [from_values(TrainMetaConfig, changes, "train-meta")]
    if changes.get("termination") != "oracle":  # true sub-goals are not practised, as in Figure 6
        configs.insert(0, from_values(TrainOptionsConfig, changes, "train-options"))
    before: OptionLoop | None = None
    for config in configs:
        if "steps_to_95" in row:
            break
        end = PRACTICE if isinstance(config, TrainOptionsConfig) else STEPS
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
                if settled(episodes, loop.engine.elapsed):
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
    """Every agent, layout by layout; then each setting beside its control, over the layouts that have both."""
    rows = read_rows(path)
    found = {(row["setting"], int(row["layout"]), int(row["seed"])): row for row in rows}
    settings = [name for name in SETTINGS if any(row["setting"] == name for row in rows)]
    agents = sorted({agent[1:] for agent in found}, key=lambda agent: (agent[0] not in CHOOSING, agent))

    def cell(setting: str, agent: tuple[int, int]) -> str:
        row = found[setting, *agent]
        steps = f"{int(row['steps_to_95']) / 1000:.0f}" if row["steps_to_95"] else "never"
        return f"{steps} ({float(row['seconds']):.0f})"

    judged = [agent for agent in agents if agent[0] not in CHOOSING]
    layouts, seeds = (sorted({agent[place] for agent in judged}) for place in (0, 1))
    both = [name for name in settings if all((name, *agent) in found for agent in judged)]
    yield from table(
        ["", *map(str, layouts), "solved"],
        (
            [
                f"{name}, seed {seed}",
                *(cell(name, (layout, seed)) for layout in layouts),
                f"{sum(bool(found[name, layout, seed]['steps_to_95']) for layout in layouts)} of {len(layouts)}",
            ]
            for seed, name in product(seeds, both)
        ),
    )

    def ratio(setting: str, quantity: str, *, chosen: bool) -> str:
        """Geometric mean over layouts with Student's interval; who never got there counts 150,000 steps."""
        control, logs = SETTINGS[setting][0], defaultdict(list)
        for layout, seed in agents:
            pair = [found.get((name, layout, seed)) for name in (setting, control)]
            if pair[0] and pair[1] and (layout in CHOOSING) == chosen:
                ours, others = (float(row[quantity] or STEPS) for row in pair if row)
                logs[layout].append(np.log(ours / others))
        means = np.array([np.mean(of_layout) for of_layout in logs.values()])
        return f"{_ratio(means)} (n = {len(means)})" if len(means) else "-"

    cases = [
        (name, chosen)
        for name, chosen in product(settings, (True, False))
        if SETTINGS[name][0] and any(agent[0] == name and (agent[1] in CHOOSING) == chosen for agent in found)
    ]
    yield "Beside the control, geometric mean over layouts."
    yield ""
    yield from table(
        ["", "layouts", "ratio of steps", "ratio of CPU seconds"],
        (
            [
                name,
                "210 to 213" if chosen else "200 to 209",
                *(ratio(name, quantity, chosen=chosen) for quantity in ("steps_to_95", "seconds")),
            ]
            for name, chosen in cases
        ),
    )


def _ratio(logs: NDArray[np.float64]) -> str:
    if len(logs) < 2:
        return f"{np.exp(logs.mean()):.2f}" if len(logs) else "-"
    low, high = student_interval(logs)
    return f"{np.exp(logs.mean()):.2f} [{np.exp(low):.2f}, {np.exp(high):.2f}]"


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
        places = product(arguments.seeds, arguments.layouts)
        rows = (row for seed, layout in places for row in members(arguments.runs, layout, seed))
        write_rows(arguments.csv, OF_MEMBERS, rows)
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
