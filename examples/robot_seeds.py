"""What the audit's list is worth against random frames, over seeds: the table of docs/results/audit.md.

    python robot_seeds.py robot.csv 11 12 13 14 15

In runs/robot; rows ``audited`` and ``random`` say of 20 labelled frames how many are false positives and successes;
``first``, ``second`` and ``second-random`` how often a classifier is fooled, there, and never positive.
"""

import csv
import sys
from pathlib import Path

from robot_bin import GOAL, answer, judge, record

from hypogoal.cli import main

LIKE = [f"--set={words}" for words in ("steps=150", "learning_rate=1e-3", "members=1", "diversity=none")]
COLUMNS = ("seed", "name", "member", "false_positives", "successes", "never")


def learn(labels: Path, source: Path, data: Path, ensemble: Path, seed: int) -> None:
    """Data with more labels, and a classifier of them."""
    if main(["import", str(source), f"--label={GOAL}={labels}", "--out", str(data)]) or main(
        ["train-ensemble", str(data), "--seed", str(seed), "--out", str(ensemble), *LIKE]
    ):
        sys.exit(2)


def rows_of(seed: int, folder: Path) -> list[list]:
    """The rows of one seed, made in a folder."""
    takes, rows = folder / "takes", []
    record(takes, seed)
    learn(takes / "labels.csv", takes, folder / "data.h5", folder / "first", seed)
    if main(["audit", str(folder / "first"), "--out", str(folder / "audit")]):
        sys.exit(2)
    for name, ensemble, random in (("audited", "second", None), ("random", "second-random", seed)):
        labels = folder / f"{name}.csv"
        wrong, successes = answer(folder / "audit", takes, labels, random=random)
        rows += [[seed, name, member, count, successes, ""] for member, count in enumerate(wrong)]
        learn(labels, folder / "data.h5", folder / f"{name}.h5", folder / ensemble, seed)
    for name, members in judge([folder / name for name in ("first", "second", "second-random")], seed).items():
        rows += [[seed, name, member, *counts] for member, counts in enumerate(members)]
    return rows


if __name__ == "__main__":
    with Path(sys.argv[1]).open("w", newline="") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(COLUMNS)
        for seed in map(int, sys.argv[2:]):
            writer.writerows(rows_of(seed, Path(f"runs/robot/{seed}")))
            file.flush()
