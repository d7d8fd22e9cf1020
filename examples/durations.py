"""How many seconds of play executions of options take on ladders."""

import pandas as pd

from hypogoal.evaluation.house import over, pairs, per_run
from hypogoal.evaluation.page import Drawn, displayed, pairs_displayed, spread
from hypogoal.evaluation.plots import plot, styled

TITLE = "How long options take"
STEPS = 15  # in a second: 60 frames, four a step


def tables(results):
    """Of each run the mean member's seconds, from the steps that question 'distance' has put into the table."""
    numbers = results.numbers[results.numbers["ladder"] != ""]
    runs = per_run(numbers, "duration", name="seconds")
    runs = runs.assign(value=runs["value"] / STEPS)
    return {"durations": over(runs, ["method"]), "durations-pairs": pairs(runs)}


def context(results):
    """For the template: a table, and methods seed by seed."""
    if not results.facts["ladders"]:
        return None
    made = tables(results)
    table = displayed(made["durations"], {"method": "method"}, {"seconds": ("seconds", spread(1))})
    return {"table": table, "printed": table, "pairs": pairs_displayed(made["durations-pairs"], {})}


def figures(results):
    """A bar per method."""
    table: pd.DataFrame = tables(results)["durations"]
    if table.empty:
        return
    with styled():
        figure, axes = plot(2)
        axes.barh(table["method"], table["mean"])
        axes.set_xlabel("seconds of an execution")
    yield Drawn("durations", TITLE, figure)
