"""Results of made-up runs, and their rows."""

from types import ModuleType
from typing import Any

import pandas as pd

from hypogoal.evaluation import page
from hypogoal.evaluation.questions import Context, Question, context_of
from hypogoal.evaluation.run import Results
from hypogoal.evaluation.table import joined

NOTHING: dict[str, Any] = {"agents": {}, "tasks": [], "cap": None, "missing": []}
LEARNED = {"members": 3, "choice": "learned"}


def numbers_of(*rows: dict[str, Any]) -> pd.DataFrame:
    """The table of numbers with these rows."""
    return joined([pd.DataFrame(rows)])


def row(quantity: str, value: float, **place: Any) -> dict[str, Any]:
    """A row."""
    return {"quantity": quantity, "value": value, **place}


def results_of(*rows: dict[str, Any], **facts: Any) -> Results:
    """Results with these rows; facts that are not given are of a run with nothing else."""
    return Results(numbers_of(*rows), NOTHING | facts)


def asked(question: ModuleType, results: Results) -> Context | None:
    """What a question's template is given."""
    return context_of(Question(question), results)


def shown(question: ModuleType, results: Results) -> pd.DataFrame:
    """The table that a terminal prints."""
    context = asked(question, results)
    assert context is not None
    return page.words_of(context).shown


def figures(question: ModuleType, results: Results) -> list[page.Drawn]:
    """A question's figures."""
    context = asked(question, results)
    return [] if context is None else context["figures"]
