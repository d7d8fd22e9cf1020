"""Spec H5: how often policies fool a success classifier, where, and what a mend changes."""

import json
import math
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from hypogoal.cards import create_artefact
from hypogoal.core.artefacts import claim, open_artefact
from hypogoal.core.checkpoints import checkpoints_of
from hypogoal.core.compute import prepare
from hypogoal.core.errors import UserError
from hypogoal.core.preflight import preflight
from hypogoal.core.progress import MetricsLog, Progress
from hypogoal.core.seeding import rng_for
from hypogoal.domains.base import Engine, load_domain
from hypogoal.evaluation import exploits
from hypogoal.evaluation.audit import POLICIES, findings, member_of, own_classifier, random_play
from hypogoal.evaluation.numbers import plain
from hypogoal.evaluation.run import read_table
from hypogoal.hypotheses.ensemble import THRESHOLD, read_ensemble
from hypogoal.hypotheses.thresholds import log_odds_of
from hypogoal.meta.config import AuditConfig
from hypogoal.meta.training import assemble, columns_of, description, start_arguments, train, write_trained
from hypogoal.needs import play_needs
from hypogoal.options.termination import Terminations, rule_of


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
    lived: dict[str, Any] = {}
    inputs, threshold, standard = [], config.threshold or THRESHOLD, None
    if ":" in classifier and not Path(classifier).is_dir():
        classify = own_classifier(classifier)
    else:
        source = open_artefact(Path(classifier), "ensemble").whole()
        ensemble = read_ensemble(source.path, source.config, sub_goal).to(device)
        classify, inputs = member_of(ensemble, member), [source.path]
        standard = ensemble.view.standard
        threshold = config.threshold or float(ensemble.thresholds[member])
        lived = source.config["domain_config"] if source.config["domain"] == domain else lived
    edges = np.array([threshold, config.mend] if config.mend else [threshold])
    if (np.diff(edges) <= 0).any():
        what = f"this does not mend a threshold of {threshold:g}"
        raise UserError(what, f"mend={config.mend:g}", "Give a higher one, or 0.")
    for name, value in (("termination", "oracle"), ("policy_view", "agent-crop")):
        if getattr(config, name) == value:
            raise UserError("an audit takes one classifier only", f"{name}={value}", "Leave it out.")
    about = {"sub_goals": [sub_goal], "members": len(edges), "domain": domain, "domain_config": lived}
    out = claim(out, kind="audit", inputs=inputs, force=force, resume=resume)
    start_arguments(world, config, 1, seed)  # what cannot be is told before what it would need
    preflight("audit", out, play_needs(world, about, config), resume=resume, quiet=quiet)

    def ends(engine: Engine) -> Terminations:
        def log_odds(ids: NDArray[np.int64]) -> NDArray[np.float32]:
            return np.repeat(classify(engine, ids)[:, None], len(edges), axis=1).astype(np.float32)

        rule, length = rule_of(config.termination)
        return rule(log_odds, len(edges), None, log_odds_of(edges).astype(np.float32), engine.count, length)

    loop = assemble(world, Path(), about, config, seed, device, ends, standard)
    steps = config.steps * (len(edges) if config.steps_for == "each" else 1)
    settings = description(world, about, config, classifier=classifier, member=member, steps=steps)
    with create_artefact(
        out, kind="audit", config=settings, seed=seed, inputs=inputs, force=force, resume=resume
    ) as folder:
        log = MetricsLog(folder / "metrics.jsonl")
        with Progress("audit", total=steps, quiet=quiet) as progress:
            train(loop, steps, log, progress, checkpoints_of(folder))
        write_trained(folder, loop, world, about, config, seed)
        table, report = read_table(folder / exploits.TABLE, exploits.COLUMNS), dict.fromkeys(POLICIES)
        for option, (name, edge) in enumerate(zip(POLICIES, edges.tolist(), strict=False)):
            ended = float(1 / (1 + np.exp(-loop.terminations.thresholds[option])))  # it may have fallen: patience
            threshold = edge if math.isclose(ended, edge, rel_tol=1e-6) else ended  # which float32 log-odds round
            report[name] = {"threshold": threshold, **findings(loop, table, option, world.sub_goals, folder)}
        report["random_play"] = random_play(loop, column, rng_for(seed, "random-play"))
        (folder / "audit.json").write_text(json.dumps(plain(report), indent=1) + "\n", encoding="utf-8")
    return report
