"""Spec H5: how often a policy fools a success classifier, where, and what a mend changes."""

import json
from pathlib import Path
from typing import Any

from hypogoal.core.artefacts import claim, create_artefact
from hypogoal.core.checkpoints import checkpoints_of
from hypogoal.core.compute import prepare
from hypogoal.core.config import as_dict
from hypogoal.core.errors import UserError
from hypogoal.core.files import write_table
from hypogoal.core.preflight import preflight
from hypogoal.core.progress import MetricsLog, Progress
from hypogoal.core.seeding import rng_for
from hypogoal.domains.base import Domain, load_domain
from hypogoal.evaluation.audit import COLUMNS, Adversary, findings, load_classifier, mended_threshold
from hypogoal.meta.config import AuditConfig
from hypogoal.meta.training import make_engine, train
from hypogoal.needs import play_needs


def audit(
    classifier: str,
    config: AuditConfig,
    out: Path,
    *,
    domain: str,
    sub_goal: str = "",
    seed: int = 0,
    force: bool = False,
    resume: bool = False,
    quiet: bool = False,
    device: str = "auto",
) -> dict[str, Any]:
    """Train a policy against a classifier, and against the mended one; write the artefact ``out``.

    Args:
        classifier: ``ENSEMBLE_FOLDER:SUB_GOAL/MEMBER``, or ``module:function`` from uint8 (N, *obs) to probabilities
            (N,).
        domain: where it is played.
        sub_goal: whose truth counts; that of the member, or the domain's only one, where empty.

    Returns:
        The content of ``audit.json``.
    """
    device = prepare(device)
    found, world = load_classifier(classifier), load_domain(domain)
    column = _column(world, sub_goal or found.sub_goal)
    threshold = config.threshold or found.threshold
    higher = mended_threshold(config.mend, found, threshold)
    inputs = [found.source.path] if found.source else []
    out = claim(out, kind="audit", inputs=inputs, force=force, resume=resume)
    own = found.source.config if found.source else {}
    lived = own["domain_config"] if own and own["domain"] == domain else {}
    about = {"sub_goals": [world.sub_goals[column]], "members": 1, "domain": domain, "domain_config": lived}
    preflight("audit", out, play_needs(world, about, config), resume=resume, quiet=quiet)
    report: dict[str, Any] = {"classifier": classifier, "sub_goal": world.sub_goals[column], "domain": domain}
    settings = as_dict(config) | about | {"classifier": classifier}
    with create_artefact(
        out, kind="audit", config=settings, seed=seed, inputs=inputs, force=force, resume=resume
    ) as folder:
        chance = Adversary(make_engine(world, about, config, 1, seed), found, threshold, config, seed, device)
        report["random_play"] = chance.random_play(column, rng_for(seed, "random-play"))
        rows: list[tuple[int, ...]] = []
        for number, (name, edge) in enumerate((("before", threshold), ("mended", higher))):
            report[name] = None
            if edge is None:
                continue
            loop = Adversary(make_engine(world, about, config, 1, seed), found, edge, config, seed, device)
            log = MetricsLog(folder / f"metrics{'-mended' * number}.jsonl")
            with Progress(f"audit, {name}", total=config.steps, quiet=quiet) as progress:
                train(loop, config.steps, log, progress, checkpoints_of(folder, name))
            numbers, table, films = findings(loop, world.sub_goals, column, found.name, name)
            report[name] = {"threshold": edge, **numbers}
            rows += [(number, *row) for row in table]
            for film, gif in films.items():
                (folder / film).write_bytes(gif)
        (folder / "audit.json").write_text(json.dumps(report, indent=1) + "\n", encoding="utf-8")
        write_table(folder / "executions.csv", COLUMNS, rows)
    return report


def _column(domain: Domain, sub_goal: str) -> int:
    """Which of the domain's sub-goals is meant: the only one where none is named."""
    known = domain.sub_goals
    if sub_goal not in known and (sub_goal or len(known) > 1):
        what = f"{domain.name} does not know where this is true" if sub_goal else "which sub-goal is it to be?"
        raise UserError(what, sub_goal or None, f"Give --sub-goal, one of {', '.join(known)}.")
    return known.index(sub_goal) if sub_goal else 0
