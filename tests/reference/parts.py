"""What the reference consists of: one function a part, each a few commands and the numbers that they leave.

A part takes a folder to work in and returns a table: rows of text, the first one names the columns, the last column
is the value and those before it say of what. What several parts need (data, an ensemble, options) is made once in that
folder. Only the command line, the public Python names and the files of artefacts are used, so that parts survive
changes inside the package. Seed 3 everywhere.
"""

import contextlib
import csv
import hashlib
import json
import os
import sys
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import gymnasium
import h5py
import numpy as np
from safetensors.numpy import load_file

import hypogoal
from hypogoal.cli import main

CHECKOUT = Path(hypogoal.__file__).parents[1]  # of the code that is run, with its tests and examples
SEED = 3
OBJECTIVES = ("dbat", "divdis", "mutual-information", "none")
DOORKEY_GOALS = ("collect-blue-key", "open-red-door")  # of the options
LAYOUT = 107  # here random actions reach both now and then, so that there is something to trace
HELDOUT_STATES = 40  # of each sub-goal
EXECUTIONS = {LAYOUT: 160, 102: 40}  # of options that learned on the first layout
EPISODE = 40  # steps at most, so that episodes end
CURVE_POINTS = 20  # that are kept of each curve
NEWER = (  # quantities that release 0.23.0 did not have
    *("solved_1_10", "solved_11_20", "solved_21_50", "solved_51_100", "episodes_to_95", "solved_by_episode"),
)
NEWER_COLUMNS = ("better", "better_at_random", "episodes", "got_there", "trained")  # of the verdict's table
CLOSE = 1e-4
# Where pictures are trained on, forty steps part further on a processor that adds up otherwise: by 0.012 at most
# between an AMD EPYC and an Intel Xeon. Another objective parts by 0.17 at least.
LOOSE = 0.03
LOOSE_ELSEWHERE = ("predictions-doorkey-dbat", "predictions-montezuma-dbat", "evaluation-ladders")
EVALUATED = 1e-8

Table = list[tuple[str, ...]]


@dataclass(frozen=True)
class Part:
    """A part of the reference.

    Attributes:
        make: takes the folder to work in, returns the table.
        tolerance: by how much numbers with a fraction may differ, relative to the larger of 1 and the number. Whole
            numbers and texts are equal.
        traced: whether it holds only on the recorded processor with the recorded torch, where rounding is the same.
        slow: left out of the quick tests.
    """

    make: Callable[[Path], Table]
    tolerance: float
    traced: bool
    slow: bool


PARTS: dict[str, Part] = {}


def part(
    name: str, *, tolerance: float = CLOSE, traced: bool = False, slow: bool = False
) -> Callable[[Callable[[Path], Table]], Callable[[Path], Table]]:
    """Make a function a part of this name."""

    def register(make: Callable[[Path], Table]) -> Callable[[Path], Table]:
        PARTS[name] = Part(make, tolerance, traced, slow)
        return make

    return register


# Commands, and what several parts share.


def command(*words: str) -> None:
    """Run ``hypogoal`` with these words, quietly."""
    code = main([*words, "--quiet"])
    if code > 128:
        raise SystemExit(code)  # a signal: no further part is begun
    if code:
        raise RuntimeError(f"hypogoal {' '.join(words)} ended with exit code {code}")


def settings(**values: object) -> list[str]:
    """``--set`` for each setting."""
    words = []
    for key, value in values.items():
        words += ["--set", f"{key}={value}"]
    return words


def settings_of(stage: str, **values: object) -> list[str]:
    """The same for a stage of an experiment."""
    return settings(**{f"{stage}.{key}": value for key, value in values.items()})


def made(out: Path, *words: str, seed: int = SEED) -> Path:
    """What a command with a seed writes at ``out``, unless it is there."""
    if not out.exists():
        out.parent.mkdir(parents=True, exist_ok=True)
        command(*words, "--seed", str(seed), "--out", str(out))
    return out


