"""Which artefacts of a run are evaluated, and which of them were learned from which ensemble (Spec A5, A8)."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from hypogoal.core.artefacts import Artefact, find_artefacts
from hypogoal.core.errors import UserError


@dataclass(frozen=True)
class Found:
    """The artefacts of a run that are evaluated.

    Attributes:
        run: its folder.
        ensembles: every one.
        agents: what plays a layout: metas, options that no meta continues, baselines.
        ladders: options learned from a named start each, with a table of where they stopped.
        silent: options learned from a named start without that table; they are not evaluated.
        continued: options that a meta artefact continues, and so is judged by.
    """

    run: Path
    ensembles: list[Artefact]
    agents: list[Artefact]
    ladders: list[Artefact]
    silent: list[Artefact]
    continued: list[Artefact]

    def everything(self) -> list[Artefact]:
        """All of them."""
        return [*self.ensembles, *self.agents, *self.ladders]

    def name(self, artefact: Artefact) -> str:
        """Its path within the run."""
        return artefact.path.relative_to(self.run).as_posix()


def find(run: Path) -> Found:
    """The artefacts to evaluate: options that a meta artefact continues are part of that one.

    Raises:
        UserError: there is none, or one is damaged.
    """
    metas = find_artefacts(run, "meta")
    continued = {
        (artefact.path / entry["relative"]).resolve()
        for artefact in metas
        for entry in artefact.manifest["inputs"]
        if entry["kind"] == "options"
    }
    learned = find_artefacts(run, "options")
    options = [artefact for artefact in learned if artefact.path.resolve() not in continued]
    ladders = [artefact for artefact in options if "executions.csv" in artefact.manifest["files"]]
    silent = [artefact for artefact in options if artefact not in ladders and artefact.config.get("start")]
    others = [artefact for artefact in options if artefact not in (*ladders, *silent)]
    agents = [*metas, *others, *find_artefacts(run, "baseline")]
    parts = [artefact for artefact in learned if artefact not in options]
    found = Found(run, find_artefacts(run, "ensemble"), agents, ladders, silent, parts)
    if not found.everything():
        raise UserError("nothing to evaluate", run, "Train something into it first, see 'hypogoal run --help'.")
    return found


def most_used(found: Found) -> int | None:
    """Which of the ensembles with the most members the most artefacts were learned from; the first of several."""
    users = [artefact.input("ensemble").resolve() for artefact in (*found.agents, *found.ladders) if takes(artefact)]
    rank = [(artefact.config["members"], users.count(artefact.path.resolve())) for artefact in found.ensembles]
    return max(range(len(rank)), key=lambda index: rank[index], default=None)


def takes(artefact: Artefact) -> bool:
    """Whether it was learned with the verdicts of an ensemble's members."""
    return artefact.kind != "baseline" and artefact.config["termination"] == "learned"


def within(found: Found, source: Artefact) -> str | None:
    """An ensemble's path within the run; None where it is not one of the run's."""
    same = (own for own in found.ensembles if own.path.resolve() == source.path.resolve())
    return next((found.name(own) for own in same), None)
