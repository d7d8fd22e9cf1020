"""Which questions of the paper an evaluation answers: a new one is a file of its own, its template, and a line here.

A question is a module with ``TITLE`` and ``context(results)``, what its template and the terminal show (None: nothing),
and any of: ``look(work, judgement)`` and ``rows(work)``, its numbers; ``facts(work)``, what else it needs to know;
``tables(results)``, means, intervals and pairs; ``figures(results)`` and what they need, ``NEEDED``; ``missing(work)``,
lines about what the run has no artefacts for.
"""

import json
from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from types import ModuleType
from typing import Any

import pandas as pd
from rich.console import Group
from rich.table import Table

from hypogoal.core.processes import cores
from hypogoal.evaluation import (
    choosing,
    curves,
    distance,
    exploits,
    hypotheses,
    page,
    provenance,
    rooms,
    saliency,
    selection,
    verdict,
    zero_shot,
)
from hypogoal.evaluation.house import joined, plain
from hypogoal.evaluation.judging import Case, Work, judgements, processes_for
from hypogoal.evaluation.names import rank
from hypogoal.evaluation.page import Drawn, Results
from hypogoal.evaluation.run import FORMAT
from hypogoal.learners.episodes import LAST

QUESTIONS: list[ModuleType] = [  # in the order of the page
    *(curves, rooms, distance, exploits, hypotheses, saliency, selection, choosing, zero_shot)
]
FOLDED = (exploits, saliency, selection)  # until asked for
SETTINGS = {"window": LAST, "solved": curves.SOLVED}
LADDERS = {"executions": LAST, "inside_counts": distance.INSIDE, "near": distance.NEAR}  # of runs with ladders alone


def asked(name: str) -> Iterator[tuple[ModuleType, Any]]:
    """The questions that have this, and it."""
    for question in (*QUESTIONS, verdict):
        if hasattr(question, name):
            yield question, getattr(question, name)


def answer(work: Work, cases: Sequence[tuple[int, Case]], settings: Mapping[str, Any], data: Sequence[Path]) -> Results:
    """Every number of a run, and what else its page needs: ensembles are judged, then all questions asked."""
    of_ensembles = _judge(work, cases)
    parts = [*of_ensembles]
    for _, rows in asked("rows"):
        parts += rows(work)
    facts: dict[str, Any] = {
        "format": FORMAT,
        "run": work.contents.run.resolve().name,
        "settings": {**settings, **(LADDERS if work.contents.ladders else {})},
        "provenance": provenance.provenance(work.contents, data),
    }
    for _, facts_of in asked("facts"):
        facts |= facts_of(work)
    lines = [] if work.contents.ensembles else ["no ensemble"]
    for _, missing in asked("missing"):
        lines += missing(work)
    return Results(joined(parts), facts | work.facts | {"missing": lines})


def _judge(work: Work, cases: Sequence[tuple[int, Case]]) -> list[pd.DataFrame]:
    """What the questions say of every ensemble's members, the paper's method first."""
    ensembles = work.contents.ensembles
    parts: dict[int, list[pd.DataFrame]] = {number: [] for number in range(len(ensembles))}
    workers = processes_for([case for _, case in cases], cores())
    for judgement in judgements(cases, workers, work.progress.advance):
        for _, look in asked("look"):
            parts[judgement.number] += look(work, judgement)
        work.progress.advance()
    order = sorted(parts, key=lambda number: rank(work.place(ensembles[number])["method"]))
    return [part for number in order for part in parts[number]]


def write(folder: Path, results: Results) -> None:
    """Write ``numbers.csv``, ``run.json`` and ``tables/*.csv``."""
    results.numbers.to_csv(folder / "numbers.csv", index=False)
    text = json.dumps(plain(results.facts), indent=1)
    (folder / "run.json").write_text(text + "\n", encoding="utf-8")
    (folder / "tables").mkdir()
    for question, tables in asked("tables"):
        if question.context(results) is None:
            continue
        for name, table in tables(results).items():
            if not table.empty:
                table.to_csv(folder / "tables" / f"{name}.csv", index=False)


def summary(results: Results) -> Group:
    """The headline numbers of a run, mean over seeds, and the verdict; at most 80 columns wide; agents last."""
    tables: list[Any] = []
    for question in (*QUESTIONS[1:], curves):
        context = question.context(results)
        if context and context.get("printed") is not None:
            tables.append(page.terminal(question.TITLE, context["printed"]))
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


def render(results: Results, drawn: Sequence[tuple[ModuleType, Drawn]], films: Iterable[Mapping[str, str]]) -> str:
    """Spec F7: the page of a run, self-contained, with figures of :func:`all_figures`."""
    sections = []
    for question in (*QUESTIONS, provenance):
        context = question.context(results)
        if context is None:
            continue
        name = _name(question)
        figures = [figure for source, figure in drawn if source is question]
        folded = question in (*FOLDED, provenance)
        part = page.section(name, context | {"figures": figures, "is_papers": results.facts["is_papers"]})
        sections.append((name, question.TITLE, part, folded))
    sections.sort(key=lambda section: section[-1])  # what is open comes first
    lead = verdict.context(results) | {
        "sentences": sentences(results),
        "films": films,
        "missing": results.facts["missing"],
        "domains": provenance.domains_of(results.facts),
        "artefacts": len(results.facts["provenance"]["artefacts"]),
    }
    return page.draw_page(f"hypogoal: {results.facts['run']}", sections, "run.html", **lead)


def _name(question: ModuleType) -> str:
    return question.__name__.rpartition(".")[-1].replace("_", "-")


def all_figures(results: Results) -> list[tuple[ModuleType, Drawn]]:
    """Every figure that the run has artefacts for, with its question."""
    return [(question, drawn) for question, figures in asked("figures") for drawn in figures(results)]


def captions(results: Results, drawn: Sequence[tuple[ModuleType, Drawn]]) -> dict[str, str]:
    """The figures' captions by their names."""
    texts = {}
    for question, figure in drawn:
        context = question.context(results) | {"figures": [], "is_papers": results.facts["is_papers"]}
        texts[figure.name] = page.caption(_name(question), context, figure)
    return texts


def not_drawn(drawn: Iterable[Drawn]) -> list[str]:
    """A line for each of the paper's Figures 2 to 9 that the run lacks."""
    names = [figure.name for figure in drawn]
    lines = []
    for _, needed in asked("NEEDED"):
        for name, requirement in needed.items():
            if not any(other == name or other.startswith(f"{name}-") for other in names):
                lines.append(f"{name.replace('figure', 'Figure ')}: not drawn. It needs {requirement}.")
    return sorted(lines)
