"""How many seconds of play executions of options take on ladders."""

from hypogoal.evaluation import page
from hypogoal.evaluation.page import Drawn, Question
from hypogoal.evaluation.plots import drawing
from hypogoal.evaluation.table import Number, Pairs, Table, select, tabulate

TITLE = "How long options take"
STEPS = 15  # in a second: 60 frames, four a step
SECONDS = Number("seconds", unit="seconds", higher=False)  # of each run the mean member
TABLE = Table({"method": "method"}, {"seconds": SECONDS})
COLUMNS = (page.label("method", "method"), page.number("seconds", "seconds", page.spread, 1))


def rows(work):
    """Of every member's option, from the steps that question 'distance' has put into the table."""
    for row in select(work.rows, quantity="duration", scope=""):
        yield row._replace(quantity="seconds", value=row.value / STEPS)


def figures(material):
    """A bar per method."""
    entries = material.metrics["durations"]
    with drawing(2, 1) as (figure, axes):
        axes.barh([entry["method"] for entry in entries], [entry["seconds"]["mean"] for entry in entries])
        axes.set_xlabel("seconds of an execution")
    return [
        Drawn("durations", TITLE, figure if entries else None, "Mean over options.", "It needs options on ladders.")
    ]


def sections(material):
    """Figure, table, and methods seed by seed."""
    drawn = [page.shown(material, figure) for figure in figures(material)]
    table = page.table(COLUMNS, material.metrics["durations"])
    pairs = page.comparison_tables(material.comparisons("durations"), "ladder and seed")
    return [page.section("durations", TITLE, [], [*drawn, table, *pairs])]


QUESTION = Question(
    rows=rows,
    view=lambda work: {"durations": tabulate(work.rows, TABLE)},
    pairs=Pairs("durations", {"seconds": SECONDS}),
    sections=sections,
    figures=figures,
    meanings={"seconds": ("seconds", "mean duration of an execution of an option")},
)
