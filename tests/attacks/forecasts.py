"""Spec G1: the memory and time that ``train-ensemble`` forecasts, beside what it takes, over random data and settings.

``python -m tests.attacks.forecasts --cases 100`` prints a line a case, then how many were out by more than
``MAY_DIFFER``. Each trains in a process of its own, of which the most memory and the CPU time of a step are measured.
"""

import argparse
import multiprocessing
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

import numpy as np

from hypogoal.core.compute import prepare
from hypogoal.dataset import Collected, States, write_dataset
from hypogoal.hypotheses.config import TrainEnsembleConfig
from hypogoal.hypotheses.training import Watcher, fit
from hypogoal.needs import ensemble_needs

MAY_DIFFER = 1.5  # times
STEPS = 3
DIVERSITY = ("dbat", "divdis", "none")


def drawn(rng: np.random.Generator) -> tuple[tuple[int, ...], TrainEnsembleConfig]:
    """A shape of observations, and settings that take them."""
    if rng.random() < 0.2:
        shape: tuple[int, ...] = (int(rng.integers(1, 5000)),)
        network = "mlp"
    else:
        shape = (*(int(side) for side in rng.integers(41, 260, 2)), int(rng.integers(1, 5)))
        network = str(rng.choice(["doorkey", "montezuma", "tiles", "mlp"]))
    return shape, TrainEnsembleConfig(
        members=int(rng.integers(1, 5)),
        network=network,
        diversity=str(rng.choice(DIVERSITY)),
        schedule=str(rng.choice(["simultaneous", "sequential"])),
        batch_size=int(2 ** rng.uniform(1, 6.5)),
        steps=STEPS,
    )


def trained(states: np.ndarray[Any, Any], config: TrainEnsembleConfig, results: Any) -> None:
    """Put the peak memory of a process that trains on the states, and the CPU seconds of its last step."""
    prepare()
    half, ends = len(states) // 2, [0.0]
    labels = np.arange(half) % 2 == 0
    looks = range(config.steps * config.members + 1)
    fit(
        states[:half].copy(), labels, states[half:].copy(), config, 0,
        Watcher(look=lambda step, ensemble: ends.append(time.process_time()), look_at=looks),
    )  # fmt: skip
    status = Path("/proc/self/status").read_text(encoding="ascii")  # ru_maxrss has the parent's
    peak = next(float(line.split()[1]) * 1024 for line in status.splitlines() if line.startswith("VmHWM:"))
    results.put((peak, ends[STEPS] - ends[STEPS - 1]))


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--cases", type=int, default=20)
    parser.add_argument("--seed", type=int, default=0)
    arguments = parser.parse_args()
    prepare()
    spawn, out = multiprocessing.get_context("spawn"), np.zeros(2, int)
    for case in range(arguments.cases):
        rng = np.random.default_rng((arguments.seed, case))
        shape, config = drawn(rng)
        states = rng.integers(0, 256, (24, *shape)).astype(np.uint8 if len(shape) == 3 else np.float32)
        with tempfile.TemporaryDirectory() as folder:
            data = Path(folder) / "data.h5"
            split = States(states[:12], np.arange(12)[:, None] % 2 == 0)
            collected = Collected(shape, ("goal",), split, States(states[12:], split.labels[:, :0]), split)
            write_dataset(data, collected, domain="imported", config={}, seed=0)
            needs = ensemble_needs(data, [data], config, 1, 1, "cpu")
        results = spawn.Queue()
        process = spawn.Process(target=trained, args=(states, config, results))
        process.start()
        taken = results.get()
        process.join()
        ratios = np.array([needs.memory, needs.seconds]) / taken
        out += np.abs(np.log(ratios)) > np.log(MAY_DIFFER)
        settings = f"{config.network} x {config.members}, {config.schedule}, {config.diversity}"
        line = (
            f"{case} {shape} {settings}, batch {config.batch_size}: {needs.memory / 1e6:.0f} MB, {needs.seconds:.3f} s"
        )
        print(f"{line}; taken {taken[0] / 1e6:.0f} MB, {taken[1]:.3f} s; {ratios.round(2)}", flush=True)
    print(f"of {arguments.cases} out by more than {MAY_DIFFER} times: memory {out[0]}, time {out[1]}")
    return int(out[0] > 0)


if __name__ == "__main__":
    sys.exit(main())
