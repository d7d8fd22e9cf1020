"""How many seconds of play executions of options take on ladders."""

from hypogoal.evaluation.house import per_run
from hypogoal.evaluation.page import Drawn
from hypogoal.evaluation.plots import plot, styled

TITLE = "How long options take"
STEPS = 15  # in a second: 60 frames, four a step
BY = ["method"]
PAIRED = ["seconds"]


def runs(results):
    """Of each run the mean member's seconds, from the steps that question 'distance' has put into the table."""
    numbers = results.numbers[results.numbers["ladder"] != ""]
    found = per_run(numbers, "duration", name="seconds")
    return found.assign(value=found["value"] / STEPS)


def figures(context):
    """A bar per method."""
    table = context["table"]
    with styled():
        figure, axes = plot(2)
        axes.barh(table["method"], table["mean"])
        axes.set_xlabel("seconds of an execution")
    yield Drawn("durations", TITLE, figure)