def allow(folder: str, name: str) -> str:
    """Let ``module:object`` of a folder of the checkout be loaded; returns the name."""
    sys.path.insert(0, str(CHECKOUT / folder))
    os.environ["HYPOGOAL_TRUST"] = "1"
    return name


def doorkey_data(work: Path) -> Path:
    return made(work / "doorkey.h5", "collect", "doorkey", *settings(heldout_layouts=2))


def montezuma_data(work: Path) -> Path:
    few = settings(states_per_room=24, unlabelled_per_room=24, heldout_per_room=8, workers=1)
    return made(work / "montezuma.h5", "collect", "montezuma", *few)


def rooms_data(work: Path) -> Path:
    return made(work / "rooms.h5", "collect", "rooms", *settings(labelled=64, unlabelled=128))


def vector_data(work: Path) -> Path:
    return made(work / "vector.h5", "collect", allow("examples", "vector_goals:DOMAIN"))


def doorkey_ensemble(work: Path) -> Path:
    """Hypotheses of two sub-goals, two each, good enough to stop options now and then."""
    training = settings(steps=40, batch_size=32, learning_rate=1e-3, workers=1)
    words = [*training, *settings(sub_goals=",".join(DOORKEY_GOALS), members=2)]
    return made(work / "doorkey-ensemble", "train-ensemble", str(doorkey_data(work)), *words)


def light_options(work: Path) -> Path:
    """Options that learn fast, so that some of them get there after 2,000 steps."""
    learning = settings(warm_up=200, update_interval=4, option_learning_rate=2e-3)
    words = [*short(2_000), *learning]
    return made(work / "light-options", "train-options", str(doorkey_ensemble(work)), *words)


def short(steps: int) -> list[str]:
    """Settings of so many steps on the layout."""
    return settings(steps=steps, layout_seed=LAYOUT, max_episode_steps=EPISODE)


# Tables.


def number(value: float) -> str:
    """Nine digits, as many as float32 has; a whole number has none behind the point."""
    return str(value) if isinstance(value, int) else f"{value:.9g}"


def hashes(data: Path) -> Table:
    """Each array of an HDF5 file by its sha256."""
    rows: Table = [("array", "dtype", "shape", "sha256")]
    with h5py.File(data) as file:
        for name, array in sorted(arrays_of(file)):
            values = array[()]
            digest = hashlib.sha256(np.ascontiguousarray(values).tobytes()).hexdigest()
            rows.append((name, str(values.dtype), "x".join(map(str, values.shape)), digest))
    return rows


def arrays_of(group: h5py.Group) -> Iterator[tuple[str, h5py.Dataset]]:
    """Every array below a group, those that share one on disk too."""
    for item in group.values():
        if isinstance(item, h5py.Group):
            yield from arrays_of(item)
        else:
            yield item.name, item


# What the stage's settings were for data of one's own, and for rooms, until diversity_weight=auto.
FIXED = {"diversity_weight": 1e-4, "schedule": "simultaneous", "restarts": 1, "share": "labels"}
IN_ROOMS = FIXED | {"diversity_weight": 0.03, "threshold": "unlabelled-split"}


def predictions(work: Path, data: Path, name: str, **changed: object) -> Table:
    """What members trained for 40 steps predict of 40 held-out states of each sub-goal."""
    out = work / f"predictions-{name}"
    made(out, "train-ensemble", str(data), *settings(steps=40, workers=1, **changed))
    rows: Table = [("sub_goal", "state", "member", "probability")]
    with h5py.File(data) as file:
        for sub_goal in sorted(file["heldout"]):
            states = file[f"heldout/{sub_goal}/observations"]
            picked = np.unique(np.linspace(0, len(states) - 1, HELDOUT_STATES).astype(int))
            probabilities = hypogoal.load_ensemble(out, sub_goal).predict(states[()][picked])
            for state, of_members in zip(picked.tolist(), probabilities.tolist(), strict=True):
                for member, probability in enumerate(of_members):
                    rows.append((sub_goal, str(state), str(member), number(probability)))
    return rows


