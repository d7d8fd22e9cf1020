"""Which questions of the paper an evaluation answers: a new one is a file of its own and a line here."""

import tomllib
from collections.abc import Iterator
from operator import itemgetter

from rich.console import Group
from rich.table import Table

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
from hypogoal.evaluation.numbers import Metrics
from hypogoal.evaluation.page import WIDTH, Drawn, Material, Question, draw_page, listed, packaged
from hypogoal.evaluation.provenance import domains_of, provenance_section

# In the order of the page; the numbers of one are there for those below it.
PARTS = (
    *(curves, rooms, distance, exploits, hypotheses, ranking, explorer, saliency, selection, choosing, zero_shot),
    verdict,
)
QUESTIONS: list[Question] = [part.QUESTION for part in PARTS]


def agents_last() -> list[Question]:
    """In the order in which lines are told: where a page begins with the agents, a terminal ends with them."""
    return [*QUESTIONS[1:], QUESTIONS[0]]


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
