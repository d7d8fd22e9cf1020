"""How near a step is to the limit of its arithmetic, in one run, one thread.

    python -m benchmarks.limits [--short] [--json PATH]

The limit is a product of two float32 matrices of 1,024 rows, as fast as this machine does it now. A step's operations
are those of its convolutions and matrix products, counted by PyTorch: what is looked up instead costs none.
"""

from __future__ import annotations

import statistics
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

from benchmarks import timing

timing.alone()

import torch  # noqa: E402
from torch.utils.flop_counter import FlopCounterMode  # noqa: E402

from benchmarks.options import config_of, played, update  # noqa: E402
from benchmarks.training import states  # noqa: E402
from hypogoal.core.processes import prepare  # noqa: E402
from hypogoal.domains.find import settings_of  # noqa: E402
from hypogoal.hypotheses.config import TrainEnsembleConfig  # noqa: E402
from hypogoal.hypotheses.training import EnsembleTraining  # noqa: E402

ROWS = 1_024
MEMBERS = 6  # of an ensemble
OPTIONS = 15


def fastest(repeats: int) -> float:
    """Operations a second in a product of matrices."""
    matrix = torch.rand(ROWS, ROWS)
    seconds = [timing.cpu_seconds(lambda: matrix @ matrix) for _ in range(5 * repeats)]
    return 2 * ROWS**3 / statistics.median(seconds)


def measured(work: Callable[[], object], repeats: int) -> tuple[float, int]:
    """CPU seconds of a step, and its operations."""
    work()
    with FlopCounterMode(display=False) as counter:
        work()
    seconds = [timing.cpu_seconds(work) for _ in range(repeats)]
    return statistics.median(seconds), counter.get_total_flops()


def ensemble_step(domain: str, folder: Path) -> Callable[[], object]:
    """A step of an ensemble's training."""
    split, unlabelled = states(domain, folder)
    chosen = settings_of(TrainEnsembleConfig, "train-ensemble", domain, typed={"members": MEMBERS, "steps": 1_000})
    config = chosen.training(float(chosen.diversity_weight), "labels")
    steps = EnsembleTraining(split.observations, split.labels, unlabelled, config, 0).steps()
    return lambda: next(steps)


def option_update(options: int, steps: int, preset: str | None = None) -> Callable[[], object]:
    """An update of option policies, after ``steps`` of random play."""
    loop = played(config_of("warm_up=100", preset=preset), options, steps)
    return lambda: update(loop)


def main() -> None:
    """Measure, print, write."""
    given = timing.arguments(__doc__, "limits")
    repeats = 3 if given.short else 20
    prepare()
    about = timing.machine("torch", "numpy")
    rows: list[dict[str, Any]] = []
    with tempfile.TemporaryDirectory() as name:
        works = {
            f"ensemble step, DoorKey, K={MEMBERS}": ensemble_step("doorkey", Path(name)),
            f"ensemble step, Montezuma, K={MEMBERS}": ensemble_step("montezuma", Path(name)),
            "update of the paper's option network": option_update(1, 2_000, "paper"),
            f"light update, {OPTIONS} members": option_update(OPTIONS, 4_000),
        }
        for title, work in works.items():
            seconds, operations = measured(work, repeats)
            limit = operations / fastest(repeats)
            rows.append({"name": title, "seconds": seconds, "operations": operations, "reached": limit / seconds})
    print(f"\n{'':44}{'a step':>12}{'of the limit':>14}")
    for row in rows:
        print(f"{row['name']:44}{1e3 * row['seconds']:9.3g} ms{row['reached']:14.0%}")
    timing.write(given.json, about, {"results": rows, "repeats": repeats})


if __name__ == "__main__":
    main()
