"""Spec H5: how often policies fool a success classifier, where, and what a mend changes."""

import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from hypogoal.core.artefacts import open_artefact
from hypogoal.core.errors import UserError
from hypogoal.core.processes import prepare
from hypogoal.core.seeding import rng_for
from hypogoal.core.training import training
from hypogoal.domains.base import Engine, load_domain
from hypogoal.evaluation import exploits
from hypogoal.evaluation.audit import POLICIES, Classifier, findings, member_of, own_classifier, random_play
from hypogoal.evaluation.numbers import plain
from hypogoal.hypotheses.ensemble import THRESHOLD, read_ensemble
from hypogoal.hypotheses.thresholds import log_odds_of
from hypogoal.meta.config import AuditConfig
from hypogoal.meta.training import assemble, columns_of, description, start_arguments, train, write_trained
from hypogoal.observations import Standard
from hypogoal.options.tables import read_table
from hypogoal.options.termination import ORACLE, Terminations, rule_of


def audit(
    classifier: str,
    config: AuditConfig,
    out: Path,
    *,
    domain: str,
    sub_goal: str,
    member: int = 0,
    seed: int = 0,
    force: bool = False,
    resume: bool = False,
    quiet: bool = False,
    device: str = "auto",
) -> dict[str, Any]:
    """Train a policy against a classifier, beside it one against the mended one; write ``out``, return its audit.json.

    The classifier is a ``member`` of an ensemble artefact, or ``module:function`` from observations (N, *obs) to
    probabilities (N,). The truth is that of the domain's ``sub_goal``.
    """
    device, world = prepare(device), load_domain(domain)
    [column] = columns_of(world, [sub_goal], "Give another --sub-goal.")
    target = classifier_of(classifier, sub_goal, member, domain, device)
    threshold = config.threshold or target.threshold
    edges = np.array([threshold, config.mend] if config.mend else [threshold])
    if (np.diff(edges) <= 0).any():
        fault = f"mend must be above the threshold {threshold:g}"
        raise UserError(fault, f"mend={config.mend:g}", "Give a higher one, or 0.")
    if config.termination == ORACLE:
        raise UserError("an audit takes one classifier only", "termination=oracle", "Leave it out.")
    ensemble_config = {
        "sub_goals": [sub_goal],
        "members": len(edges),
        "domain": domain,
        "domain_config": target.domain_config,
    }
    start_arguments(world, config, 1, seed)  # refuse an impossible start before any work
    steps = config.steps * (len(edges) if config.steps_for == "each" else 1)
    settings = description(world, ensemble_config, config, classifier=classifier, member=member, steps=steps)

    def ends(engine: Engine) -> Terminations:
        def log_odds(ids: NDArray[np.int64]) -> NDArray[np.float32]:
            return np.repeat(target.classify(engine, ids)[:, None], len(edges), axis=1).astype(np.float32)

        rule, length = rule_of(config.termination)
        return rule(log_odds, len(edges), None, log_odds_of(edges).astype(np.float32), engine.count, length)

    artefact: dict[str, Any] = {"kind": "audit", "config": settings, "seed": seed, "inputs": target.inputs}
    with training("audit", out, steps=steps, quiet=quiet, resume=resume, force=force, **artefact) as work:
        loop = assemble(world, Path(), ensemble_config, config, seed, device, ends, target.standard)
        train(loop, steps, work.log, work.progress, work.checkpoints)
        write_trained(work.folder, loop, world, ensemble_config, config, seed)
        table, report = read_table(work.folder / exploits.TABLE, exploits.COLUMNS), dict.fromkeys(POLICIES)
        for option, (name, edge) in enumerate(zip(POLICIES, edges.tolist(), strict=False)):
            ended = float(1 / (1 + np.exp(-loop.terminations.thresholds[option])))  # a rule may have changed it
            threshold = edge if math.isclose(ended, edge, rel_tol=1e-6) else ended  # float32 log-odds round it
            numbers = findings(loop, table, option, world.sub_goals, work.folder)
            report[name] = {"threshold": threshold, **numbers}
        report["random_play"] = random_play(loop, column, rng_for(seed, "random-play"))
        (work.folder / "audit.json").write_text(json.dumps(plain(report), indent=1) + "\n", encoding="utf-8")
    return report


@dataclass(frozen=True)
class Target:
    """A classifier to audit."""

    classify: Classifier
    threshold: float  # the probability above which its prediction is positive
    standard: Standard | None = None  # of observations that are no pictures; None: unknown
    domain_config: Mapping[str, Any] = field(default_factory=dict)  # of the world that its data were collected in
    inputs: Sequence[Path] = ()


def classifier_of(name: str, sub_goal: str, member: int, domain: str, device: str) -> Target:
    """A member of an ensemble artefact, or ``module:function``; anything else is a ``UserError``."""
    if ":" in name and not Path(name).is_dir():
        return Target(own_classifier(name), THRESHOLD)
    source = open_artefact(Path(name), "ensemble")
    ensemble = read_ensemble(source.path, source.config, sub_goal).to(device)
    classify, threshold = member_of(ensemble, member), float(ensemble.thresholds[member])
    world = source.config["domain_config"] if source.config["domain"] == domain else {}
    return Target(classify, threshold, ensemble.view.standard, world, [source.path])
