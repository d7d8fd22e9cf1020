"""Which questions of the paper an evaluation answers: a new one is a file of its own, its template, and a line here.

A question is a module with ``TITLE`` and ``context(results)``, of :class:`page.Results`: by name what its template
needs, nothing where the run has nothing of it. These names are known here:

- ``table``: each run's numbers, of :func:`house.per_run`, over which :func:`house.over` goes; written as a file.
- ``compared``: those of each run's numbers whose pairs, ``pairs``, its table of pairs has.
- ``figures``: :class:`page.Drawn` ones, of which its template's macro ``caption`` says what they show.

Its template sets ``shown``, what a terminal prints, unless it is ``FOLDED``. What puts numbers of its own into the
table is named in ``LOOKS`` or ``ROWS``.
"""

from collections.abc import Iterable, Mapping
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
    undecided,
    verdict,
    zero_shot,
)
from hypogoal.evaluation.page import Results
from hypogoal.evaluation.run import FORMAT

Context = dict[str, Any]  # what a question's template is given
QUESTIONS = [  # in the order of the page
    curves,
    rooms,
    distance,
    exploits,
    hypotheses,
    saliency,
    selection,
    choosing,
    zero_shot,
    provenance,
]
FOLDED = (exploits, saliency, selection, provenance)  # until asked for
LOOKS = (hypotheses.look, saliency.look)  # rows (DataFrames) of :class:`judging.Work` and :class:`judging.Judgement`
ROWS = (curves.rows, distance.rows, exploits.rows, selection.rows, choosing.rows, zero_shot.rows)  # of ``Work`` alone


def answers(results: Results) -> list[Context]:
    """Of every question that the run has something of, in the order of the page."""
    contexts = [context_of(question, results) for question in QUESTIONS]
    return [context for context in contexts if context]


def context_of(question: ModuleType, results: Results) -> Context | None:
    """What a question's template is given; None where the run has nothing of it."""
    parts = question.context(results)
    if not parts:
        return None
    compared = parts.get("compared", pd.DataFrame())
    return {
        "name": name_of(question),
        "title": question.TITLE,
        "folded": question in FOLDED,
        "results": results,
        "table": pd.DataFrame(),
        "pairs": compared if compared.empty else house.pairs(compared),
        "figures": [],
        **parts,
    }


def name_of(question: ModuleType) -> str:
    """What its template, its table and its section are called."""
    return question.__name__.rpartition(".")[-1].replace("_", "-")


def answer(work: judging.Work, settings: Mapping[str, Any]) -> Results:
    """Every number of a run, and what else its page needs: ensembles are judged, then all questions asked."""
    parts: list[pd.DataFrame] = []
    for judgement in work.judgements():
        for look in LOOKS:
            parts += look(work, judgement)
        work.progress.advance()
    for rows in ROWS:
        parts += rows(work)
    numbers = house.joined(parts)
    missing = [] if work.contents.ensembles else ["no ensemble"]
    facts = {
        "format": FORMAT,
        "run": work.contents.run.resolve().name,
        "settings": settings,
        "provenance": provenance.provenance(work.contents),
        "missing": missing + selection.missing(work),
        **curves.facts(work),
        **verdict.facts(work),
        **undecided.facts(work, numbers),
        **work.facts,
    }
    return Results(numbers, facts)


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


def summary(results: Results, every: list[Context]) -> list[str]:
    """The headline numbers of a run, mean over seeds, and the verdict; at most 80 columns wide; agents last."""
    domains = ", ".join(provenance.domains_of(results))
    tables = []
    for context in every:
        if context["folded"]:
            continue
        shown = page.words_of(context).shown
        if not shown.empty:  # such as the layouts of a run without agents
            tables.append(page.terminal(f"{context['title']}: {domains}", shown))
    lines = Table.grid()
    lines.width = page.WIDTH
    if results.facts["missing"]:
        lines.add_row(f"In this run: {'; '.join(results.facts['missing'])}.")
    for sentence in sentences(results):
        lines.add_row(sentence)
    return page.plain(Group(*tables, lines))


def sentences(results: Results) -> list[str]:
    """The verdict, a sentence a line."""
    return page.lines_of("verdict.txt", **verdict.context(results))


def render(results: Results, every: list[Context], films: Iterable[Mapping[str, str]]) -> str:
    """Spec F7: the page of a run, self-contained, with the figures of :func:`answers`."""
    return page.render(
        "run.html",
        title=f"hypogoal: {results.facts['run']}",
        sections=sorted(every, key=lambda context: context["folded"]),  # what is open comes first
        sentences=sentences(results),
        films=films,
        domains=provenance.domains_of(results),
        **verdict.context(results),
    )
