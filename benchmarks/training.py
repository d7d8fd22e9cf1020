"""One step of ensemble training against a plain loop over the members, in one run, one thread.

    python -m benchmarks.training [--short] [--json PATH]

The plain loop is the formulation of the authors' public code, written anew: each member by itself, float32 NCHW,
labelled and unlabelled states in two passes, the disagreement of each ordered pair, Adam for each member. Both train
the paper's networks on the same real states, 64 labelled and 64 unlabelled a step.
"""

from __future__ import annotations

import contextlib
import io
import statistics
import tempfile
import time
from itertools import permutations
from pathlib import Path
from typing import Any

from benchmarks import timing

timing.alone()

import numpy as np  # noqa: E402
import torch  # noqa: E402
from torch.nn import functional  # noqa: E402

from hypogoal.core.processes import prepare  # noqa: E402
from hypogoal.data import States, open_dataset  # noqa: E402
from hypogoal.diversity.dbat import pair_loss  # noqa: E402
from hypogoal.domains.find import settings_of  # noqa: E402
from hypogoal.hypotheses.config import EnsembleConfig, TrainEnsembleConfig  # noqa: E402
from hypogoal.hypotheses.networks import build_network, network_for  # noqa: E402
from hypogoal.hypotheses.training import EnsembleTraining  # noqa: E402

WANTED = {"doorkey": {"hypogoal": 4.0}, "montezuma": {"hypogoal": 2.5}}
SUB_GOAL = {"doorkey": "open-red-door", "montezuma": "climb-down-ladder"}
COLLECT = {
    "doorkey": ("heldout_layouts=1",),
    "montezuma": ("groups=1", "states_per_room=400", "unlabelled_per_room=400", "heldout_per_room=6", "workers=1"),
}


def states(domain: str, folder: Path) -> tuple[States, np.ndarray]:
    """Real states, collected by the tool."""
    from hypogoal.cli import main

    path = folder / f"{domain}.h5"
    changes = [part for pair in COLLECT[domain] for part in ("--set", pair)]
    with contextlib.redirect_stdout(io.StringIO()):
        if main(["collect", domain, "--out", str(path), *changes, "-q"]):
            raise SystemExit("nothing to train on")
    data = open_dataset(path)
    return data.labelled(SUB_GOAL[domain]), data.unlabelled()


def plain(split: States, unlabelled: np.ndarray, config: EnsembleConfig, steps: int) -> float:
    """Seconds of a step of the plain loop."""
    generator = torch.Generator().manual_seed(0)
    shape = split.observations.shape[1:]
    name = network_for(config.network, shape, split.observations.dtype)
    members = [build_network(name, shape, generator).train() for _ in range(config.members)]
    adam = [
        torch.optim.Adam(member.parameters(), lr=config.learning_rate, weight_decay=config.l2_weight)
        for member in members
    ]
    weights = torch.tensor([config.class_weight_negative, config.class_weight_positive])
    rng = np.random.default_rng(0)

    def batch(images: np.ndarray, chosen: np.ndarray) -> torch.Tensor:
        return torch.from_numpy(np.ascontiguousarray(images[chosen].transpose(0, 3, 1, 2))).float() / 255.0

    times = []
    for _ in range(steps + 1):
        begin = time.process_time()
        chosen = rng.integers(len(split.labels), size=config.batch_size)
        x, y = batch(split.observations, chosen), torch.from_numpy(split.labels[chosen].astype(np.int64))
        z = batch(unlabelled, rng.integers(len(unlabelled), size=config.batch_size))
        loss = sum(functional.cross_entropy(member(x), y, weights) for member in members)
        others = [member(z) for member in members]
        for one, other in permutations(others, 2):
            loss = loss + config.diversity_weight * pair_loss(one, other)
        for each in adam:
            each.zero_grad()
        loss.backward()  # type: ignore[union-attr]
        for each in adam:
            each.step()
        times.append(time.process_time() - begin)
    return statistics.median(times[1:])


def ours(split: States, unlabelled: np.ndarray, config: EnsembleConfig) -> float:
    """Seconds of a step of a training, the first left out."""
    training = EnsembleTraining(split.observations, split.labels, unlabelled, config, 0)
    times = [time.process_time() for _ in training.steps()]
    return statistics.median(np.diff(times))


def compared(split: States, unlabelled: np.ndarray, domain: str, members: int, steps: int, repeats: int) -> Any:
    """All ways, in turn."""
    chosen = settings_of(TrainEnsembleConfig, "train-ensemble", domain, typed={"members": members, "steps": steps + 1})
    config = chosen.training(float(chosen.diversity_weight), "labels")
    candidates = {
        "plain loop": lambda: plain(split, unlabelled, config, steps),
        "hypogoal": lambda: ours(split, unlabelled, config),
    }
    return timing.rows_of(timing.alternated(candidates, repeats), "plain loop", WANTED[domain])


def main() -> None:
    """Measure, print, write."""
    given = timing.arguments(__doc__, "training")
    repeats, steps = (1, 4) if given.short else (5, 12)
    prepare()
    about = timing.machine("torch", "numpy")
    results: dict[str, Any] = {"repeats": repeats, "steps": steps}
    with tempfile.TemporaryDirectory() as folder:
        for domain in WANTED if not given.short else ("doorkey",):
            split, unlabelled = states(domain, Path(folder))
            for members in (3, 6):
                rows = compared(split, unlabelled, domain, members, steps, repeats)
                timing.show(f"\n{domain}, K={members}, 64 + 64 states: a step", rows)
                results[f"{domain}-{members}"] = rows
    timing.write(given.json, about, results)


if __name__ == "__main__":
    main()