def rows_of(path: Path) -> list[dict[str, str]]:
    """A CSV file's rows by column."""
    with path.open(newline="", encoding="utf-8") as file:
        return list(csv.DictReader(file))


HEALTH = {  # of a training, logged since 1.1
    *("accuracy", "disagreement", "teacher", "option_q", "option_td_error", "exploration_rate", "replay_size"),
    *("policy_gradient_loss", "value_loss", "entropy_loss", "approx_kl", "clip_fraction", "explained_variance"),
}


def log_of(artefact: Path) -> Table:
    """Numbers of a training's log: line, name, value."""
    lines = (artefact / "metrics.jsonl").read_text(encoding="utf-8").splitlines()
    rows: Table = []
    for place, line in enumerate(lines):
        for key, value in sorted(json.loads(line).items()):
            if key not in HEALTH:
                rows.append((f"log {place}", key, number(value)))
    return rows


def weights_of(path: Path) -> Table:
    """Of each array of weights: mean, deviation, first and last value."""
    rows: Table = []
    for name, values in sorted(load_file(path).items()):
        flat = values.astype(np.float64).ravel()
        summary = {"mean": flat.mean(), "deviation": flat.std(), "first": flat[0], "last": flat[-1]}
        for what, value in summary.items():
            rows.append((name, what, number(float(value))))
    return rows


def by_hundred_steps(path: Path) -> Table:
    """A table of executions or episodes as a line a hundred steps: how many, and the sum of each column."""
    sums: dict[int, dict[str, float]] = {}
    for row in rows_of(path):
        hundred = int(row["step"]) // 100
        of_hundred = sums.setdefault(hundred, {"rows": 0.0})
        of_hundred["rows"] += 1
        for column, text in row.items():
            if column != "step" and text:
                of_hundred[column] = of_hundred.get(column, 0.0) + float(text)
    rows: Table = []
    for hundred, of_hundred in sorted(sums.items()):
        for column, total in of_hundred.items():
            rows.append((f"{path.stem} {100 * hundred}", column, number(total)))
    return rows


def whole(path: Path) -> Table:
    """Every cell of a CSV file: line, column, text."""
    rows: Table = []
    for place, row in enumerate(rows_of(path)):
        for column, text in row.items():
            rows.append((f"{path.stem} {place}", column, text))
    return rows


def trace(artefact: Path) -> Table:
    """A training of options: executions and episodes a hundred steps, choices, log, weights."""
    rows: Table = [("line", "column", "value")]
    for name in ("executions", "exploits", "episodes"):
        if (artefact / f"{name}.csv").exists():
            rows += by_hundred_steps(artefact / f"{name}.csv")
    rows += whole(artefact / "choices.csv")
    rows += log_of(artefact)
    for path in sorted(artefact.glob("*.safetensors")):
        rows += weights_of(path)
    return rows


def evaluated(run: Path) -> Table:
    """Every number of a run's evaluation, by where it stands; of a curve some points."""
    evaluation = run / "evaluation"
    if not evaluation.exists():
        command("evaluate", str(run))
    rows = numbers_of(evaluation / "numbers.csv")
    for table in sorted(evaluation.glob("tables/*.csv")):
        rows += table_of(table)
    return [("file", "place", "value"), *sorted(rows)]


def numbers_of(path: Path) -> Table:
    rows: Table = []
    curves: dict[str, list[tuple[int, str]]] = {}
    for row in recorded_of(path):
        value, step = row.pop("value"), row.pop("step")
        place = " ".join(f"{column}={text}" for column, text in row.items() if text)
        if step:
            curves.setdefault(place, []).append((int(step), value))
        else:
            rows.append(("numbers.csv", place, value))
    for place, curve in curves.items():
        for step, value in thinned(sorted(curve)):
            rows.append(("numbers.csv", f"{place} step={step}", value))
    return rows


def recorded_of(path: Path) -> list[dict[str, str]]:
    """The rows of a file but those of ``NEWER``, and of planted features as scopes."""
    rows = [row for row in rows_of(path) if row.get("quantity") not in NEWER]
    return [row for row in rows if not str(row.get("scope")).startswith("planted_")]


