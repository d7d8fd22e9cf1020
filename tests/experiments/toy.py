"""An experiment of cells that take seconds, in a file of its own."""

from pathlib import Path

DATA = "collect rooms --set labelled=64 --set unlabelled=128"
SMALL = "--set steps=20 --set members=2 --set diversity_weight=1e-4 --set restarts=1"
PLAY = "--layout-seed 990 --set steps=200"


def write_toy(path: Path, seeds: str = "0-1", more: str = "", *, evaluate: bool = False) -> Path:
    """States, an ensemble and an agent for each seed, and whatever ``more`` says; ``path``."""
    path.write_text(
        f"""
format = 1
evaluate = {str(evaluate).lower()}
axes = {{ seed = "{seeds}" }}

[[cells]]
name = "data"
command = "{DATA}"

[[cells]]
name = "ensemble"
axes = ["seed"]
command = "train-ensemble {{data}} --seed {{seed}} {SMALL}"

[[cells]]
name = "agent"
axes = ["seed"]
command = "train-meta {{ensemble}} --seed {{seed}} {PLAY}"
{more}"""
    )
    return path
