"""Results of made-up runs, and their rows."""

from typing import Any

import pandas as pd

from hypogoal.evaluation.house import joined
from hypogoal.evaluation.page import Results

NOTHING: dict[str, Any] = {
    "agents": {},
    "ladders": [],
    "stops": [],
    "tasks": [],
    "caps": [],
    "cap": None,
    "missing": [],
    "is_papers": False,
}
LEARNED = {"kind": "meta", "members": 3, "chooser": "ppo", "termination": "learned", "layouts": ""}


def numbers_of(*rows: dict[str, Any]) -> pd.DataFrame:
    """The table of numbers with these rows."""
    return joined([pd.DataFrame(rows)])


def row(quantity: str, value: float, **place: Any) -> dict[str, Any]:
    """A row."""
    return {"quantity": quantity, "value": value, **place}


def results_of(*rows: dict[str, Any], **facts: Any) -> Results:
    """Results with these rows; facts that are not given are of a run with nothing else."""
    return Results(numbers_of(*rows), NOTHING | facts)
