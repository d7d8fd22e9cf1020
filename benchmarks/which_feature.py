"""The leaderboard of WhichFeature: each objective's weight by one rule, and the tables of docs/results/which-feature.md.

    python -m benchmarks.which_feature --grid     every objective at every weight, for hypogoal benchmark --diversity
    python -m benchmarks.which_feature --gather runs/which-choice/results.csv ...   cells of the benchmark into the CSV
    python -m benchmarks.which_feature --chosen   the entries at the weights that the rule chose
    python -m benchmarks.which_feature            the tables, as Markdown
"""

from __future__ import annotations

import argparse
from pathlib import Path

WEIGHTS = (1.0, 0.1, 0.01, 0.001, 0.0001)
OBJECTIVES = (  # in the order in which they are run
    "dbat", "divdis", "mutual-information", "ace", "repulsive", "hsic", "dbat-unpaired", "say-no", "input-gradients",
)  # fmt: skip
UNWEIGHTED = ("none", "cnn", "oracle")
CSV = Path(__file__).resolve().parents[1] / "docs" / "results" / "which-feature.csv"


def grid() -> list[str]:
    """Every objective at every weight."""
    return [f"{objective}:{weight:g}" for objective in OBJECTIVES for weight in WEIGHTS]


def main() -> None:
    """Print or gather."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--grid", action="store_true", help="print every objective at every weight")
    arguments = parser.parse_args()
    if arguments.grid:
        print(",".join(grid()))


if __name__ == "__main__":
    main()
