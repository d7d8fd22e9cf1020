"""How many seconds of play executions of options take on ladders."""

from functools import partial

from hypogoal.evaluation.page import Drawn
from hypogoal.evaluation.plots import plot
from hypogoal.evaluation.statistics import tables_of
from hypogoal.evaluation.table import per_run

TITLE = "How long options take"
STEPS = 15  # in a second: 60 frames, four a step


def context(results):
    """Of each run the mean member's seconds, from the steps that question 'distance' has put into the table."""
    numbers = results.numbers[results.numbers["ladder"] != ""]
    runs = per_run(numbers, "duration", name="seconds")
    tables = tables_of(runs.assign(value=runs["value"] / STEPS), ["method"], ["seconds"])
    if not tables:
        return {}
    figure = Drawn("durations", TITLE, partial(bars_of, tables["table"]))
    return tables | {"figures": [figure]}


def bars_of(table):
    """A bar per method."""
    figure, axes = plot(2)
    axes.barh(table["method"], table["mean"])
    axes.set_xlabel("seconds of an execution")
    return figure
