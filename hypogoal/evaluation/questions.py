"""Which questions of the paper an evaluation answers: a new one is a file of its own, its template, and a line here.

A question is a module with ``TITLE`` and any of:

- ``look(work, judgement)`` and ``rows(work)``: its numbers, rows of the table (DataFrames); ``facts(work)``: what else
  it needs to know, by name; ``missing(work)``: lines about what the run has no artefacts for. :class:`judging.Work`
  and :class:`judging.Judgement` say what these are.
- ``runs(results)``, of :class:`page.Results`: each run's numbers, of :func:`house.per_run`. Its table is over these by
  the columns ``BY``, and quantities that are ``PAIRED`` are compared, of ``compared(results)`` where these are other
  runs.
- ``context(results)``: what else its template needs, by name; None where the run has nothing of it.
- ``figures(context)``, of what the template is given: :class:`page.Drawn` ones.

Its template gets ``results``, ``table``, ``pairs`` and ``figures``, and sets ``shown``, what a terminal prints.
"""

from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path
from types import ModuleType
from typing import Any

import pandas as pd
from rich.console import Group
from rich.table import Table

from hypogoal.evaluation import (
    choosing,
    curves,
    distance,
    exploits,
    house,
    hypotheses,
    judging,
    page,
    provenance,
    rooms,
    saliency,
    selection,
    verdict,
    zero_shot,
)
from hypogoal.evaluation.page import Drawn, Results
from hypogoal.evaluation.run import FORMAT

Context = dict[str, Any]  # what a question's template is given
QUESTIONS: list[ModuleType] = [  # in the order of the page
    curves,
    rooms,
    distance,
    exploits,
    hypotheses,
    saliency,
    selection,
    choosing,
    zero_shot,
]
FOLDED = (exploits, saliency, selection, provenance)  # until asked for


def answers(results: Results, *, drawn: bool = False) -> list[Context]:
    """Of every question that the run has something of, in the order of the page; with its figures if ``drawn``."""
    every = []
    for question in (*QUESTIONS, provenance):
        context = context_of(question, results)
        if context is None:
            continue
        if drawn and hasattr(question, "figures"):
            context["figures"] = list(question.figures(context))
        every.append(context)
    return every


def context_of(question: ModuleType, results: Results) -> Context | None:
    """A question's numbers, without its figures; None where the run has nothing of it."""
    context = {
        "name": name_of(question),
        "title": question.TITLE,
        "folded": question in FOLDED,
        "results": results,
        "table": pd.DataFrame(),
        "pairs": pd.DataFrame(),
        "figures": [],
    }
    if hasattr(question, "runs"):
        runs = question.runs(results)
        if runs.empty:
            return None
        context["table"] = house.over(runs, question.BY)
        if hasattr(question, "PAIRED"):
            context["pairs"] = house.pairs(paired_runs(question, results, runs))
    if not hasattr(question, "context"):
        return context
    more = question.context(results)
    return None if more is None else context | more


def paired_runs(
    question: ModuleType,
    results: Results,
    runs: pd.DataFrame,
) -> pd.DataFrame:
    """Each run's numbers that are compared."""
    every = question.compared(results) if hasattr(question, "compared") else runs
    return every[every["quantity"].isin(question.PAIRED)]


def name_of(question: ModuleType) -> str:
    """What its template, its table and its section are called."""
    return question.__name__.rpartition(".")[-1].replace("_", "-")


def asked(name: str) -> Iterator[Any]:
    """This part of every question that has it."""
    for question in (*QUESTIONS, verdict):
        if hasattr(question, name):
            yield getattr(question, name)


def answer(work: judging.Work, settings: Mapping[str, Any]) -> Results:
    """Every number of a run, and what else its page needs: ensembles are judged, then all questions asked."""
    parts: list[pd.DataFrame] = []
    for judgement in judging.judgements(work.cases(), work.progress.advance):
        for look in asked("look"):
            parts += look(work, judgement)
        work.progress.advance()
    for rows in asked("rows"):
        parts += rows(work)
    facts = {
        "format": FORMAT,
        "run": work.contents.run.resolve().name,
        "settings": settings,
        "provenance": provenance.provenance(work.contents),
        "missing": [] if work.contents.ensembles else ["no ensemble"],
    }
    for facts_of in asked("facts"):
        facts |= facts_of(work)
    for missing in asked("missing"):
        facts["missing"] += missing(work)
    return Results(house.joined(parts), facts | work.facts)


def write(folder: Path, results: Results, every: list[Context]) -> None:
    """Write ``numbers.csv``, ``run.json`` and, of :func:`answers`, ``tables/*.csv``."""
    results.numbers.to_csv(folder / "numbers.csv", index=False)
    (folder / "run.json").write_text(house.as_json(results.facts) + "\n", encoding="utf-8")
    tables = {"verdict": pd.DataFrame(verdict.findings(results))}
    for context in every:
        tables[context["name"]] = context["table"]
        tables[f"{context['name']}-pairs"] = context["pairs"]
    (folder / "tables").mkdir()
    for name, table in tables.items():
        if not table.empty:
            table.to_csv(folder / "tables" / f"{name}.csv", index=False)


def summary(results: Results, every: list[Context]) -> Group:
    """The headline numbers of a run, mean over seeds, and the verdict; at most 80 columns wide; agents last."""
    tables: list[Any] = []
    for context in every:
        words = page.module(context["name"], context)
        shown = getattr(words, "shown", pd.DataFrame())
        if not shown.empty:
            tables.append(page.terminal(context["title"], shown))
    lines = Table.grid()
    lines.width = page.WIDTH
    if results.facts["missing"]:
        lines.add_row(f"In this run: {'; '.join(results.facts['missing'])}.")
    for sentence in sentences(results):
        lines.add_row(sentence)
    return Group(*tables, lines)


def sentences(results: Results) -> list[str]:
    """The verdict, a sentence a line."""
    return page.lines_of("verdict.txt", verdict.context(results))


def render(results: Results, every: list[Context], films: Iterable[Mapping[str, str]]) -> str:
    """Spec F7: the page of a run, self-contained, with the figures of drawn :func:`answers`."""
    sections = sorted(every, key=lambda context: context["folded"])  # what is open comes first
    lead = verdict.context(results)
    lead |= {"sentences": sentences(results), "films": films, "domains": provenance.domains_of(results)}
    return page.draw_page(f"hypogoal: {results.facts['run']}", sections, "run.html", **lead)


def captions(every: Iterable[Context]) -> dict[str, tuple[Drawn, str]]:
    """Figures and their captions, by their names."""
    by_name = {}
    for context in every:
        words = page.module(context["name"], context | {"figures": []})
        for figure in context["figures"]:
            caption = words.caption(figure).unescape()
            by_name[figure.name] = figure, " ".join(caption.split())
    return by_name


def not_drawn(names: Iterable[str]) -> list[str]:
    """A line for each of the paper's Figures 2 to 9 that is not among a run's figures."""
    return page.lines_of("needed.txt", {"drawn": [name.partition("-")[0] for name in names]})
