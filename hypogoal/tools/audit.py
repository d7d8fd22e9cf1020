"""The command that tells how often policies fool a success classifier, where, and what a mend changes."""

import json
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from typer import Argument, Option

from hypogoal.command.call import Call, Done
from hypogoal.command.stage import stage
from hypogoal.core.errors import Complete, UserError
from hypogoal.core.progress import say

if TYPE_CHECKING:
    from hypogoal.meta.config import AuditConfig

REPORT = "audit.json"
WHERE = "The domain in which policies play. Without it the audit looks at recorded data."
WHICH = "The labelled data to look at. Default: those with which the members were trained."
TRUTH = "The sub-goal that the classifier is meant to recognise."
LIMIT = (
    "Exit with code 3 if false positives are more than this share: in play, of executions or of states met;"
    " on recorded data, of states labelled as failures, where the worst member counts."
)
FAILED = 3


@stage(
    "audit ensemble --domain doorkey --sub-goal go-to-goal --out audit",
    often=["steps", "layout_seed", "option_timeout", "mend"],
)
def audit(
    call: Call,
    classifier: Annotated[str, Argument(help="An ensemble's folder, or module:function (docs/audit.md).")],
    *,
    domain: Annotated[str | None, Option(help=WHERE)] = None,
    data: Annotated[Path | None, Option(help=WHICH)] = None,
    sub_goal: Annotated[str | None, Option(help=TRUTH)] = None,
    member: Annotated[int | None, Option(min=0, help="The number of the member to audit. Default: 0.")] = None,
    fail_above: Annotated[float | None, Option(metavar="SHARE", min=0, max=1, help=LIMIT)] = None,
    as_json: Annotated[bool, Option("--json", metavar="", help="Print one line of JSON.")] = False,
) -> Done:
    """Say how often, and where, policies fool a success classifier.

    A policy is trained against the classifier and, if ``mend`` is set, a second policy against the mended classifier.
    The classifier is a ``member`` of an ensemble artefact, or ``module:function`` from observations (N, *obs) to
    probabilities (N,). The truth is that of the domain's ``sub_goal``. Without a domain, the classifier is audited on
    recorded data.
    """
    from hypogoal.tools.audit_recorded import audit_data

    if domain is None:
        lines, shares = audit_data(call, classifier, data, sub_goal, member)
    elif sub_goal is None or data is not None:
        raise UserError("where is played, the domain has the truth", domain, "Give --sub-goal NAME, and no --data.")
    else:
        lines, shares = _in_play(call, classifier, domain, sub_goal, member or 0)

    unmeasured = [name for name, share in shares.items() if share is None]
    is_failed = False
    if fail_above is not None:
        measured = [share for share in shares.values() if share is not None]
        is_above = any(share > fail_above for share in measured)
        is_failed = is_above or bool(unmeasured)
        if is_above:
            lines.append(f"FAILED: more than {fail_above:.1%} are false positives")
        elif unmeasured:
            lines.append(f"FAILED: there was nothing to count false positives among: {', '.join(unmeasured)}")
    summary = {"out": str(call.out), "false_positives": shares, "fail_above": fail_above, "failed": is_failed}
    return Done(lines, told=json.dumps(summary) if as_json else "", code=FAILED if is_failed else 0)


def _in_play(
    call: Call,
    classifier: str,
    domain: str,
    sub_goal: str,
    member: int,
) -> tuple[list[str], dict[str, float | None]]:
    """Train and play the policies. Return the findings in lines, and the shares of false positives."""
    from hypogoal.core.files import as_json
    from hypogoal.core.seeding import rng_for
    from hypogoal.domains.find import load_domain
    from hypogoal.domains.world import columns_of
    from hypogoal.evaluation.page import lines_of
    from hypogoal.meta.config import AuditConfig
    from hypogoal.meta.setup import Setup, assemble
    from hypogoal.stages import agents
    from hypogoal.tools import audit_played as played
    from hypogoal.tools.classifiers import classifier_of

    config = call.settings(AuditConfig, domain)
    world = load_domain(domain)
    [column] = columns_of(world, [sub_goal], "Give another --sub-goal.")
    audited, source = classifier_of(classifier, sub_goal, call.device)
    thresholds = audited.thresholds.tolist()
    if member >= len(thresholds):
        raise UserError("the ensemble has no such member", member, f"Give --member, 0 to {len(thresholds) - 1}.")
    policies = _policies(config, thresholds[member])
    ensemble_config = {
        "sub_goals": [sub_goal],
        "members": len(policies),
        "domain": domain,
        "domain_config": {},
    }
    if source and source.config["domain"] == domain:
        ensemble_config["domain_config"] = source.config["domain_config"]
    setup = Setup(world, ensemble_config, Path(), config, call.seed, call.device)
    settings = agents.description(setup, classifier=classifier, member=member)
    inputs = [source.path] if source else []
    try:
        with call.training("audit", settings, inputs, config.steps) as work:
            ends = partial(played.terminations_of, audited, member, policies)
            loop = assemble(setup, ends)
            agents.learn(work, setup, loop, config.steps)
            files = work.draft.files
            report = dict.fromkeys(played.POLICIES)
            for option, name in enumerate(policies):
                report[name] = played.findings(loop, option, name, world.sub_goals, files)
            rng = rng_for(call.seed, "random-play")
            report["random_play"] = played.random_play(loop, column, rng)
            (files / REPORT).write_text(as_json(report) + "\n", encoding="utf-8")
    except Complete as complete:  # what was found earlier counts, and may fail again
        say(complete, err=True)
    findings = json.loads((call.out / REPORT).read_bytes())
    return lines_of("played.txt", **findings), played.shares_of(findings)


def _policies(config: "AuditConfig", threshold: float) -> dict[str, float]:
    """Return, by the name of each policy, the probability above which predictions are positive.

    Raises ``UserError`` if ``mend`` is not above the threshold, or if options are to end at the truth.
    """
    if config.termination == "oracle":
        raise UserError("an audit takes one classifier only", "termination=oracle", "Leave it out.")
    threshold = config.threshold or threshold
    policies = {"before": threshold}
    if config.mend:
        policies["mended"] = config.mend
    if 0 < config.mend <= threshold:
        fault = f"mend must be above the threshold {threshold:g}"
        raise UserError(fault, f"mend={config.mend:g}", "Give a higher one, or 0.")
    return policies
