"""Several evaluated runs side by side: whether they can be compared, what differs, and who wins."""

import os
from collections.abc import Iterator, Mapping, Sequence
from functools import partial
from operator import attrgetter

import pandas as pd
from pandas import DataFrame

from hypogoal.evaluation import curves
from hypogoal.evaluation.page import (
    DASH,
    Drawn,
    lines_of,
    listed,
    render,
)
from hypogoal.evaluation.provenance import domains_of, settings_of
from hypogoal.evaluation.questions import QUESTIONS, Context, Question, context_of
from hypogoal.evaluation.run import Results
from hypogoal.evaluation.statistics import pairs

Runs = Mapping[str, Results]  # results by a run's label
Shared = Mapping[Question, Mapping[str, Context]]  # contexts by question and run, see :func:`shared`
FIRST = 4  # lines that the page begins with


def labels_of(paths: Sequence[str]) -> list[str]:
    """Return short names of runs: their paths without the folder that all have in common."""
    common = os.path.commonpath([os.path.dirname(path) for path in paths])
    return [os.path.relpath(path, common) for path in paths]


def shared(runs: Runs) -> Shared:
    """Return the questions for which every run has results, and the contexts of each question, by the run's label."""
    questions = {}
    for question in filter(attrgetter("beside"), QUESTIONS):
        contexts = {}
        for label, results in runs.items():
            context = context_of(question, results)
            if context is not None:
                contexts[label] = context
        if len(contexts) == len(runs):
            questions[question] = contexts
    return questions


def of_runs(
    contexts: Mapping[str, Context],
    name: str,
) -> DataFrame:
    """Return the tables called ``name`` of all runs, one after another, with a column ``run``."""
    return pd.concat([context[name].assign(run=label) for label, context in contexts.items()])


def why_not(runs: Runs, questions: Shared) -> str | None:
    """Return why runs cannot be compared, in a few words, or None if they can.

    They must be of one domain, and have at least one kind of result in common.
    """
    domains = {label: ", ".join(domains_of(results)) for label, results in runs.items()}
    if len({*domains.values()}) > 1:
        each = "; ".join(map(": ".join, domains.items()))
        return f"they are of different domains ({each})"
    return None if questions else "they have no kind of result in common"


def differences(runs: Runs) -> DataFrame:
    """Return what differs, a column per run: settings by the kind of artefact, seeds, data and versions."""
    settings = [settings_of(results).assign(run=label) for label, results in runs.items()]
    cells = pd.concat(settings).sort_values("text").groupby(["of", "setting", "run"])
    by_run = cells["text"].agg(", ".join).unstack()[[*runs]].fillna(DASH)
    return by_run[by_run.nunique(axis=1) > 1].rename_axis(columns=None).reset_index()


def compare_runs(questions: Shared) -> DataFrame:
    """Return comparisons of the first run with each other, method by method, over the results that both have."""
    parts = []
    for contexts in questions.values():
        for method, alike in of_runs(contexts, "compared").groupby("method", sort=False):
            if alike["run"].nunique() == len(contexts):
                solved = alike.loc[alike["of"] == "success", "value"]
                if len(solved) and not solved.any():
                    alike = alike[alike["of"] != "length"]  # the limit, if nobody solved an episode
                both = pairs(alike.assign(method=alike["run"]))
                if not both.empty:  # runs that share a layout and a seed are paired
                    parts.append(both.assign(of=method))
    return pd.concat(parts) if parts else DataFrame(columns=["N", "quantity", "first", "second", "of"])


def winners(compared: DataFrame) -> list[str]:
    """Return a line for each row of :func:`compare_runs`: who wins by how much on what, if the interval says so."""
    rows = compared.astype(object).where(compared.notna(), None)
    return lines_of("winners.txt", pairs=rows.to_dict("records"))


def page_of(
    runs: Runs,
    questions: Shared,
    paths: Sequence[str],
) -> tuple[str, list[Drawn], dict[str, DataFrame]]:
    """Return the page of a comparison, its figures, and its tables by name."""
    tables = {
        "pairs": compare_runs(questions),
        "differences": differences(runs),
    }
    titles = {}
    for question, contexts in questions.items():
        titles[question.name] = question.module.TITLE
        rows = of_runs(contexts, "table")
        tables[question.name] = rows.sort_values(question.module.BY, kind="stable")
    figures = [*_curves(runs)]
    label, first = next(iter(runs.items()))
    section = {
        "name": "compared",
        "title": "What is compared",
        "folded": False,
        "paths": paths,
        "first": label,
        "results": first,
        "titles": titles,
        "tables": tables,
        "figures": [],
        "curves": figures,
    }
    page = render(
        "lines.html",
        title=f"hypogoal: {len(runs)} runs compared",
        sections=[section],
        about=listed(domains_of(first)),
        lines=winners(tables["pairs"])[:FIRST],
    )
    return page, figures, tables


def _curves(runs: Runs) -> Iterator[Drawn]:
    """Yield a figure for each method of which every run has a curve, a line per run."""
    points = [results.of(quantity=[*curves.FIGURES]).assign(run=label) for label, results in runs.items()]
    every = pd.concat(points).dropna(subset="step")
    for (name, quantity), drawn in every.groupby(["method", "quantity"]):
        if drawn["run"].nunique() == len(runs) and drawn["value"].nunique() > 1:
            _, label, _ = curves.FIGURES[str(quantity)]
            draw = partial(
                curves.learning_curves,
                drawn.assign(method=drawn["run"]),
                label,
            )
            yield Drawn(f"{quantity}-{name}", f"{name}: {label.lower()}", draw)
