"""A sweep of cells that take seconds, in a file of its own."""

from pathlib import Path

DATA = "collect doorkey --set heldout_layouts=1 --set unlabelled_seeds=1"
SMALL = "--set steps=6 --set members=2 --set sub_goals=open-red-door"


def write_toy(path: Path, seeds: str = "0-1", more: str = "") -> Path:
    """States, an ensemble for each seed, and whatever ``more`` says; ``path``."""
    path.write_text(
        f"""
format = 1
evaluate = false
axes = {{ seed = "{seeds}" }}

[[cells]]
name = "data"
command = "{DATA}"

[[cells]]
name = "ensemble"
axes = ["seed"]
command = "train-ensemble {{data}} --seed {{seed}} {SMALL}"
{more}"""
    )
    return path
