"""Which questions of the paper an evaluation answers. A new question needs a module, a template, and a line here.

A question is a module with ``TITLE`` and ``context(results)``, where ``results`` is a :class:`run.Results`. The context
has what the template needs, by name; it is empty if the run has nothing for the question. Some names have a meaning
here:

- ``table``: the table of :func:`statistics.over` over the numbers of :func:`table.per_run`; written as a file.
- ``compared``: each run's numbers of which pairs are compared, in the table ``pairs``.
- ``figures``: instances of :class:`page.Drawn`. The template's macro ``caption`` says what each shows.

The template sets ``shown``, which a terminal prints unless the question is folded. It may set ``note``, which is
printed below.
"""

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from types import ModuleType
from typing import Any

import pandas as pd
from rich.console import Group
from rich.table import Table

from hypogoal.core.artefacts import SUMMARY
from hypogoal.core.files import as_json
from hypogoal.evaluation import (
    choosing,
    curves,
    distance,
    exploits,
    hypotheses,
    judging,
    page,
    parting,
    provenance,
    rooms,
    run,
    saliency,
    selection,
    statistics,
    table,
    undecided,
    verdict,
    zero_shot,
)

Context = dict[str, Any]  # what a question's template is given
Rows = Iterable[pd.DataFrame]  # parts of the table of numbers


@dataclass(frozen=True)
class Question:
    """A question: its module, and the functions that put its own numbers into the table."""

    module: ModuleType
    look: Callable[[judging.Work, judging.Judgement], Rows] | None = None  # is called with each sub-goal judged
    rows: Callable[[judging.Work], Rows] | None = None  # is called once, after all sub-goals were judged
    folded: bool = False  # whether a reader must unfold the section; a terminal does not print it
    beside: bool = False  # whether a page of several runs side by side has it, too

    @property
    def name(self) -> str:
        """The name of the question's template, table and section."""
        return self.module.__name__.rpartition(".")[-1].replace("_", "-")


QUESTIONS = (  # in the order of the page
    Question(parting),
    Question(curves, rows=curves.rows, beside=True),
    Question(rooms, beside=True),
    Question(distance, rows=distance.rows, beside=True),
    Question(exploits, rows=exploits.rows, folded=True),
    Question(hypotheses, look=hypotheses.look, beside=True),
    Question(saliency, look=saliency.look, folded=True),
    Question(selection, rows=selection.rows, folded=True),
    Question(choosing, rows=choosing.rows),
    Question(zero_shot, rows=zero_shot.rows),
    Question(provenance, folded=True),
)


def answers(results: run.Results) -> list[Context]:
    """Return the context of every question that the run has something for, in the order of the page."""
    contexts = [context_of(question, results) for question in QUESTIONS]
    return [context for context in contexts if context]


def context_of(question: Question, results: run.Results) -> Context | None:
    """Return what a question's template is given, or None if the run has nothing for the question."""
    parts = question.module.context(results)
    if not parts:
        return None
    compared = parts.get("compared", pd.DataFrame())
    return {
        "name": question.name,
        "title": question.module.TITLE,
        "folded": question.folded,
        "results": results,
        "table": pd.DataFrame(),
        "pairs": compared if compared.empty else statistics.pairs(compared),
        "figures": [],
        **parts,
    }


def answer(work: judging.Work, settings: Mapping[str, Any]) -> run.Results:
    """Return every number of a run, and what else its page needs.

    First the ensembles are judged, then all questions are asked.
    """
    parts: list[pd.DataFrame] = []
    for judgement in work.judgements():
        for question in QUESTIONS:
            if question.look:
                parts += question.look(work, judgement)
        work.progress.advance()
    for question in QUESTIONS:
        if question.rows:
            parts += question.rows(work)
    numbers = table.joined(parts)
    missing = [] if work.contents.ensembles else ["no ensemble"]
    facts = {
        "format": run.FORMAT,
        "run": work.contents.run.resolve().name,
        "settings": settings,
        "provenance": provenance.provenance(work.contents),
        "missing": missing + selection.missing(work),
        **curves.facts(work),
        **verdict.facts(work),
        **undecided.facts(work, numbers),
        **work.facts,
    }
    return run.Results(numbers, facts)


def write(folder: Path, results: run.Results, every: list[Context]) -> list[str]:
    """Write ``numbers.csv``, ``run.json``, ``tables/*.csv`` and the summary. Return the lines of the summary.

    ``every`` is the result of :func:`answers`.
    """
    results.numbers.to_csv(folder / "numbers.csv", index=False)
    (folder / "run.json").write_text(as_json(results.facts) + "\n", encoding="utf-8")
    tables = {"verdict": pd.DataFrame(verdict.findings(results))}
    for context in every:
        tables[context["name"]] = context["table"]
        tables[f"{context['name']}-pairs"] = context["pairs"]
    (folder / "tables").mkdir()
    for name, rows in tables.items():
        if not rows.empty:
            rows.to_csv(folder / "tables" / f"{name}.csv", index=False)
    lines = summary(results, every)
    (folder / SUMMARY).write_text("\n".join(lines) + "\n", encoding="utf-8")
    return lines


def summary(results: run.Results, every: list[Context]) -> list[str]:
    """Return the lines of a run's summary: headline numbers, as means over seeds, and then the verdict.

    Lines have at most 80 columns.
    """
    domains = ", ".join(provenance.domains_of(results))
    tables: list[Table | str] = []
    for context in every:
        if context["folded"]:
            continue
        words = page.words_of(context)
        if not words.shown.empty:  # the table of layouts, for example, in a run without agents
            note = getattr(words, "note", None)
            tables += [page.terminal(f"{context['title']}: {domains}", words.shown, note), ""]
    lines = Table.grid()
    lines.width = page.WIDTH
    if results.facts["missing"]:
        lines.add_row(f"In this run: {'; '.join(results.facts['missing'])}.")
    for sentence in sentences(results):
        lines.add_row(sentence)
    return page.plain(Group(*tables, lines))


def sentences(results: run.Results) -> list[str]:
    """Return the verdict, a sentence a line."""
    return page.lines_of("verdict.txt", **verdict.context(results))


def render(results: run.Results, every: list[Context], films: Iterable[Mapping[str, str]]) -> str:
    """Return the page of a run, self-contained, with the figures of ``every``, the result of :func:`answers`."""
    return page.render(
        "run.html",
        title=f"hypogoal: {results.facts['run']}",
        sections=sorted(every, key=lambda context: context["folded"]),  # sections that are not folded come first
        sentences=sentences(results),
        films=films,
        domains=provenance.domains_of(results),
        **verdict.context(results),
    )
