"""Compute each bold number of the results pages, and README's table and picture, a second way: from the cells alone.

    python -m studies.recompute

It reads the cells with pandas, takes nothing from the package or from other studies, and prints one line for each
number that is off by more than its last digit. The numbers of a page are in the order in which they stand there.
"""

from __future__ import annotations

import re
import sys
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from PIL import Image
from scipy import stats

ROOT = Path(__file__).resolve().parents[1]
CELLS = ROOT / "docs/results"
RESAMPLES = 40_000
BOLD = re.compile(r"\*\*(.+?)\*\*", re.DOTALL)
NO_NUMBER = re.compile(r"`[^`]*`|\]\([^)]*\)|\b\d+-\d+\b")  # code, links, ladders
NUMBER = re.compile(r"(?<![\w.-])-?(?:\d[\d,]*(?:\.\d+)?|\.\d+)|never(?=\])")
ELSEWHERE = "## How many episodes choosing takes"  # this section's numbers are counts of its table
Found = list[float]


def score(values: Any) -> Found:
    """The mean and the bootstrap's interval of Student's t."""
    numbers = np.asarray(values, float)
    n, mean, error = len(numbers), numbers.mean(), stats.sem(numbers)
    drawn = np.random.default_rng(1).choice(numbers, (RESAMPLES, n))
    errors = stats.sem(drawn, axis=1)
    ratios = ((drawn.mean(axis=1) - mean) / np.where(errors > 1e-9, errors, np.nan)) * error
    low, high = np.nanpercentile(ratios, [2.5, 97.5])
    return [mean, mean - high, mean - low]


def share(values: Any) -> Found:
    """The mean and Gaffke's bounds, by the gaps between sorted even numbers."""
    numbers = np.sort(np.asarray(values, float))
    even = np.sort(np.random.default_rng(1).random((RESAMPLES, len(numbers))), axis=1)
    gaps = np.diff(even, axis=1, prepend=0, append=1)
    low = np.percentile(gaps[:, 1:] @ numbers, 2.5)
    high = np.percentile(gaps @ np.append(numbers, 1), 97.5)
    return [numbers.mean(), low, high]


def median(values: Any) -> Found:
    """The median, and the two values between which it lies in 95 of 100 cases."""
    numbers = sorted(values)
    n = len(numbers)
    cut = max(k for k in range(n // 2) if k == 0 or stats.binom.cdf(k - 1, n, 0.5) < 0.025)
    return [float(np.median(numbers)), numbers[cut - 1], numbers[n - cut]]


def spread(values: Any) -> Found:
    """The mean, the lowest and the highest."""
    numbers = np.asarray(values, float)
    return [numbers.mean(), numbers.min(), numbers.max()]


def cells(name: str) -> pd.DataFrame:
    """The rows of a CSV."""
    return pd.read_csv(CELLS / f"{name}.csv")


def by_unit(rows: pd.DataFrame, unit: str, value: str = "value", method: str = "method") -> pd.DataFrame:
    """A row for each seed or layout, a column for each method."""
    return rows.pivot(index=unit, columns=method, values=value)


def crossed(members: pd.DataFrame, name: str, pick: str) -> float:
    """The mean over both halves of the member that is best on the other half."""
    on_second = members[f"{name}_second"].iloc[members[f"{pick}_first"].argmax()]
    on_first = members[f"{name}_first"].iloc[members[f"{pick}_second"].argmax()]
    return float(on_first + on_second) / 2


def doorkey() -> tuple[pd.DataFrame, pd.DataFrame]:
    """Rankings and accuracies of the cross-fitted member, a row for each seed and sub-goal."""
    rows = cells("hypotheses-doorkey")
    lengths = {"dbat": 150, "none": 300, "dbat-unpaired": 100, "cnn": 300}
    rows = rows[(rows["layouts"] == "test") & (rows["step"] == rows["method"].map(lengths))]
    grouped = rows.groupby(["method", "seed", "sub_goal"])
    rankings = grouped.apply(crossed, "ranking", "ranking")
    accuracies = grouped.apply(crossed, "balanced_accuracy", "balanced_accuracy")
    return rankings.unstack("method"), accuracies.unstack("method")


def ladders() -> tuple[pd.DataFrame, pd.DataFrame, pd.DataFrame]:
    """From one group, by seed: the picked member's ranking, the mean member's, the best accuracy in all rooms."""
    rows = cells("figure3-ladders")
    rows = rows[rows["groups"] == 1]
    picked, mean, best = {}, {}, {}
    for method, own in rows.groupby("method"):
        at = {half: _length(own, half) for half in ("first", "second")}
        for seed, looks in own.groupby("seed"):
            scores, means, accuracies = [], [], []
            for pick, judge in (("first", "second"), ("second", "first")):
                members = looks[looks["step"] == at[pick]]
                scores.append(members[f"ranking_{judge}"].iloc[members[f"ranking_{pick}"].argmax()])
                means.append(members[f"ranking_{judge}"].mean())
                accuracies.append(members["balanced_accuracy_all"].max())
            place = (seed, method)
            picked[place], mean[place], best[place] = np.mean(scores), np.mean(means), np.mean(accuracies)
    by_seed = [pd.Series(numbers).unstack() for numbers in (picked, mean, best)]
    return by_seed[0], by_seed[1], by_seed[2]


def _length(own: pd.DataFrame, half: str) -> Any:
    of_seeds = own.groupby(["step", "seed"])[f"ranking_{half}"].max()
    return of_seeds.groupby("step").mean().idxmax()


def nearer(measure: str) -> pd.DataFrame:
    """How much farther others stop than D-BAT, from one group, by ensemble: the best member, mean over ladders."""
    rows = cells("figure4-ladders")
    new = ("2-6", "3-9", "14-22", "0-4", "5-11", "7-13")
    rows = rows[(rows["groups"] == 1) & rows["ladder"].isin(new)].dropna(subset=[measure])
    best = rows.groupby(["seed", "ladder", "method"])[measure].min().unstack()
    means = best.groupby("seed").mean()
    return means.rsub(means["dbat"], axis=0) * -1


def zero_shot(method: str) -> pd.Series:
    """By seed the share within twice the shortest path on new layouts, of the member that is best where it learned."""
    rows = cells("distilled")
    rows = rows[(rows["method"] == method) & (rows["step"] == 1)]
    shares = rows.pivot(index=["seed", "sub_goal", "member"], columns="layouts", values="within_2")
    best = shares.groupby(["seed", "sub_goal"])["trained"].idxmax()
    return shares.loc[best, "new"].groupby("seed").mean()


def played(name: str, chooser: str = "agent", quantity: str = "success", **wanted: str) -> pd.DataFrame:
    """A number of agents, a row for each layout."""
    rows = cells(name)
    rows = rows[(rows["chooser"] == chooser) & (rows["quantity"] == quantity)]
    for column, value in wanted.items():
        rows = rows[rows[column] == value]
    return by_unit(rows, "layout")


def in_rooms(truth: str) -> pd.DataFrame:
    """What agents solve in the four runs, a row for each of forty seeds."""
    runs = [played(f"rooms{run}") for run in ("-joint", "", "-second", "-first")]
    both = pd.concat(runs, keys=range(len(runs)))
    of_truth = both.filter(like=truth)
    return of_truth.rename(columns=lambda name: name.removesuffix(f"-truth-{truth}"))


def within_2(world: str, column: str = "within_2") -> pd.Series:
    """Of agents over distilled options, by seed."""
    rows = cells("distilled-agents")
    return rows[(rows["world"] == world) & (rows["options"] == "distilled")][column].dropna()
