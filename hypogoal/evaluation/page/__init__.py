"""The report as one HTML page: sections made of blocks, drawn by a template (Spec F7)."""

from __future__ import annotations

import base64
from collections.abc import Callable, Sequence
from hashlib import sha256
from importlib import resources

from hypogoal.evaluation.page.agents import curves_section, summary_section
from hypogoal.evaluation.page.blocks import Block, Material, listed
from hypogoal.evaluation.page.choices import choices_section, terminations_section
from hypogoal.evaluation.page.distance import distance_section, stops_section
from hypogoal.evaluation.page.explorer import explorer_section
from hypogoal.evaluation.page.hypotheses import examples_section, hypotheses_section
from hypogoal.evaluation.page.ladders import ladders_section
from hypogoal.evaluation.page.provenance import provenance_section
from hypogoal.evaluation.page.rooms import rooms_section
from hypogoal.evaluation.page.saliency import saliency_section

__all__ = ["Material", "draw_page", "render"]

AGENTS = (summary_section, curves_section)
LADDERS = (ladders_section, rooms_section, distance_section, stops_section)
STATES = (explorer_section, examples_section, saliency_section)
CHOICES = (terminations_section, choices_section)
# What a browser may do with the page. Attributes of style are matplotlib's; they run and fetch nothing.
POLICY = (
    "default-src 'none'; script-src {script}; style-src-elem {style}; style-src-attr 'unsafe-inline'; "
    "img-src data:; base-uri 'none'; form-action 'none'"
)


def sections_of(material: Material) -> list[Block]:
    """What a run has artefacts for; of either kind, agents or ladders, also what it lacks.

    A run with neither, an ensemble alone, say, is taken for one whose agents are still to come.
    """
    metrics = material.metrics
    ladders = bool(metrics["rooms"] or metrics["distance"]["options"])
    agents = bool(metrics["agents"]) or not ladders
    makers: list[Callable[[Material], Block]] = [*(AGENTS if agents else ()), *(LADDERS if ladders else ())]
    makers += [hypotheses_section] if metrics["hypotheses"] or agents else []
    makers += [*STATES, *(CHOICES if agents else ()), provenance_section]
    return [make(material) for make in makers]


def render(material: Material, version: str) -> str:
    """Spec F7: the page of a run, self-contained; ``material.figures`` is filled on the way.

    Args:
        material: the evaluation's numbers and arrays.
        version: hypogoal's.
    """
    about = material.metrics["provenance"]
    domains = sorted({data["domain"] for data in about["data"]} | _domains_of(about["artefacts"]))
    count = len(about["artefacts"])
    subtitle = f"{listed(domains)}; {count} artefact{'' if count == 1 else 's'} evaluated; hypogoal {version}"
    return draw_page(f"hypogoal: {material.metrics['run']}", subtitle, sections_of(material), version)


def draw_page(title: str, subtitle: str, sections: Sequence[Block], version: str) -> str:
    """Sections as one HTML file that needs nothing else.

    Every text in it is escaped but our own style and script and what matplotlib drew; should a text of a file ever slip
    through, the page's policy still lets nothing run and nothing be fetched.
    """
    import jinja2

    loader = jinja2.PackageLoader("hypogoal.evaluation", "templates")
    environment = jinja2.Environment(loader=loader, autoescape=True, undefined=jinja2.StrictUndefined)
    css, script = (
        resources.files("hypogoal.evaluation").joinpath(f"templates/{name}").read_text(encoding="utf-8")
        for name in ("report.css", "explorer.js")
    )
    return environment.get_template("report.html").render(
        title=title,
        subtitle=subtitle,
        version=version,
        policy=POLICY.format(script=_digest(script), style=_digest(css)),
        css=css,
        script=script,
        sections=sections,
        footer=f"Made by hypogoal {version}. This page is one file and needs no network.",
    )


def _digest(text: str) -> str:
    """As a policy names a script or a style that is in the page."""
    return f"'sha256-{base64.b64encode(sha256(text.encode()).digest()).decode()}'"


def _domains_of(artefacts: list[dict]) -> set[str]:
    return {artefact["config"]["domain"] for artefact in artefacts if "domain" in artefact["config"]}
