"""The README's picture: what choosing and an ensemble are worth, point by point.

python -m studies.picture docs/results.png
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.axes import Axes

from studies.cells import read_rows

RESULTS = Path("docs/results")
INK, PALE = "#0b5394", "#9fc5e8"
WORLDS = {"fetch": "Fetch", "goto": "GoToObject"}
METHODS = (("independent", "ensemble", INK), ("one classifier", "one classifier", PALE))


def solved(name: str, chooser: str = "agent", **wanted: str) -> list[float]:
    """The share of episodes solved, of each row that fits."""
    rows = read_rows(RESULTS / name)
    wanted |= {"quantity": "success", "chooser": chooser}
    return [float(row["value"]) for row in rows if all(row[key] == value for key, value in wanted.items())]


def worse_task(world: str, method: str) -> list[float]:
    """The share solved in episodes 51 to 100, of the task in which it is lower, of each seed."""
    rows = read_rows(RESULTS / "misgeneralise.csv")
    own = [row for row in rows if (row["world"], row["method"]) == (world, method)]
    return [min(float(row["solved_51_100_colour"]), float(row["solved_51_100_shape"])) for row in own]


def draw(axes: Axes, columns: Sequence[tuple[str, list[float], str]]) -> None:
    """A column of points for each name, its mean as a line with the number beside it."""
    rng = np.random.default_rng(0)
    for place, (_name, values, colour) in enumerate(columns):
        axes.plot(place + rng.uniform(-0.18, 0.18, len(values)), values, "o", ms=4.5, color=colour, alpha=0.75, mew=0)
        mean = float(np.mean(values))
        axes.plot([place - 0.3, place + 0.3], [mean, mean], color="black", lw=1.6)
        axes.annotate(f"{mean:.2f}", (place + 0.33, mean), va="center", fontsize=9)
    axes.set_xticks(range(len(columns)), [name for name, _, _ in columns], fontsize=9)
    axes.set_xlim(-0.5, len(columns) - 0.2)
    axes.set_ylim(-0.03, 1.05)
    axes.spines[["top", "right"]].set_visible(False)


def main() -> None:
    """Draw it."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("out", type=Path, help="a .png file")
    figure, (left, right) = plt.subplots(1, 2, figsize=(9.6, 3.5), sharey=True, layout="constrained")
    levels = []
    for world, title in WORLDS.items():
        for method, name, colour in METHODS:
            levels.append((f"{title},\n{name}", worse_task(world, method), colour))
    draw(left, levels)
    left.set_title(
        "The labels fit colour and shape, the reward asks\nfor one: the ensemble decides (worse of both)", fontsize=10
    )
    left.set_ylabel("episodes solved")
    keys = "choosing-doorkey.csv"
    pairs = [
        (chooser, method, solved(keys, chooser, method=method, policy="learned"))
        for method in ("dbat", "one")
        for chooser in ("agent", "uniform")
    ]
    names = {"dbat": "D-BAT", "one": "one classifier"}
    who = {"agent": "agent", "uniform": "uniform-random\nchoice"}
    draw(
        right,
        [
            (f"{who[chooser]},\n{names[method]}", values, INK if chooser == "agent" else PALE)
            for chooser, method, values in pairs
        ],
    )
    right.set_title("A wrong key ends the episode:\nchoosing decides; the ensemble is undecided", fontsize=10)
    shown = [values for _, values, _ in levels] + [values for _, _, values in pairs]
    means = " ".join(f"{np.mean(values):.2f}" for values in shown)
    figure.savefig(parser.parse_args().out, dpi=150, metadata={"Description": means})


if __name__ == "__main__":
    main()
