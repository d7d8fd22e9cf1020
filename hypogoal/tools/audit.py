"""Spec H5: how often policies fool a success classifier, where, and what a mend changes."""

from pathlib import Path
from typing import Annotated, Any

from typer import Argument, Option

from hypogoal.core.artefacts import TO_FILL_IN
from hypogoal.core.errors import UserError
from hypogoal.stages import Call, Done, stage

WHERE = "Where to play; without it, look at the data that the members were trained with."


@stage(
    "audit ensemble --domain doorkey --sub-goal go-to-goal --out audit",
    often=["steps", "layout_seed", "option_timeout", "mend"],
)
def audit(
    call: Call,
    classifier: Annotated[str, Argument(help="An ensemble's folder, or module:function (docs/audit.md).")],
    *,
    domain: Annotated[str | None, Option(help=WHERE)] = None,
    sub_goal: Annotated[str | None, Option(help="The domain's sub-goal that is the truth.")] = None,
    member: Annotated[int | None, Option(min=0, help="Which member of the ensemble. Default: 0.")] = None,
) -> Done:
    """How often, and where, do policies fool a success classifier?

    A policy is trained against it, and beside it one against the mended one. The classifier is a ``member`` of an
    ensemble artefact, or ``module:function`` from observations (N, *obs) to probabilities (N,). The truth is that of
    the domain's ``sub_goal``. Without a domain an ensemble is audited on its recorded data.
    """
    if domain is None:
        return _on_recorded_data(call, classifier, sub_goal, member)
    if sub_goal is None:
        raise UserError("which sub-goal is the truth?", domain, "Give --sub-goal NAME.")

    from hypogoal.core.processes import prepare
    from hypogoal.core.seeding import rng_for
    from hypogoal.domains.base import load_domain
    from hypogoal.evaluation import audit as played
    from hypogoal.evaluation.house import as_json
    from hypogoal.learners.world import columns_of
    from hypogoal.meta.setup import Setup
    from hypogoal.meta.training import assemble
    from hypogoal.stages import agents

    device = prepare(call.device)
    config = call.settings(domain)
    world = load_domain(domain)
    [column] = columns_of(world, [sub_goal], "Give another --sub-goal.")
    member = member or 0
    target = played.target_of(classifier, sub_goal, member, domain, device)
    policies = _policies(config, target.threshold)
    ensemble_config = {
        "sub_goals": [sub_goal],
        "members": len(policies),
        "domain": domain,
        "domain_config": target.domain_config,
    }
    setup = Setup(world, ensemble_config, Path(), config, call.seed, device)
    settings = agents.description(setup, classifier=classifier, member=member)
    with call.training("audit", settings, target.inputs, config.steps) as work:
        loop = assemble(setup, played.terminations_of(target, column, policies))
        agents.learn(work, setup, loop, config.steps)
        files = work.draft.files
        rng = rng_for(call.seed, "random-play")
        report = played.report_of(loop, policies, world.sub_goals, files)
        report["random_play"] = played.random_play(loop, column, rng)
        (files / "audit.json").write_text(as_json(report) + "\n", encoding="utf-8")
    return Done([*played.lines_of(report)])


def _policies(config: Any, threshold: float) -> dict[str, float]:
    """The probability above which predictions are positive for each policy that is wanted."""
    if config.termination == "oracle":
        raise UserError("an audit takes one classifier only", "termination=oracle", "Leave it out.")
    threshold = config.threshold or threshold
    policies = {"before": threshold}
    if config.mend:
        policies["mended"] = config.mend
    if config.search:
        policies["search"] = threshold
    if 0 < config.mend <= threshold:
        fault = f"mend must be above the threshold {threshold:g}"
        raise UserError(fault, f"mend={config.mend:g}", "Give a higher one, or 0.")
    return policies


def _on_recorded_data(call: Call, source: str, sub_goal: str | None, member: int | None) -> Done:
    """An audit where there is no simulator: all members of an ensemble, on the data that they were trained with."""
    from hypogoal.tools.audit_recorded import audit_recorded

    if not Path(source).is_dir() or member is not None or call.typed or call.preset or call.resume:
        do = "Give --domain and --sub-goal; or an ensemble's folder alone."
        raise UserError("on recorded data an audit takes an ensemble, all members, without settings", source, do)
    lines = audit_recorded(call, Path(source), sub_goal)
    table = call.out / "next" / "SUB_GOAL" / TO_FILL_IN
    lines.append(f"then fill in the column 'label' of {table}: 1 or 0, for the pictures beside it; see docs/audit.md")
    return Done(lines)
