"""Which questions of the paper an evaluation answers: a new one is a file of its own, its template, and a line here.

A question is a module with ``TITLE`` and any of:

- ``look(work, judgement)`` and ``rows(work)``: its numbers, rows of the table; ``facts(work)``: what else it needs to
  know; ``missing(work)``: lines about what the run has no artefacts for.
- ``runs(results)``: each run's numbers, of :func:`house.per_run`. Its table is over these by the columns ``BY``, and
  quantities that are ``PAIRED`` are compared, of ``compared(results)`` where these are other runs.
- ``context(results)``: what else its template needs; None where the run has nothing of it.
- ``figures(context)``, of what the template is given, and what they need, ``NEEDED``.

Its template gets ``results``, ``table``, ``pairs`` and ``figures``, and sets ``shown``, what a terminal prints.
"""

from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from types import ModuleType
from typing import Any, NamedTuple

import pandas as pd
from rich.console import Group
from rich.table import Table

from hypogoal.core.processes import cores
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
from hypogoal.evaluation.names import rank
from hypogoal.evaluation.page import Drawn, Results
from hypogoal.evaluation.run import FORMAT

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


class Answer(NamedTuple):
    """What a run says about a question."""

    question: ModuleType
    name: str  # of its template, its table and its section
    context: dict[str, Any]  # for the template

    def words(self) -> Any:
        """What the template sets and says."""
        return page.module(self.name, self.context)


def answers(results: Results, *, drawn: bool = False) -> list[Answer]:
    """Of every question that the run has something of, in the order of the page; with its figures if ``drawn``."""
    every = []
    for question in (*QUESTIONS, provenance):
        context = context_of(question, results)
        if context is None:
            continue
        if drawn and hasattr(question, "figures"):
            context["figures"] = list(question.figures(context))
        every.append(Answer(question, name_of(question), context))
    return every


def context_of(question: ModuleType, results: Results) -> dict[str, Any] | None:
    """A question's numbers, without its figures; None where the run has nothing of it."""
    table, compared = pd.DataFrame(), pd.DataFrame()
    if hasattr(question, "runs"):
        runs = question.runs(results)
        if runs.empty:
            return None
        table = house.over(runs, question.BY)
    if hasattr(question, "PAIRED"):
        compared = house.pairs(paired_runs(question, results))
    more = question.context(results) if hasattr(question, "context") else {}
    if more is None:
        return None
    return {"results": results, "table": table, "pairs": compared, "figures": []} | more


def paired_runs(question: ModuleType, results: Results) -> pd.DataFrame:
    """Each run's numbers that are compared."""
    runs = getattr(question, "compared", question.runs)(results)
    return runs[runs["quantity"].isin(question.PAIRED)]


def name_of(question: ModuleType) -> str:
    """What its template, its table and its section are called."""
    return question.__name__.rpartition(".")[-1].replace("_", "-")


def asked(name: str) -> Iterator[Any]:
    """This part of every question that has it."""
    for question in (*QUESTIONS, verdict):
        if hasattr(question, name):
            yield getattr(question, name)


def answer(
    work: judging.Work,
    cases: Sequence[tuple[int, judging.Case]],
    settings: Mapping[str, Any],
    data: Sequence[Path],
) -> Results:
    """Every number of a run, and what else its page needs: ensembles are judged, then all questions asked."""
    parts = _judge(work, cases)
    for rows in asked("rows"):
        parts += rows(work)
    facts: dict[str, Any] = {
        "format": FORMAT,
        "run": work.contents.run.resolve().name,
        "settings": settings,
        "provenance": provenance.provenance(work.contents, data),
    }
    for facts_of in asked("facts"):
        facts |= facts_of(work)
    lines = [] if work.contents.ensembles else ["no ensemble"]
    for artefact in work.contents.silent:
        lines.append(f"no executions.csv in {work.contents.name(artefact)}: its domain tells no distance")
    for missing in asked("missing"):
        lines += missing(work)
    return Results(house.joined(parts), facts | work.facts | {"missing": lines})


def _judge(work: judging.Work, cases: Sequence[tuple[int, judging.Case]]) -> list[pd.DataFrame]:
    """What the questions say of every ensemble's members, the paper's method first."""
    parts: list[tuple[int, int, pd.DataFrame]] = []
    workers = judging.processes_for([case for _, case in cases], cores())
    for judgement in judging.judgements(cases, workers, work.progress.advance):
        method = work.place_of(judgement)["method"]
        for look in asked("look"):
            parts += [(rank(method), judgement.number, rows) for rows in look(work, judgement)]
        work.progress.advance()
    parts.sort(key=lambda part: part[:2])
    return [rows for *_, rows in parts]


def write(folder: Path, results: Results) -> None:
    """Write ``numbers.csv``, ``run.json`` and ``tables/*.csv``."""
    results.numbers.to_csv(folder / "numbers.csv", index=False)
    (folder / "run.json").write_text(house.as_json(results.facts) + "\n", encoding="utf-8")
    tables = {"verdict": pd.DataFrame(verdict.findings(results))}
    for each in answers(results):
        tables[each.name] = each.context["table"]
        tables[f"{each.name}-pairs"] = each.context["pairs"]
    (folder / "tables").mkdir()
    for name, table in tables.items():
        if not table.empty:
            table.to_csv(folder / "tables" / f"{name}.csv", index=False)


def summary(results: Results) -> Group:
    """The headline numbers of a run, mean over seeds, and the verdict; at most 80 columns wide; agents last."""
    tables: list[Any] = []
    for each in answers(results):
        shown = getattr(each.words(), "shown", None)
        if shown is not None and not shown.empty:
            tables.append(page.terminal(each.question.TITLE, shown))
    lines = Table.grid()
    lines.width = page.WIDTH
    if results.facts["missing"]:
        lines.add_row(f"In this run: {'; '.join(results.facts['missing'])}.")
    for sentence in sentences(results):
        lines.add_row(sentence)
    return Group(*tables, lines)


def sentences(results: Results) -> list[str]:
    """The verdict, a sentence a line."""
    text = page.templates().get_template("verdict.txt").render(verdict.context(results))
    return [line for line in text.splitlines() if line]


def render(results: Results, every: Sequence[Answer], films: Iterable[Mapping[str, str]]) -> str:
    """Spec F7: the page of a run, self-contained, with the figures of drawn :func:`answers`."""
    sections = []
    for each in sorted(every, key=lambda each: each.question in FOLDED):  # what is open comes first
        part = page.section(each.name, each.context)
        sections.append((each.name, each.question.TITLE, part, each.question in FOLDED))
    lead = verdict.context(results) | {
        "sentences": sentences(results),
        "films": films,
        "domains": provenance.domains_of(results.facts),
    }
    return page.draw_page(f"hypogoal: {results.facts['run']}", sections, "run.html", **lead)


def captions(every: Iterable[Answer]) -> dict[str, tuple[Drawn, str]]:
    """Figures and their captions, by their names."""
    by_name = {}
    for each in every:
        words = page.module(each.name, each.context | {"figures": []})
        for figure in each.context["figures"]:
            by_name[figure.name] = figure, page.caption(words, figure)
    return by_name


def not_drawn(names: Iterable[str]) -> list[str]:
    """A line for each of the paper's Figures 2 to 9 that is not among a run's figures."""
    kinds = [name.partition("-")[0] for name in names]
    needed: dict[str, str] = {}
    for of_question in asked("NEEDED"):
        needed |= of_question
    absent = sorted(set(needed).difference(kinds))
    return [f"{name.replace('figure', 'Figure ')}: not drawn. It needs {needed[name]}." for name in absent]