def table_of(path: Path) -> Table:
    """The numbers of a question's table, each by its row's texts and its column."""
    rows: Table = []
    for line, row in enumerate(recorded_of(path)):
        for column, text in row.items():
            if column in NEWER_COLUMNS:
                continue
            with contextlib.suppress(ValueError):
                rows.append((f"tables/{path.name}", f"{line} {column}", number(float(text))))
    return rows


def thinned(items: list[Any]) -> list[Any]:
    """Evenly spaced items, the first and the last among them."""
    if len(items) <= CURVE_POINTS:
        return items
    places = np.linspace(0, len(items) - 1, CURVE_POINTS).astype(int)
    return [items[place] for place in places.tolist()]


# Collected states: the same bytes.


def hashes_of(data: Callable[[Path], Path], work: Path) -> Table:
    return hashes(data(work))


for name, data in (("doorkey", doorkey_data), ("montezuma", montezuma_data), ("rooms", rooms_data)):
    part(f"arrays-{name}", slow=name == "montezuma")(partial(hashes_of, data))


# Hypotheses: what members predict after 40 steps.


def add_predictions(name: str, data: Callable[[Path], Path], kind: str, *, slow: bool = False, **how: object) -> None:
    """A part ``predictions-NAME-KIND``."""

    @part(f"predictions-{name}-{kind}", slow=slow)
    def make(work: Path) -> Table:
        return predictions(work, data(work), f"{name}-{kind}", **how)


for objective in OBJECTIVES:
    add_predictions("vector", vector_data, objective, diversity=objective, **FIXED)
add_predictions("doorkey", doorkey_data, "dbat", diversity="dbat", batch_size=32)
add_predictions("montezuma", montezuma_data, "dbat", slow=True, diversity="dbat", batch_size=16, members=2)
for schedule in ("simultaneous", "sequential"):
    add_predictions("rooms", rooms_data, schedule, **IN_ROOMS | {"schedule": schedule})


# Options and the choice among them.


def paper_network(work: Path, recurrence: int) -> Table:
    """The weights and the loss after 50 updates of one option of the paper's network."""
    ensemble = made(
        work / "one-member",
        "train-ensemble",
        str(doorkey_data(work)),
        *settings(sub_goals="collect-red-key", members=1, diversity="none", steps=20, batch_size=16, workers=1),
    )
    learning = {"experience": "own", "option_batch": 32, "environments": 4, "update_interval": 4, "warm_up": 100}
    words = settings(network="paper", recurrence=recurrence, steps=300, **learning)
    options = made(work / f"paper-{recurrence}", "train-options", str(ensemble), *words)
    return [("line", "column", "value"), *log_of(options), *weights_of(options / "options.safetensors")]


for name, recurrence in (("with", 10), ("without", 1)):
    part(f"paper-network-{name}-memory", traced=True, slow=True)(partial(paper_network, recurrence=recurrence))


@part("gaussian-head", traced=True)
def gaussian_head(work: Path) -> Table:
    """An agent whose meta-policy has the Gaussian head: which options it chose, what it learned."""
    words = [*short(1_200), *settings(head="gaussian", decisions=100)]
    return trace(made(work / "gaussian", "train-meta", str(doorkey_ensemble(work)), *words))


@part("planned-options", traced=True)
def planned_options(work: Path) -> Table:
    """Where planned options stop on three layouts: each execution, and the pictures of the stops."""
    rows: Table = [("line", "column", "value")]
    for layout in (102, 107, 109):
        words = settings(network="planned", layout_seed=layout, steps=480)
        options = made(work / f"planned-{layout}", "train-options", str(doorkey_ensemble(work)), *words)
        for line, column, text in whole(options / "exploits.csv"):
            rows.append((f"layout {layout} {line}", column, text))
        for name, _, shape, digest in hashes(options / "terminations.h5")[1:]:
            rows.append((f"layout {layout} stops of {name}", shape, digest))
    return rows


