"""Which questions of the paper an evaluation answers: a new one is a file of its own and a line here."""

import json
import tomllib
from collections.abc import Iterator, Mapping, Sequence
from operator import itemgetter
from pathlib import Path
from typing import Any

from rich.console import Group
from rich.table import Table

from hypogoal.core.files import write_table
from hypogoal.core.processes import cores
from hypogoal.core.progress import Progress
from hypogoal.evaluation import (
    choosing,
    curves,
    distance,
    exploits,
    explorer,
    hypotheses,
    ranking,
    rooms,
    saliency,
    selection,
    verdict,
    zero_shot,
)
from hypogoal.evaluation.curves import group_runs, read_run
from hypogoal.evaluation.judging import Case, Work, judgements, processes_for
from hypogoal.evaluation.numbers import Metrics, plain
from hypogoal.evaluation.page import WIDTH, Drawn, Material, Question, draw_page, listed, packaged
from hypogoal.evaluation.provenance import domains_of, provenance, provenance_section
from hypogoal.evaluation.run import FORMAT, Contents, most_used
from hypogoal.evaluation.table import Row, compared, defined
from hypogoal.learners.episodes import LAST

# In the order of the page; the numbers of one are there for those below it.
PARTS = (
    *(curves, rooms, distance, exploits, hypotheses, ranking, explorer, saliency, selection, choosing, zero_shot),
    verdict,
)
QUESTIONS: list[Question] = [part.QUESTION for part in PARTS]


SETTINGS = {"window": LAST, "solved": curves.SOLVED}
LADDERS = {"executions": LAST, "inside_counts": distance.INSIDE, "near": distance.NEAR}  # of runs with ladders alone


def agents_last() -> list[Question]:
    """In the order in which lines are told: where a page begins with the agents, a terminal ends with them."""
    return [*QUESTIONS[1:], QUESTIONS[0]]


def work_of(contents: Contents, arrays: Any, progress: Progress, layouts: tuple[int, ...]) -> Work:
    """What the questions work with: a run, the file of its arrays, and layouts that agents play without learning."""
    agents = group_runs([read_run(artefact, contents.name(artefact)) for artefact in contents.agents])
    return Work(contents, arrays, progress, layouts, agents=agents)


def judge_ensembles(work: Work, cases: Sequence[tuple[int, Case]]) -> None:
    """Show the questions every ensemble of the run on its data's held-out and unlabelled states.

    Of one ensemble, the first of those with the most members, example states and attributions are kept too; of one,
    the one with the most members whose options were learned most often, states to browse.
    """
    configs = [artefact.config for artefact in work.contents.ensembles]
    work.shown = max(range(len(configs)), key=lambda index: configs[index]["members"], default=None)
    work.browsed = most_used(work.contents)
    rows: list[list[Row]] = [[] for _ in configs]
    workers = processes_for([case for _, case in cases], cores())
    for judgement in judgements(cases, workers, work.progress.advance):
        for question in QUESTIONS:
            rows[judgement.number] += question.look(work, judgement)
        work.progress.advance()
    for of_ensemble in rows:
        work.rows += of_ensemble


def answer(work: Work) -> None:
    """Ask each question for its rows and its part of the numbers."""
    for question in QUESTIONS:
        work.rows += question.rows(work)
        work.metrics |= question.view(work)


def metrics_of(work: Work, settings: Mapping[str, Any], data: Sequence[Path], missing: Sequence[str]) -> Metrics:
    """What ``metrics.json`` holds."""
    contents = work.contents
    pairs = [question.pairs for question in QUESTIONS if question.pairs]
    return plain(
        {
            "format": FORMAT,
            "run": contents.run.resolve().name,
            "settings": {**settings, **(LADDERS if contents.ladders else {})},
            "missing": missing,
            **work.metrics,
            "comparisons": {by.name: compared(work.rows, by) for by in pairs},
            "provenance": provenance(contents, data),
            "quantities": meanings(),
        }
    )


def write(folder: Path, metrics: Metrics, rows: Sequence[Row]) -> None:
    """Write ``metrics.json`` and ``numbers.csv``."""
    write_table(folder / "numbers.csv", Row._fields, defined(rows))
    text = json.dumps(metrics, indent=1, allow_nan=False)
    (folder / "metrics.json").write_text(text + "\n", encoding="utf-8")


def missing(work: Work) -> list[str]:
    """One line for everything of section F that this run has no artefacts for.

    A run with ladders is asked for what Figures 3 to 5 need, one with agents for those that Figure 6 has beside them.
    """
    lines = [] if work.contents.ensembles else ["no ensemble"]
    lines += [line for question in agents_last() for line in question.missing(work)]
    return lines


def meanings() -> dict[str, dict[str, str]]:
    """What each quantity is."""
    quantities: dict[str, tuple[str, str]] = tomllib.loads(packaged("quantities.toml"))
    for question in QUESTIONS:
        quantities |= question.meanings
    return {name: {"unit": unit, "meaning": meaning} for name, (unit, meaning) in quantities.items()}


def summary_table(metrics: Metrics) -> Group:
    """The headline numbers of a run, mean over seeds, and the verdict; at most 80 columns wide.

    A table for each kind of thing that there is: ensembles, options on ladders, agents.
    """
    tables = [table for question in agents_last() for table in question.summary(metrics)]
    if metrics["missing"]:
        last = tables[-1]
        last.caption, last.caption_justify = f"In this run: {'; '.join(metrics['missing'])}.", "left"
    sentences = Table.grid()
    sentences.width = WIDTH
    for sentence in verdict.verdict(metrics):
        sentences.add_row(sentence)
    return Group(*tables, sentences)


def render(material: Material, version: str) -> str:
    """Spec F7: the page of a run, self-contained; ``material.figures`` is filled on the way."""
    metrics = material.metrics
    count = len(metrics["provenance"]["artefacts"])
    evaluated = f"{count} artefact{'' if count == 1 else 's'} evaluated"
    subtitle = f"{listed(domains_of(metrics))}; {evaluated}; hypogoal {version}"
    # The verdict needs all other numbers, its task comes before them.
    sections = [part for question in (QUESTIONS[-1], *QUESTIONS[:-1]) for part in question.sections(material)]
    sections.sort(key=itemgetter("folded"))  # what is open comes first
    lead = {
        "task": " ".join(metrics.get("verdict", {}).get("task", [])),
        "verdict": verdict.verdict(metrics),
        "baselines": verdict.baselines(metrics),
        "question": verdict.ASKED if material.of_agents() else "",
        "films": material.films,
    }
    return draw_page(f"hypogoal: {metrics['run']}", subtitle, [*sections, provenance_section(material)], version, lead)


def paper_figures(material: Material) -> tuple[list[Drawn], list[str]]:
    """Figures 2 to 9 and those beside them that the run has artefacts for; a line for each of 2 to 9 that it lacks."""
    figures: Iterator[Drawn] = (figure for question in QUESTIONS for figure in question.figures(material))
    drawn = sorted((figure for figure in figures if figure.figure is not None), key=lambda figure: figure.stem)
    needed = {name: requirement for question in QUESTIONS for name, requirement in question.needed.items()}
    missing = [
        f"{name.replace('figure', 'Figure ')}: not drawn. It needs {needed[name]}."
        for name in sorted(needed)
        if not any(figure.stem == name or figure.stem.startswith(f"{name}-") for figure in drawn)
    ]
    return drawn, missing