@part("option-env", traced=True)
def option_env(work: Path) -> Table:
    """Options that learned a little, chosen at random among those offered, where they learned and elsewhere."""
    options = hypogoal.load_options(light_options(work))
    rng = np.random.default_rng(SEED)
    rows: Table = [("execution", "column", "value")]
    for layout, executions in EXECUTIONS.items():
        env = hypogoal.OptionEnv(gymnasium.make("hypogoal/DoorKey-8x8-v0", layout_seed=layout), options)
        env.reset(seed=SEED)
        for execution in range(executions):
            option = int(rng.choice(np.flatnonzero(env.action_masks())))
            _, reward, terminated, truncated, info = env.step(option)
            numbers = {"option": option, "duration": info["duration"], "reached": info["reached"], "reward": reward}
            for column, value in numbers.items():
                rows.append((f"layout {layout}, {execution}", column, number(float(value))))
            if terminated or truncated:
                env.reset()
    return rows


@part("train-options", traced=True)
def train_options(work: Path) -> Table:
    return trace(light_options(work))


@part("train-meta", traced=True)
def train_meta(work: Path) -> Table:
    words = [*short(2_000), *settings(decisions=128)]
    return trace(made(work / "meta", "train-meta", str(doorkey_ensemble(work)), *words))


@part("train-options-ladder", traced=True, slow=True)
def train_options_ladder(work: Path) -> Table:
    few = settings(members=2, steps=40, batch_size=16, workers=1)
    ensemble = made(work / "montezuma-ensemble", "train-ensemble", str(montezuma_data(work)), *few)
    words = settings(start="1L", steps=1_000)  # of each option
    return trace(made(work / "ladder-options", "train-options", str(ensemble), *words))


# Evaluations.


@part("evaluation-ladders", tolerance=EVALUATED)
def evaluation_ladders(work: Path) -> Table:
    """Of a run that is written and not trained: members with fresh weights, made-up executions."""
    sys.path.insert(0, str(CHECKOUT / "tests"))
    allow("tests/evaluation", "ladder_run:DOMAIN")
    from ladder_run import write_run

    run = work / "ladders"
    write_run(run, numbers=(1, 2), methods=("dbat", "none"))
    return evaluated(run)


@part("evaluation-rooms", tolerance=EVALUATED, traced=True, slow=True)
def evaluation_rooms(work: Path) -> Table:
    """Eight seeds, from which on intervals are bootstrapped; in one process, since each command takes a moment."""
    run = work / "rooms"
    methods = {"dbat": settings(diversity="dbat", members=3), "one": settings(diversity="none", members=1)}
    for seed in range(970, 978):
        data = made(run / f"data/seed-{seed}.h5", "collect", "rooms", seed=seed)
        for method, chosen in methods.items():
            words = [*chosen, *settings(steps=100, workers=1, **IN_ROOMS)]
            out = run / f"ensemble/method-{method}-seed-{seed}"
            ensemble = made(out, "train-ensemble", str(data), *words, seed=seed)
            words = settings(layout_seed=seed, world="truth=shape", steps=2_000, chooser="ppo")
            out = run / f"agent/method-{method}-truth-shape-seed-{seed}"
            made(out, "train-meta", str(ensemble), *words, seed=seed)
    return evaluated(run)


@part("evaluation-demo", tolerance=EVALUATED, traced=True, slow=True)
def evaluation_demo(work: Path) -> Table:
    """The demo of DoorKey with shorter trainings."""
    run = work / "demo"
    shorter = settings_of("collect", heldout_layouts=2) + settings_of("train-ensemble", steps=40, batch_size=32)
    explored = {"epsilon_steps": 8_000, "update_interval": 16, "option_learning_rate": 5e-4}  # as the preset once had
    chosen = {"chooser": "ppo", "epsilon_steps": 8_000, "epsilon_final": 0.05}
    shorter += settings_of("train-options", steps=8_000, **explored) + settings_of("train-meta", steps=6_000, **chosen)
    shorter += settings_of("train-baseline", steps=6_000)
    command("run", "doorkey", "--preset", "demo", *settings(workers=1), *shorter, "--out", str(run))
    return evaluated(run)
